"""Held-out recordings: no part of training, and the metrics on them in words."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
from small_runs import small_values

import gesturekit as gk
from gesturekit.corpus.item import Item
from gesturekit.corpus.manifest import Manifest
from gesturekit.motion import Skeleton
from gesturekit.training.run.held_out import sentence

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


def test_sync_of_arms_that_hardly_move_is_not_praised():
    figures = {"sync": 0.79, "sync_chance": 0.2, "arm_speed_ratio": 0.01}
    assert "hardly move, so sync is not informative" in sentence(figures)
    assert "0.79" not in sentence(figures)
    assert "sync 0.79" in sentence(figures | {"arm_speed_ratio": 0.6})
