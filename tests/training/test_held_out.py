"""Held-out recordings: no part of training, and evaluated as `gesturekit evaluate` does it."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
from small_runs import small_values

import gesturekit as gk
from gesturekit.corpus.item import Item
from gesturekit.corpus.manifest import Manifest
from gesturekit.evaluation.statistics.questions import answers, verdict
from gesturekit.motion import Skeleton

SETTINGS = {
    "multires": {"backend": "torch", "network": {"levels": 2}},
    "diffusion": {"unpaired": {"share": 0.5}, "training": {"updates": 2}},
}
HEARD = {"styles": {}, "features": {"extractors": [{"kind": "mfcc"}]}}
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


@pytest.mark.parametrize("changes", [{}, WITHOUT_SOUND], ids=["speech", "motion alone"])
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
        audio, motion = write_pair(tmp_path / "talks", name, 5.0 + number, seed=number)
        items.append(
            Item(
                id=name,
                audio=audio,
                motion=motion,
                audio_start=1.0,
                motion_start=1.0,
                duration=4.0 + number,
                speaker=f"speaker {number % 2}",
                style=f"style {number % 2}",
                split=split,
            )
        )
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


def arrays(file: Path) -> dict[str, np.ndarray]:
    with np.load(file) as archive:
        return {name: archive[name] for name in ("rotations", "translation", "fps")}


@pytest.mark.parametrize("system", SETTINGS)
def test_the_last_line_of_a_training_is_the_verdict_of_an_evaluation(
    system, talks, train, gesturekit, tmp_path, caplog
):
    caplog.set_level("INFO")
    run, said = train(system, talks)
    what, _, verdict = said.partition(": ")
    assert what == "Measured on 2 held-out recordings (15 s)" and len(verdict) > 20
    assert verdict not in caplog.text  # a terminal shows both streams
    card = (run / "model" / "README.md").read_text()
    assert f"- **Measured**: {said.removeprefix('Measured ')}\n" in card
    command = shlex.split(caplog.text.partition("All metrics on ")[2].partition("kit ")[2])
    kept = gesturekit(*command[:4], "--workers", 1, "--json", tmp_path / "kept.json")
    assert kept.out.splitlines()[0] == verdict
    rendered = tmp_path / "rendered"
    chosen = ("--corpus", talks, "--split", "test")
    made = gesturekit("render", *chosen, "--model", run, "--format", "npz", "--out", rendered)
    assert made.status == 0, made.err
    assert gesturekit("evaluate", rendered, *chosen, "--workers", 1).out.splitlines()[0] == verdict
    for name in ("test/3", "test/4"):
        ours, theirs = (arrays(f / f"{name}.npz") for f in (run / "held_out", rendered))
        assert all(np.array_equal(ours[key], theirs[key]) for key in ours), name
    assert not list(run.glob(".*"))
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    (logged,) = (line for line in lines if line.get("kind") == "held_out")
    evaluated = json.loads((tmp_path / "kept.json").read_text())["models"][0]["figures"]
    assert {"held_out/sync", "held_out/reach", "held_out/likeness"} <= logged.keys()
    for key, result in evaluated.items():
        if f"held_out/{key}" in logged:
            assert logged[f"held_out/{key}"] == pytest.approx(result["value"], rel=1e-6), key


def test_without_held_out_items_training_items_are_measured(talks, train, gesturekit, tmp_path):
    items = [replace(item, split="train") for item in Manifest.load(talks)]
    Manifest(items).save(tmp_path / "all.jsonl")
    run, said = train("diffusion", tmp_path / "all.jsonl")
    assert said.startswith("Measured on 5 training recordings (30 s): ")
    folder = run / "recorded"
    done = gesturekit("evaluate", folder, "--corpus", folder / "corpus.jsonl", "--split", "train")
    assert done.out.splitlines()[0] == said.partition(": ")[2]
    assert not (run / "held_out").exists()


class Asked(dict):
    """A mapping that keeps the keys it was asked for."""

    def get(self, key: str, default: Any = None) -> Any:
        self.setdefault("", set()).add(key)
        return super().get(key, default)


def test_cheap_metrics_are_all_that_verdict_and_answers_ask_for(tmp_path, gesture, write_pair):
    for number in range(2):
        _, recording = write_pair(tmp_path / "recorded", f"{number}", 20.0, seed=number)
        for sample in (1, 2):
            made = gesture(20.0, seed=10 * sample + number)
            made.save(tmp_path / "made" / f"{number}_s{sample}.npz")
    folders = tmp_path / "made", recording.parent
    whole, cheap = (
        gk.evaluate(*folders, audio=recording.parent, cheap=cheap).models[0]
        for cheap in (False, True)
    )
    assert set(cheap.metrics) < set(whole.metrics) and "coverage" not in cheap.metrics
    assert cheap.verdict == whole.verdict
    asked = Asked(whole.metrics)
    assert verdict(asked) == whole.verdict
    for key in asked[""] & whole.metrics.keys():
        assert cheap.metrics[key] == whole.metrics[key], key
    assert [a.state for a in cheap.answers] == [a.state for a in whole.answers]
    asked = Asked(whole.metrics)
    assert answers(whole.clips, asked) == whole.answers
    in_words_only = {"inter_diversity"}
    for key in (asked[""] & whole.metrics.keys()) - in_words_only:
        assert cheap.metrics[key] == whole.metrics[key], key
