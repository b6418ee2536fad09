"""gesturekit fit-features: files and folders in, a feature model out."""

from __future__ import annotations

import pytest

from gesturekit.evaluation import FeatureModel


@pytest.fixture(scope="module")
def recordings(tmp_path_factory, gesture):
    folder = tmp_path_factory.mktemp("recordings")
    for number in range(2):
        gesture(4.0, seed=number).save(folder / f"{number}.bvh")
    return folder


def test_a_model_is_written_and_its_fingerprint_printed(gesturekit, recordings, tmp_path):
    options = ("--frames", 30, "--steps", 3)
    done = gesturekit("fit-features", recordings, "--out", tmp_path / "one", *options)
    assert done.status == 0
    fingerprint = FeatureModel.load(tmp_path / "one").fingerprint
    assert done.out.splitlines()[-1] == f"Fingerprint: {fingerprint}"
    assert "genea, 30 frames at 30 fps" in done.out
    files = recordings / "0.bvh", recordings / "1.bvh"
    done = gesturekit("fit-features", *files, "--out", tmp_path / "two", *options)
    assert done.out.splitlines()[-1] == f"Fingerprint: {fingerprint}"


def test_joints_by_name(gesturekit, recordings, tmp_path):
    joints = ("--joints", "LeftArm, LeftForeArm,LeftHand")
    done = gesturekit("fit-features", recordings, "--out", tmp_path, "--steps", 2, *joints)
    assert done.status == 0 and len(FeatureModel.load(tmp_path).windows.bones) == 3


def test_unreadable_files_are_listed_and_left_out(gesturekit, recordings, tmp_path):
    broken = tmp_path / "broken.bvh"
    broken.write_text("HIERARCHY\nROOT", encoding="utf-8")
    done = gesturekit("fit-features", recordings, broken, "--out", tmp_path / "m", "--steps", 2)
    assert done.status == 1 and done.err.count("Error: ") == 1 and "broken.bvh" in done.err
    assert FeatureModel.load(tmp_path / "m").training["motions"] == 2
    done = gesturekit("fit-features", broken, tmp_path / "none.bvh", "--out", tmp_path / "n")
    assert done.status == 2 and "no motion (bvh, npz) could be read" in done.err
    assert not (tmp_path / "n").exists()


def test_invalid_options_are_one_line(gesturekit, recordings, tmp_path):
    for options, message in (
        (["--frames", 3], "windows of 3 frames"),
        (["--joints", "Wing"], "no joint 'Wing'"),
        (["--variant", "vae"], "'vae'"),
        (["--steps", 0], "--steps"),
    ):
        done = gesturekit("fit-features", recordings, "--out", tmp_path / "m", *options)
        assert done.status == 2 and message in done.err and "Traceback" not in done.err
        assert not (tmp_path / "m").exists()
