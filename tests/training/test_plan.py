"""The plan of a training: what it says, what it reads, and that it writes nothing."""

import json
import re

import pytest
from small_runs import small_values

from gesturekit.corpus import Item, Manifest

TIME = re.compile(r"Time.* \d+ (s|min)\b")
ARRAYS = re.compile(r"\d [kMG]?B\b.*")


@pytest.fixture
def plan(gesturekit, tmp_path, gesture, caplog):
    """plan(system, seconds, **settings): what the command says about motion of that length."""

    def make(system: str, seconds: float, **settings) -> str:
        gesture(seconds, 5.0).save(tmp_path / "a.npz")
        item = Item(id="a", audio=None, motion=tmp_path / "a.npz", duration=seconds)
        Manifest([item]).save(tmp_path / "c.jsonl")
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


def test_of_a_long_corpus_half_a_minute_is_read_and_the_size_of_arrays_is_said(plan, tmp_path):
    said = plan("diffusion", 80.0, in_memory=1.0, arrays=str(tmp_path / "arrays"))
    assert str(tmp_path / "arrays") in ARRAYS.search(said)[0]


def test_a_plan_says_that_its_folder_is_in_use(plan, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.yaml").write_text("system: diffusion\n")
    said = plan("diffusion", 20.0)
    assert re.search(f"(?=.*{tmp_path / 'run'})(?=.*out=)", said) and TIME.search(said)
