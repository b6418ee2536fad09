"""Held-out recordings: no part of training, and evaluated as `gesturekit evaluate` does it."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
from runs import logged as logged_by
from small_runs import small_values

import gesturekit as gk
from gesturekit.corpus import Item, Manifest
from gesturekit.motion import Skeleton

SETTINGS = {
    "multires": {"backend": "torch", "network": {"levels": 2}},
    "diffusion": {"unpaired": {"share": 0.5}, "training": {"updates": 2}},
}
HEARD = {"measure": True, "styles": {}, "features": {"extractors": [{"kind": "mfcc"}]}}
WITHOUT_SOUND = {"multires": {"features": None}, "diffusion": {"features": None, "unpaired": None}}


@pytest.fixture(scope="module")
def recordings(tmp_path_factory, gesture, write_pair) -> tuple[list[Item], list[Item]]:
    """Items to train on, and held-out ones on a rig, with styles and speakers, of their own.

    The held-out rig has no known body part, and the held-out sound has NaN in it.
    """
    folder = tmp_path_factory.mktemp("recordings")
    kinds = {"pair": (True, True), "speech": (True, False), "motion": (False, True)}
    training, held_out = [], []
    motion = gesture(3.0)
    names = tuple(f"bone{j}" for j in range(motion.skeleton.n_joints))
    strange = Skeleton(names, motion.skeleton.parents, 1.5 * motion.skeleton.offsets)
    for split in ("train", "valid", "test"):
        audio, bvh = write_pair(folder, split, 3.0)
        if split != "train":
            samples, rate = soundfile.read(audio)
            samples[rate] = np.nan
            soundfile.write(audio, samples, rate, subtype="FLOAT")
            replace(motion, skeleton=strange).save(bvh)
        for kind, (speaks, moves) in kinds.items():
            files = {"audio": audio if speaks else None, "motion": bvh if moves else None}
            labels = {"speaker": f"speaker of {split}", "style": f"style of {split}"}
            item = Item(id=f"{split}_{kind}", duration=3.0, split=split, **files, **labels)
            (training if split == "train" else held_out).append(item)
    return training, held_out


@pytest.mark.parametrize(
    "changes", [{}, pytest.param(WITHOUT_SOUND, marks=pytest.mark.stress)], ids=["speech", "motion"]
)
@pytest.mark.parametrize("system", SETTINGS)
def test_a_model_is_the_same_with_and_without_held_out_items(system, changes, recordings, tmp_path):
    training, held_out = recordings
    made = []
    for number, items in enumerate((training, training + held_out)):
        corpus = tmp_path / f"{number}.jsonl"
        Manifest(items).save(corpus)
        changed = (HEARD, SETTINGS[system], changes.get(system, {}))
        settings = small_values(system, corpus, tmp_path / f"run{number}", *changed)
        config = tmp_path / f"{number}.yaml"
        config.write_text(json.dumps(settings))
        folder = Path(gk.train(config))
        made.append([(folder / name).read_bytes() for name in ("model.safetensors", "config.yaml")])
    assert made[0] == made[1]


@pytest.fixture
def talks(tmp_path, write_pair) -> Path:
    """A manifest of recordings of one rig, in styles and of speakers: some are held out."""
    items = []
    for number, split in enumerate(["train", "train", "valid", "test", "test"]):
        name = f"{split}/{number}"
        audio, motion = write_pair(tmp_path / "talks", name, 3.0, seed=number)
        given = {"audio": audio, "audio_start": 1.0, "motion": motion, "motion_start": 1.0}
        labels = {"speaker": f"speaker {number % 2}", "style": f"style {number % 2}"}
        items.append(Item(id=name, duration=2.0, split=split, **given, **labels))
    Manifest(items).save(tmp_path / "talks.jsonl")
    return tmp_path / "talks.jsonl"


@pytest.fixture
def train(gesturekit, tmp_path) -> Callable[..., tuple[Path, str]]:
    """train(system, corpus, **changes): the run folder, and the last line of the command."""

    def run(system: str, corpus: Path, **changes: Any) -> tuple[Path, str]:
        folder = tmp_path / f"run of {system}"
        changes |= {"unpaired": None} if system == "diffusion" else {}
        settings = small_values(system, corpus, folder, HEARD, SETTINGS[system], changes)
        (tmp_path / "config.yaml").write_text(json.dumps(settings))
        done = gesturekit("train", tmp_path / "config.yaml")
        assert done.status == 0, done.err
        return folder, done.out.splitlines()[-1]

    return run


@pytest.mark.parametrize(
    "system", ["diffusion", pytest.param("multires", marks=pytest.mark.stress)]
)
def test_the_last_line_of_a_training_is_the_verdict_of_an_evaluation(
    system, talks, train, gesturekit, tmp_path
):
    run, said = train(system, talks)
    what, _, verdict = said.partition(": ")
    assert re.search(r"(?=.*\b2\b)(?=.*\b4 s)", what)
    assert said.removeprefix("Measured ") in (run / "model" / "README.md").read_text()
    rendered = tmp_path / "rendered"
    chosen = ("--corpus", talks, "--split", "test")
    gesturekit("render", *chosen, "--model", run, "--format", "npz", "--out", rendered).ok()
    report = ("--workers", 1, "--json", tmp_path / "found.json")
    assert gesturekit("evaluate", rendered, *chosen, *report).out.splitlines()[0] == verdict
    for name in ("test/3", "test/4"):
        ours, theirs = (gk.Motion.load(f / f"{name}.npz") for f in (run / "held_out", rendered))
        np.testing.assert_array_equal(ours.rotations, theirs.rotations)
    (logged,) = logged_by(run, "held_out")
    assert {"held_out/sync", "held_out/reach", "held_out/likeness"} <= logged.keys()
    evaluated = json.loads((tmp_path / "found.json").read_text())["models"][0]["figures"]
    for key, result in evaluated.items():
        if f"held_out/{key}" in logged:
            assert logged[f"held_out/{key}"] == pytest.approx(result["value"], rel=1e-6), key
