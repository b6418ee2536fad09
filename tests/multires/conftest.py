"""A pyramid of few channels, on the corpus of seconds: a run takes seconds too."""

from __future__ import annotations

import json

import pytest

from gesturekit.cli import main
from gesturekit.multires.config import MultiresConfig
from gesturekit.multires.network.generator import MultiresGenerator
from gesturekit.multires.network.skeleton_conv import convolve_dense
from gesturekit.multires.training.batches import Batches
from gesturekit.multires.training.data import TrainingData
from gesturekit.multires.training.loading import load_training_data
from gesturekit.multires.training.window_cache import WindowCache
from gesturekit.training.config import build

SMALL = {
    "system": "multires",
    "threads": 1,
    "network": {"levels": 4, "channels": [2, 2, 2], "embedding": 8},
    "training": {
        "first_stage": 6,
        "further_stages": 4,
        "discriminator_steps": 1,
        "batch": 2,
        "window": 3.0,
        "window_cache": 4,
        "renew_every": 3,
        "learning_rate": 1e-3,
    },
    "checkpoint_every": 5,
    "log_every": 2,
}


@pytest.fixture
def make_config(corpus, tmp_path):
    """make_config(training={"batch": 1}, ...): the small configuration with changes."""

    def make(**changes) -> MultiresConfig:
        values = {**SMALL, "corpus": str(corpus), "out": str(tmp_path / "run")}
        for key, value in changes.items():
            values[key] = {**values.get(key, {}), **value} if isinstance(value, dict) else value
        return build(MultiresConfig, values)

    return make


@pytest.fixture
def motions(gesture, tmp_path):
    """motions(old=[4.0, 3.0], angry=[4.0]): a manifest of motion alone, seconds by style."""

    def make(**seconds: list[float]):
        items = []
        for style, lengths in seconds.items():
            for i, length in enumerate(lengths):
                name = f"{style}_{i}"
                gesture(length, seed=len(items)).save(tmp_path / f"{name}.bvh")
                items.append({"id": name, "motion": f"{name}.bvh", "duration": length})
                items[-1] |= {"style": style if style != "none" else None, "split": "train"}
        blank = {"audio": None, "audio_start": 0.0, "motion_start": 0.0, "speaker": None}
        blank |= {"text": None, "mirror": False, "conditions": {}}
        path = tmp_path / "motions.jsonl"
        lines = [{"schema": 1}, *({**blank, **item} for item in items)]
        path.write_text("".join(json.dumps(line) + "\n" for line in lines))
        return path

    return make


@pytest.fixture
def cache_of():
    """cache_of(config, data=None): the window cache of a run with untrained networks."""

    def make(config: MultiresConfig, data: TrainingData | None = None) -> WindowCache:
        data = load_training_data(config) if data is None else data
        width = data.conditions(config).width
        network = MultiresGenerator(data.representation, width, config.network)
        return WindowCache(data, config, network)

    return make


@pytest.fixture
def batches_of(cache_of):
    """batches_of(config, data=None, first=0): the batches of a stage with untrained networks."""

    def make(config: MultiresConfig, data: TrainingData | None = None, first: int = 0) -> Batches:
        cache = cache_of(config, data)
        return Batches(cache.data, config, cache.network, first, convolve_dense)

    return make


@pytest.fixture
def render(tmp_path, capsys):
    """render(model, *options): exit code of the command, which writes into out/; and its errors."""

    def run(model, *options) -> tuple[int, str]:
        where = ["--model", str(model), "--out", str(tmp_path / "out"), "--existing", "replace"]
        with pytest.raises(SystemExit) as left:
            main(["render", *where, *map(str, options)])
        return left.value.code, capsys.readouterr().err

    return run
