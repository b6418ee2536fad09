"""gesturekit prepare and fit-features: exit codes, and one clear line a problem."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

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
    assert "paired        3 recordings, 6.0 s: train 2 (4.0 s), test 1 (2.0 s)" in done.out
    assert (tmp_path / "corpus.jsonl").is_file()


def test_some_files_are_left_out(prepare, recordings):
    (recordings / "a.wav").write_text("no sound")
    (recordings / "alone.wav").write_bytes((recordings / "b.wav").read_bytes())
    done = prepare(recordings, "--holdout", "0").fails(1)
    broken, alone = done.err.splitlines()
    assert broken.startswith("error: ") and str(recordings / "a.wav") in broken
    assert alone.startswith("left out: speech without motion") and "alone.wav" in alone
    assert "paired        2 recordings" in done.out
    assert "left out      1 recording with errors, 1 file not used" in done.out


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["nowhere"],
        ["--hold-out-seconds", "ten", "."],
        ["--style-pattern", "(", "."],
        ["--holdout", "1", "."],
    ],
)
def test_nothing_can_start(prepare, arguments):
    prepare(*arguments).fails(2, "Error: ")


def test_nothing_usable(prepare, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("e").mkdir()
    prepare("e").fails(2, "no usable recording", "warning: e: neither sound (.wav, ", ".npz")
    assert not (tmp_path / "corpus.jsonl").exists()


def test_the_height_asked_for_is_kept_in_the_manifest(prepare, recordings, tmp_path):
    done = prepare(recordings, "--height", "1.2", "--in-up", "y")
    assert (done.status, done.err) == (0, "")
    assert '"reading": {"up": "y", "height": 1.2}' in (tmp_path / "corpus.jsonl").read_text()
    summary = inspect(tmp_path / "corpus.jsonl")
    assert dict(summary.rows)["reading"] == "up y, height 1.2 (3)"
    prepare(recordings)
    assert "reading" not in (tmp_path / "corpus.jsonl").read_text()


@pytest.fixture(scope="module")
def motions(tmp_path_factory, gesture):
    folder = tmp_path_factory.mktemp("motions")
    for number in range(2):
        gesture(4.0, seed=number).save(folder / f"{number}.bvh")
    return folder


def test_a_model_is_written_and_its_fingerprint_printed(gesturekit, motions, tmp_path):
    options = ("--frames", 30, "--steps", 3)
    done = gesturekit("fit-features", motions, "--out", tmp_path / "one", *options).ok()
    fingerprint = FeatureModel.load(tmp_path / "one").fingerprint
    assert done.out.splitlines()[-1] == f"Fingerprint: {fingerprint}"
    assert "genea, 30 frames at 30 fps" in done.out
    files = motions / "0.bvh", motions / "1.bvh"
    done = gesturekit("fit-features", *files, "--out", tmp_path / "two", *options)
    assert done.out.splitlines()[-1] == f"Fingerprint: {fingerprint}"


def test_variants_seeds_and_what_is_kept(gesturekit, motions, tmp_path):
    fit = ("fit-features", motions, "--steps", 2, "--variant", "yoon", "--out")
    first = gesturekit(*fit, tmp_path / "one").ok().out
    assert f"{tmp_path / 'one'}: yoon, 34 frames at 15 fps, " in first
    assert "Fitted on a random" not in first
    other = gesturekit(*fit, tmp_path / "two", "--seed", 1).ok().out
    assert first.splitlines()[-1] != other.splitlines()[-1]
    kept = gesturekit(*fit, tmp_path / "one", "--existing", "skip").ok()
    assert kept.out == "" and "skipped, exists already" in kept.err
    upper = ("--joints", "upper", "--existing", "replace")
    whole = gesturekit(*fit, tmp_path / "three", "--variant", "genea").ok().out
    half = gesturekit(*fit, tmp_path / "one", "--variant", "genea", *upper).ok().out
    bones = [int(re.search(r"(\d+) bones", text)[1]) for text in (whole, half)]
    assert bones[1] < bones[0]


def test_joints_by_name(gesturekit, motions, tmp_path):
    joints = ("--joints", "LeftArm, LeftForeArm,LeftHand")
    done = gesturekit("fit-features", motions, "--out", tmp_path, "--steps", 2, *joints)
    assert done.status == 0 and len(FeatureModel.load(tmp_path).windows.bones) == 3


def test_unreadable_files_are_listed_and_left_out(gesturekit, motions, tmp_path):
    broken = tmp_path / "broken.bvh"
    broken.write_text("HIERARCHY\nROOT", encoding="utf-8")
    done = gesturekit("fit-features", motions, broken, "--out", tmp_path / "m", "--steps", 2)
    assert done.status == 1 and done.err.count("Error: ") == 1 and "broken.bvh" in done.err
    assert FeatureModel.load(tmp_path / "m").training["motions"] == 2
    folder = tmp_path / "folder"
    folder.mkdir()
    shutil.copy(motions / "0.bvh", folder)
    (folder / "a\tb.bvh").write_text("x")  # a name that is refused
    (folder / "a.wav").write_bytes(b"x")
    done = gesturekit("fit-features", folder, "--out", tmp_path / "f", "--steps", 2)
    assert done.status == 1 and done.err.count("Error: ") == 1 and "rename it" in done.err
    done = gesturekit("fit-features", broken, tmp_path / "none.bvh", "--out", tmp_path / "n")
    assert done.status == 2 and "no motion (bvh, npz) could be read" in done.err
    assert not (tmp_path / "n").exists()


def test_invalid_options_are_one_line(gesturekit, motions, tmp_path):
    for options, message in (
        (["--frames", 3], "windows of 3 frames"),
        (["--joints", "Wing"], "no joint 'Wing'"),
        (["--variant", "vae"], "'vae'"),
        (["--steps", 0], "--steps"),
    ):
        gesturekit("fit-features", motions, "--out", tmp_path / "m", *options).fails(2, message)
        assert not (tmp_path / "m").exists()
