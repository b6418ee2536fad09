"""gesturekit prepare and fit-features: exit codes, and one clear line a problem."""

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
    assert "3 recordings, 6.0 s: train 2 (4.0 s), test 1 (2.0 s)" in done.out
    assert (tmp_path / "corpus.jsonl").is_file()


def test_some_files_are_left_out(prepare, recordings):
    (recordings / "a.wav").write_text("no sound")
    (recordings / "alone.wav").write_bytes((recordings / "b.wav").read_bytes())
    done = prepare(recordings, "--holdout", "0")
    done.fails(1, f"error: {recordings / 'a.wav'}", "speech without motion", "alone.wav")
    assert "2 recordings" in done.out
    assert "1 recording with" in done.out and "1 file" in done.out


def test_nothing_can_start(prepare):
    for arguments in ([], ["nowhere"], ["--style-pattern", "(", "."], ["--holdout", "1", "."]):
        prepare(*arguments).fails(2, "Error: ")


def test_nothing_usable(prepare, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("e").mkdir()
    prepare("e").fails(2, "usable recording", "warning: e: ", ".wav, ", ".npz")
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
    fit = ("fit-features", motions, "--variant", "yoon", "--steps", 2, "--out")
    done = gesturekit(*fit, tmp_path / "one").ok()
    fingerprint = f"Fingerprint: {FeatureModel.load(tmp_path / 'one').fingerprint}"
    assert done.out.splitlines()[-1] == fingerprint
    assert f"{tmp_path / 'one'}: yoon, 34 frames at 15 fps, " in done.out
    kept = gesturekit(*fit, tmp_path / "one", "--existing", "skip").ok()
    assert kept.out == "" and "exists already" in kept.err
    for more, is_same in (((), True), (("--seed", 1), False)):
        other = gesturekit(*fit, tmp_path / "two", "--existing", "replace", *more).ok()
        assert (other.out.splitlines()[-1] == fingerprint) == is_same


def test_unreadable_files_are_listed_and_left_out(gesturekit, motions, tmp_path):
    broken = tmp_path / "broken.bvh"
    broken.write_text("HIERARCHY\nROOT", encoding="utf-8")
    joints = ("--joints", "LeftArm, LeftForeArm,LeftHand", "--steps", 2)
    done = gesturekit("fit-features", motions, broken, "--out", tmp_path / "m", *joints).fails(1)
    assert done.err.count("Error: ") == 1 and "broken.bvh" in done.err
    fitted = FeatureModel.load(tmp_path / "m")
    assert fitted.training["motions"] == 2 and len(fitted.windows.bones) == 3
    done = gesturekit("fit-features", broken, tmp_path / "none.bvh", "--out", tmp_path / "n")
    done.fails(2, "no motion (bvh, npz)")
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
