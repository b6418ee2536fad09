"""Measurements are kept by content, and are the same for any number of processes."""

import shutil
import time
from pathlib import Path

import pytest

from gesturekit.corpus import Item, Manifest
from gesturekit.evaluation import Variants, evaluate
from gesturekit.motion import Motion


@pytest.fixture
def folders(tmp_path, gesture, write_pair, monkeypatch) -> Path:
    """Two recordings with sound, and clips of two models; an empty cache."""
    monkeypatch.setenv("GESTUREKIT_CACHE", str(tmp_path / "cache"))
    for i in range(2):
        write_pair(tmp_path / "recordings", f"clip{i}", 2.0, fps=15.0, seed=i)
        for k, model in enumerate(("ours", "other"), start=1):
            gesture(2.0, 15.0, seed=10 * k + i).save(tmp_path / model / f"clip{i}.npz")
    return tmp_path


@pytest.fixture
def measured(folders):
    """measured(models, **options): an evaluation, and how many measurements it kept."""

    def kept() -> set[Path]:
        return {path for path in (folders / "cache").rglob("*") if path.is_file()}

    def run(models, reference: Path = folders / "recordings", **options):
        before = kept()
        found = evaluate(models, reference, **{"cheap": True} | options)
        return found, len(kept() - before)

    return run


def test_a_model_added_is_measured_alone_and_a_rerun_measures_nothing(folders, measured):
    one, first = measured({"ours": folders / "ours"})
    models = {"ours": folders / "ours", "other": folders / "other"}
    both, added = measured(models)
    assert 0 < added < first and both.to_json()["models"][0] == one.to_json()["models"][0]
    again, added = measured(models)
    assert added == 0 and again.to_json() == both.to_json()


def test_content_counts_and_names_do_not(folders, measured):
    first = measured(folders / "ours")[1]
    copy = shutil.copytree(folders / "ours", folders / "a copy")
    assert measured({"copy": copy})[1] == 0
    Motion.load(copy / "clip1.npz")[:24].save(copy / "clip1.npz")
    assert 0 < measured({"copy": copy})[1] < first
    # Another recording changes the joint limits that every clip is measured against.
    changed = folders / "recordings" / "clip1.bvh"
    Motion.load(changed)[:21].save(changed)
    assert measured(folders / "ours")[1] > 0


def test_options_and_sounds_count_where_they_matter(folders, measured, write_speech):
    sound = {"audio": folders / "recordings"}
    first = measured(folders / "ours", **sound)[1]
    assert 0 < measured(folders / "ours", **sound, seed=1)[1] < first, "no clip has a seed"
    multires = {"protocol": "multires"}
    whole = multires | {"cheap": False}
    for options in (multires, whole, whole | {"variants": Variants("paper")}):
        assert measured(folders / "ours", **options)[1] > 0, options
        assert measured(folders / "ours", **options)[1] == 0, options
    # Each clip is measured with the sounds of the others too.
    write_speech(folders / "recordings" / "clip1.wav", 1.5)
    assert measured(folders / "ours", **sound)[1] > 1


def test_the_part_of_a_file_that_an_item_is_counts(folders, measured, gesture):
    motion, made = folders / "whole.npz", folders / "made"
    gesture(4.0, 15.0, seed=4).save(motion)

    def added(**changes) -> int:
        items = [Item(**{"id": f"i{k}", "audio": None, "motion": motion, "duration": 1.0,
                         "motion_start": 1.0 * k, "split": "test", **(changes if k else {})})
                 for k in range(2)]  # fmt: skip
        Manifest(items).save(folders / "corpus.jsonl")
        for item in items:
            gesture(1.0, 15.0, seed=5).save(made / f"{item.id}.npz")
        return measured(made, folders / "corpus.jsonl")[1]

    assert added() > 0 and added() == added(text="other words") == 0
    assert added(motion_start=2.0) > 0 and added(duration=0.8) > 0 and added(mirror=True) > 0
    # Training motion of the same speaker is chosen by name, and names stand in the result.
    assert added(speaker="ann") > 0 and added(speaker="maya") > 0


def test_damaged_entries_are_measured_again(folders, measured, caplog):
    first, _ = measured(folders / "ours")
    entries = [path for path in (folders / "cache").rglob("*") if path.is_file()]
    for entry in entries:
        entry.write_bytes(entry.read_bytes()[:-20])
    again, _ = measured(folders / "ours")
    assert again.to_json() == first.to_json()
    assert str(folders / "cache") in caplog.text and "damaged" in caplog.text


@pytest.mark.stress
def test_worker_processes_give_the_same_figures(folders, tmp_path, monkeypatch):
    models = {label: folders / label for label in ("ours", "other")}
    options = {"audio": folders / "recordings", "baselines": ("mean_pose",)}
    one = evaluate(models, folders / "recordings", **options).to_json()
    monkeypatch.setenv("GESTUREKIT_CACHE", str(tmp_path / "another"))
    seen = []

    def progress(portions, total, label):
        for portion in portions:
            seen.append((label, total))
            if len(seen) == 1:
                time.sleep(4.5)  # what takes no more than some seconds needs no processes
            yield portion

    two = evaluate(models, folders / "recordings", workers=2, progress=progress, **options)
    assert two.to_json() == one
    assert len(seen) == seen[0][1], "each portion is reported"
