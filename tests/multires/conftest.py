"""A pyramid of few channels, on the corpus of seconds: a run takes seconds too."""

from pathlib import Path

import pytest
from small_runs import small_config
from speakers import SETTINGS, write_speakers

import gesturekit as gk
from gesturekit.corpus import Item, Manifest
from gesturekit.multires import (
    MultiresConfig,
    MultiresGenerator,
    TrainingData,
    load_training_data,
    train,
)
from gesturekit.multires.training.windows import Batches


@pytest.fixture
def make_config(corpus, tmp_path):
    """make_config(training={"batch": 1}, ...): the small configuration with changes."""

    return lambda **changes: small_config(corpus, tmp_path / "run", changes)


@pytest.fixture
def motions(gesture, tmp_path):
    """motions(old=[4.0, 3.0], angry=[4.0]): a manifest of motion alone, seconds by style."""

    def make(**seconds: list[float]):
        items = []
        for style, lengths in seconds.items():
            for i, length in enumerate(lengths):
                path = tmp_path / f"{style}_{i}.bvh"
                gesture(length, seed=len(items)).save(path)
                label = style if style != "none" else None
                about = {"id": path.stem, "duration": length, "style": label}
                items.append(Item(audio=None, motion=path, **about))
        Manifest(items).save(tmp_path / "motions.jsonl")
        return tmp_path / "motions.jsonl"

    return make


@pytest.fixture
def batches_of():
    """batches_of(config, data=None, first=0): the batches of a stage with untrained networks."""

    def make(config: MultiresConfig, data: TrainingData | None = None, first: int = 0) -> Batches:
        data = load_training_data(config) if data is None else data
        width = data.conditions.width
        network = MultiresGenerator(data.representation, width, config.network)
        return Batches(data, config, network, first)

    return make


@pytest.fixture
def render(tmp_path, gesturekit):
    """render(model, *options): the command, which writes into out/."""
    where = ("--out", tmp_path / "out", "--existing", "replace")
    return lambda model, *options: gesturekit("render", "--model", model, *where, *options)


@pytest.fixture(scope="session")
def speakers(tmp_path_factory) -> Path:
    """The manifest of `write_speakers`."""
    return write_speakers(tmp_path_factory.mktemp("speakers"))


@pytest.fixture(scope="session")
def state_folder(speakers, tmp_path_factory) -> Path:
    """A model of theirs with a state of movement, which plays their fingers and faces."""
    return train(small_config(speakers, tmp_path_factory.mktemp("state") / "run", SETTINGS))


@pytest.fixture(scope="session")
def state_model(state_folder) -> gk.Model:
    return gk.load(state_folder)
