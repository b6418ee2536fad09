"""The plan of a training: what it says, what it reads, and that it writes nothing."""

import json
import re
from collections.abc import Callable
from functools import wraps
from types import SimpleNamespace

import numpy as np
import pytest
from small_runs import small_values

from gesturekit.corpus import Item, Manifest
from gesturekit.diffusion.training import trainer as diffusion
from gesturekit.multires.training import trainer as multires
from gesturekit.multires.training.windows import Batches
from gesturekit.training import trainer as training

TIME = re.compile(r"Time.* \d+ (s|min)\b")
LOUDNESS = {"kind": "logmel", "n_mels": 8}
ARRAYS = re.compile(r"[\d.]+ MB\b.*")


@pytest.fixture
def plan(gesturekit, tmp_path, gesture, write_speech, caplog):
    """plan(system, seconds, splits, **settings): what the command says about motion of that length,
    recorded once for each split."""

    def make(system: str, seconds: float, splits: tuple[str, ...] = ("train",), **settings) -> str:
        gesture(seconds, 30.0).save(tmp_path / "a.npz")
        write_speech(tmp_path / "a.wav", seconds)
        about = {"audio": tmp_path / "a.wav", "motion": tmp_path / "a.npz", "duration": seconds}
        items = [Item(id=f"a{i}", split=split, **about) for i, split in enumerate(splits)]
        Manifest(items).save(tmp_path / "c.jsonl")
        changes = {"features": None, "fps": 5, **settings}
        values = small_values(system, tmp_path / "c.jsonl", tmp_path / "run", changes)
        (tmp_path / "config.yaml").write_text(json.dumps(values))
        before = {path.name for path in tmp_path.iterdir()}
        with caplog.at_level("INFO"):
            gesturekit("train", tmp_path / "config.yaml", "--plan").ok()
        assert {path.name for path in tmp_path.iterdir()} == before
        return caplog.text

    return make


@pytest.mark.parametrize("system", ["diffusion", "multires"])
def test_a_plan_says_how_long_it_takes_and_writes_nothing(plan, system):
    said = plan(system, 20.0)
    assert TIME.search(said) and not ARRAYS.search(said)


@pytest.mark.parametrize(
    ("system", "fps", "features"),
    [
        ("diffusion", 20, None),
        ("multires", 20, None),
        ("diffusion", 15, {"extractors": [LOUDNESS]}),
    ],
)
def test_of_a_long_corpus_half_a_minute_is_read_and_the_size_of_arrays_is_said(
    plan, gesturekit, tmp_path, system, fps, features
):
    """A recording at twice the model's frame rate is two sequences for diffusion."""
    settings = {"fps": fps, "features": features, "arrays": str(tmp_path / "arrays")}
    said = ARRAYS.search(plan(system, 90.0, in_memory=1.0, **settings))
    assert str(tmp_path / "arrays") in said[0]
    gesturekit("train", tmp_path / "config.yaml", "--arrays").ok()
    size = sum(np.load(path).nbytes for path in (tmp_path / "arrays").rglob("*.npy"))
    assert said[0].startswith(f"{size / 1e6:.1f} MB") and size > 5e5


def test_a_plan_says_that_its_folder_is_in_use(plan, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.yaml").write_text("system: diffusion\n")
    said = plan("diffusion", 20.0)
    assert re.search(f"(?=.*{tmp_path / 'run'})(?=.*out=)", said) and TIME.search(said)


def test_a_plan_of_a_run_in_a_file_is_refused(gesturekit, plan, tmp_path):
    plan("diffusion", 20.0)
    (tmp_path / "run").write_text("mine")
    gesturekit("train", tmp_path / "config.yaml", "--plan").fails(2, str(tmp_path / "run"))


@pytest.fixture
def timed(monkeypatch) -> Callable[..., None]:
    """timed(owner, name, seconds): make a function take that long, and 100 s more when it warms up,
    on a clock on which the process has taken 5 s and nothing else takes any time."""
    clock = SimpleNamespace(now=0.0)
    fake = SimpleNamespace(monotonic=lambda: clock.now, process_time=lambda: 5.0)
    for module in (training, multires):
        monkeypatch.setattr(module, "time", fake)

    def patch(owner: object, name: str, seconds: float, *, warm_up: bool = False) -> None:
        work, extra = getattr(owner, name), [100.0] * warm_up

        @wraps(work)
        def slow(*args, **options):
            clock.now += seconds + (extra.pop() if extra else 0.0)
            return work(*args, **options)

        monkeypatch.setattr(owner, name, slow)

    return patch


@pytest.mark.parametrize("system", ["diffusion", "multires"])
def test_the_times_of_parts_are_those_of_the_whole_corpus(plan, timed, system):
    """Four recordings of 80 s at 20 fps: three to train on, of which 30 s of one are timed."""
    timed(Item, "load_motion", 2.0)
    timed(diffusion.Trainer, "read_data", 1.0)
    timed(multires.Trainer, "read_data", 1.0)
    timed(diffusion.Trainer, "_update", 5.0, warm_up=True)
    timed(multires.Trainer.state, "func", 1.0)
    timed(multires.Stage, "__init__", 1.0)
    timed(Batches, "renew", 1.0, warm_up=True)
    timed(multires.Stage, "iterate", 0.25, warm_up=True)
    window = 2.0 if system == "diffusion" else None
    said = plan(
        system,
        80.0,
        ("train", "train", "train", "test"),
        **{"fps": 20.0, "in_memory": 2.0, "workers": 2, "measure": True},
        training={"window": window},
    )
    # Each file is read whole, features of 30 s are extracted: of 240 s in all, of which two minutes
    # are read again.
    reading = 3 * 2.0 + 240 / 30 * 1.0
    assert f"missing takes about {reading / 2:.0f} s" in said
    if system == "diffusion":
        steps = 6 * 5.0
    else:
        # Two stages of 6 and 4 iterations, which renew their windows every three: statistics of two
        # minutes, targets of 2048 frames, and iterations on recordings that are longer than 30 s.
        steps = 1.0 * 120 / 30 + 2 * 1.0 * 2048 / 600 + 4 * 1.0 + 10 * (1.0 + 0.25) * 80 / 30
    seconds = 5.0 + reading * 120 / 240 + steps + 0.1 * 80
    assert f"about {seconds:.0f} s on this machine" in said
    assert f"{0.8 * seconds:.0f} s to {2 * seconds / 60:.0f} min" in said
