"""What a model that follows paths learns from: recordings on their paths, feet where they stood."""

from __future__ import annotations

import numpy as np
import pytest

from gesturekit.corpus import prepare
from gesturekit.diffusion.config import DiffusionConfig
from gesturekit.diffusion.training.loading import load_training_data
from gesturekit.evaluation.metrics.physical import foot_skate
from gesturekit.formats.tables.root_path import load_root_path
from gesturekit.motion import Motion
from gesturekit.motion.root_path import RootPath
from gesturekit.training.config import build


def training_data(folder, **changes):
    report = prepare([], folder / "c.jsonl", unpaired_motion=[folder], holdout=0.0)
    assert report.is_complete, report.problems
    values = {"system": "diffusion", "corpus": str(folder / "c.jsonl"), "features": None}
    return load_training_data(build(DiffusionConfig, {**values, "path": True, **changes}))


@pytest.fixture
def recorded(shared_data, tmp_path) -> Motion:
    """A walk, which lies in the folder as a.bvh."""
    walk = Motion.load(shared_data / "motion/bandai/dataset-1_bow_angry_001.bvh")
    walk.save(tmp_path / "a.bvh")
    return walk


def table(path: RootPath) -> str:
    rows = zip(np.arange(path.n_frames) / path.fps, *path.positions.T, path.headings, strict=True)
    lines = (f"{t:.6f},{x:.6f},{z:.6f},{np.degrees(angle):.6f}" for t, x, z, angle in rows)
    return "\n".join(["time,x,z,heading", *lines])


def test_hips_that_sway_about_their_path_do_not_make_feet_slide(recorded, tmp_path):
    data = training_data(tmp_path)
    assert [r.name for r in data.recordings] == ["a", "a (mirrored)"]
    for recording in data.recordings:
        motion = data.decode(recording.motion, recording.condition, 30.0)
        assert foot_skate(motion) < 1.25 * foot_skate(recorded)


def test_a_path_may_begin_at_an_origin_of_its_own(recorded, tmp_path):
    path = RootPath.of(recorded)
    moved = RootPath(path.positions - path.positions[0], path.headings, path.fps)
    (tmp_path / "a.path.csv").write_text(table(moved))
    data = training_data(tmp_path, augmentation={"mirror": False})
    (recording,) = data.recordings
    motion = data.decode(recording.motion, recording.condition, 30.0)
    assert foot_skate(motion) < 1.25 * foot_skate(recorded)


def test_every_phase_of_a_fast_recording_is_on_the_path_of_its_own_time(tmp_path, gesture):
    gesture(4.0, 60.0).save(tmp_path / "a.bvh")
    at = np.arange(240) / 60
    swing = RootPath(np.outer(at**2, [0.2, 0.1]), 0.3 * at**2, 60.0)
    (tmp_path / "a.path.csv").write_text(table(swing))
    assert load_root_path(tmp_path / "a.path.csv").fps == 60
    data = training_data(tmp_path, augmentation={"mirror": False})
    assert [r.name for r in data.recordings] == ["a", "a (phase 2)"]
    for phase, recording in enumerate(data.recordings):
        told = data.decode(recording.motion, recording.condition, 30.0)
        own = RootPath.of(told, side=data.representation.side)
        frames = np.arange(20, 80)
        speed = np.linalg.norm([0.2, 0.1]) * 2 * ((frames + 0.5) / 30 + phase / 60)
        assert own.speeds[20:80] == pytest.approx(speed, abs=2e-4)
