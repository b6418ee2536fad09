"""gesturekit prepare and fit-features: exit codes, and one clear line a problem."""

import re
from pathlib import Path

import pytest

from gesturekit.corpus import Manifest
from gesturekit.evaluation import FeatureModel
from gesturekit.inspection import inspect


@pytest.fixture
def recordings(tmp_path: Path, write_pair) -> Path:
    for seed, name in enumerate("abc"):
        write_pair(tmp_path / "recordings", name, 2.0, seed=seed)
    return tmp_path / "recordings"


@pytest.fixture
def prepare(gesturekit, tmp_path):
    """prepare(*arguments): the command, into tmp_path/corpus.jsonl."""
    return lambda *arguments: gesturekit("prepare", *arguments, "--out", tmp_path / "corpus.jsonl")


def test_all_recordings_are_used(prepare, recordings, tmp_path):
    done = prepare(recordings, "--style", "calm")
    assert (done.status, done.err) == (0, "")
    assert re.search(r"(?=.*3 recordings)(?=.*\b6(\.0)? s)(?=.*\btrain\b)(?=.*\btest\b)", done.out)
    splits = [item.split for item in Manifest.load(tmp_path / "corpus.jsonl")]
    assert sorted(splits) == ["test", "train", "train"]


def test_some_files_are_left_out(prepare, recordings):
    (recordings / "a.wav").write_text("no sound")
    (recordings / "alone.wav").write_bytes((recordings / "b.wav").read_bytes())
    done = prepare(recordings, "--holdout", "0")
    done.fails(1, str(recordings / "a.wav"), "alone.wav")
    assert "2 recordings" in done.out


def test_nothing_can_start(prepare):
    for arguments, says in (
        ([], "FOLDER"),
        (["nowhere"], "nowhere"),
        (["--style-pattern", "(", "."], "pattern"),
        (["--holdout", "1", "."], "--holdout"),
    ):
        prepare(*arguments).fails(2, says)


def test_nothing_usable(prepare, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("e").mkdir()
    prepare("e").fails(2, ".wav", ".npz")
    assert not (tmp_path / "corpus.jsonl").exists()


def test_the_height_asked_for_is_kept_in_the_manifest(prepare, recordings, tmp_path):
    done = prepare(recordings, "--height", "1.2", "--in-up", "y")
    assert (done.status, done.err) == (0, "")
    reading = {"up": "y", "height": 1.2}
    assert all(item.reading == reading for item in Manifest.load(tmp_path / "corpus.jsonl"))
    shown = dict(inspect(tmp_path / "corpus.jsonl").rows)["reading"]
    assert "up" in shown and "1.2" in shown
    prepare(recordings)
    assert not any(item.reading for item in Manifest.load(tmp_path / "corpus.jsonl"))


@pytest.fixture(scope="module")
def motions(tmp_path_factory, gesture):
    folder = tmp_path_factory.mktemp("motions")
    for number in range(2):
        gesture(4.0, seed=number).save(folder / f"{number}.bvh")
    return folder


def test_a_model_is_written_and_its_fingerprint_printed(gesturekit, motions, tmp_path):
    fit = ("fit-features", motions, "--variant", "yoon", "--steps", 2, "--out")
    done = gesturekit(*fit, tmp_path / "one").ok()
    fingerprint = FeatureModel.load(tmp_path / "one").fingerprint
    for fact in (fingerprint, str(tmp_path / "one"), "yoon", "34 frames", "15 fps"):
        assert fact in done.out
    kept = gesturekit(*fit, tmp_path / "one", "--existing", "skip").ok()
    assert kept.out == "" and str(tmp_path / "one") in kept.err
    for more, is_same in (((), True), (("--seed", 1), False), (("--frames", 16), False)):
        other = gesturekit(*fit, tmp_path / "two", "--existing", "replace", *more).ok()
        assert (fingerprint in other.out) == is_same
    assert "16 frames" in other.out


def test_unreadable_files_are_listed_and_left_out(gesturekit, motions, tmp_path):
    broken = tmp_path / "broken.bvh"
    broken.write_text("HIERARCHY\nROOT", encoding="utf-8")
    joints = ("--joints", "LeftArm, LeftForeArm,LeftHand", "--steps", 2)
    done = gesturekit("fit-features", motions, broken, "--out", tmp_path / "m", *joints).fails(1)
    assert "broken.bvh" in done.err
    fitted = FeatureModel.load(tmp_path / "m")
    assert fitted.training["motions"] == 2 and len(fitted.windows.bones) == 3
    done = gesturekit("fit-features", broken, tmp_path / "none.bvh", "--out", tmp_path / "n")
    done.fails(2, "none.bvh", "no motion")
    assert not (tmp_path / "n").exists()


def test_invalid_options_are_one_line(gesturekit, motions, tmp_path):
    for options, message in (
        (["--frames", 3], "3 frames"),
        (["--joints", "Wing"], "'Wing'"),
        (["--variant", "vae"], "'vae'"),
        (["--steps", 0], "--steps"),
    ):
        gesturekit("fit-features", motions, "--out", tmp_path / "m", *options).fails(2, message)
        assert not (tmp_path / "m").exists()
