"""Measurements are kept by content, and are the same for any number of processes."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gesturekit.evaluation import evaluate
from gesturekit.evaluation.measuring import work
from gesturekit.evaluation.measuring.inputs import ReferenceStatistics
from gesturekit.evaluation.measuring.measurer import Measurer
from gesturekit.evaluation.metrics.physical import JointLimits
from gesturekit.evaluation.metrics.rhythm import central_speed
from gesturekit.motion import Motion


@pytest.fixture(autouse=True)
def _cache(tmp_path, monkeypatch):
    monkeypatch.setenv("GESTUREKIT_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def folders(tmp_path, gesture, write_pair) -> Path:
    for i in range(3):
        write_pair(tmp_path / "recordings", f"clip{i}", 3.0, fps=25.0, seed=i)
        for k, model in enumerate(("ours", "other"), start=1):
            gesture(3.0, 25.0, seed=10 * k + i).save(tmp_path / model / f"clip{i}.npz")
    return tmp_path


@pytest.fixture
def measured(monkeypatch) -> list[tuple[str, ...]]:
    """(label, name of the clip) or (label, part of the set) of everything that is measured."""
    done: list[tuple[str, ...]] = []
    clip, set_ = Measurer.clip, Measurer.set

    def count_clip(self, label, index):
        done.append((label, self.pairs[label][index].name))
        return clip(self, label, index)

    def count_set(self, task):
        done.append((task.label, task.part))
        return set_(self, task)

    monkeypatch.setattr(Measurer, "clip", count_clip)
    monkeypatch.setattr(Measurer, "set", count_set)
    return done


def test_a_rerun_with_a_model_added_measures_that_one_alone(folders, measured):
    def run(**models: str):
        places = {label: folders / name for label, name in models.items()}
        return evaluate(places, folders / "recordings", audio=folders / "recordings")

    first = run(ours="ours")
    assert len(measured) == 3 + 2
    measured.clear()
    both = run(ours="ours", other="other")
    assert {label for label, _ in measured} == {"other"} and len(measured) == 3 + 2
    assert both.to_json()["models"][0] == first.to_json()["models"][0]
    measured.clear()
    again = run(ours="ours", other="other")
    assert not measured
    assert again.to_json() == both.to_json()


def test_content_counts_and_names_do_not(folders, measured):
    evaluate(folders / "ours", folders / "recordings")
    measured.clear()
    shutil.copytree(folders / "ours", folders / "a copy")
    evaluate({"copy": folders / "a copy"}, folders / "recordings")
    assert not measured
    changed = folders / "a copy" / "clip1.npz"
    Motion.load(changed)[:70].save(changed)
    evaluate({"copy": folders / "a copy"}, folders / "recordings")
    assert sorted(measured) == [("copy", "clip1"), ("copy", "frechet"), ("copy", "pooled")]
    measured.clear()
    # Another recording changes the joint limits that every clip is measured against.
    changed = folders / "recordings" / "clip1.bvh"
    Motion.load(changed)[:40].save(changed)
    evaluate(folders / "ours", folders / "recordings")
    assert len(measured) == 3 + 2


def test_a_damaged_entry_is_measured_again(folders, measured, caplog):
    first = evaluate(folders / "ours", folders / "recordings").to_json()
    entries = sorted((folders / "cache" / "measurements-1").rglob("*.json"))
    assert len(entries) == 3 + 2 + 2  # and the recordings' own values and levels
    for entry in entries:
        entry.write_text(entry.read_text()[:-20])
    measured.clear()
    assert evaluate(folders / "ours", folders / "recordings").to_json() == first
    assert len(measured) == 3 + 2 and "measuring again" in caplog.text


def test_worker_processes_give_the_same_figures(folders, tmp_path, monkeypatch):
    models = {label: folders / label for label in ("ours", "other")}
    options = {"audio": folders / "recordings", "baselines": ("mean_pose",)}
    one = evaluate(models, folders / "recordings", **options).to_json()
    monkeypatch.setenv("GESTUREKIT_CACHE", str(tmp_path / "another"))
    monkeypatch.setattr(work, "IN_PROCESS_SECONDS", 0.0)
    seen = []

    def progress(tasks, total, label):
        for task in tasks:
            seen.append((label, total))
            yield task

    two = evaluate(models, folders / "recordings", workers=2, progress=progress, **options)
    assert two.to_json() == one
    # Three recordings of two models, three of the baseline, and a chain of sets of each kind: two
    # workers never hold the motion of two sets at a time.
    assert seen == [("measuring", 8)] * 8


def test_a_digest_of_statistics_follows_every_number_and_name_in_them():
    limits = JointLimits(("a", "b"), np.zeros((2, 4)), np.ones((2, 3)), np.full((2, 3), 2.0))
    known = ReferenceStatistics(["r"], limits, {"a": 1.0, "b": 2.0})
    same = ReferenceStatistics(["other"], replace(limits), {"b": 2.0, "a": 1.0})
    assert same.digest() == known.digest(), "files and the order of joints do not count"
    others = [replace(known, limits=None), replace(known, mean_speed={"a": 1.0, "b": 2.5})]
    others += [replace(known, mean_speed={"a": 1.0, "c": 2.0})]
    for changes in ({"joints": ("b", "a")}, {"mean": limits.mean + 0.1}, {"low": -limits.low}):
        others.append(replace(known, limits=replace(limits, **changes)))
    others.append(replace(known, limits=replace(limits, high=limits.high.copy() * 1.01)))
    assert len({one.digest() for one in (known, *others)}) == len(others) + 1


def test_statistics_are_those_of_recordings_on_one_rig(folders, quadruped):
    """Two of three recordings are whole, and one is of an animal."""
    files = {path.stem: path for path in sorted((folders / "recordings").glob("*.bvh"))}
    files["clip1"].write_text("HIERARCHY")
    still = np.tile([0.0, 0, 0, 1], (50, quadruped.n_joints, 1))
    Motion(quadruped, still, np.zeros((50, 3)), 25.0).save(folders / "horse.npz")
    statistics = ReferenceStatistics.of({**files, "horse": folders / "horse.npz"}, 25.0)
    assert statistics.recordings == ["clip0", "clip2"]
    assert [one.name for one in statistics.excluded] == ["clip1", "horse"]
    two = [Motion.load(files[name]) for name in statistics.recordings]
    # The body's own turn is no joint's range, and no joint's local speed.
    assert set(statistics.limits.joints) == set(statistics.mean_speed) - {two[0].skeleton.names[0]}
    speeds = [central_speed(motion, tuple(statistics.mean_speed)) for motion in two]
    mean = np.concatenate(speeds).mean(axis=0)
    np.testing.assert_allclose(list(statistics.mean_speed.values()), mean, rtol=1e-9)
