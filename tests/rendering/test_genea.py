"""Submissions to the GENEA leaderboard: written from a tiny BEAT2, and checked."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from published import write_smplx

import gesturekit as gk
from gesturekit.cli import main
from gesturekit.motion import Motion
from gesturekit.rendering.genea import check, export, published_sounds

# Seconds of sound of each recording; the motion of each lasts 1 s.
SECONDS = {"2_scott_0_1_1": 1.51, "1_wayne_0_86_87": 2.0, "1_wayne_0_1_1": 1.0}
SPLITS = {"2_scott_0_1_1": "test", "1_wayne_0_86_87": "test", "1_wayne_0_1_1": "train"}


@pytest.fixture(scope="module")
def beat2(tmp_path_factory, write_speech) -> Path:
    root = tmp_path_factory.mktemp("beat2")
    for name, seconds in SECONDS.items():
        write_speech(root / "wave16k" / f"{name}.wav", seconds)
        write_smplx(root / "smplxflame_30" / f"{name}.npz", 1.0, seed=0)
    rows = "".join(f"{name},{split}\n" for name, split in SPLITS.items())
    (root / "train_test_split.csv").write_text(f"id,type\n{rows}")
    return root


@pytest.fixture(scope="module")
def submission(beat2, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("submission")
    list(export(gk.load("demo"), beat2, out, samples=2).run())
    return out


def test_the_test_split_is_rendered_to_the_length_of_the_sound(beat2, submission):
    """1.51 s are 45.3 frames, so 45; the recorded motion, 30 frames, does not count."""
    frames = {}
    for path in sorted(submission.glob("*.npz")):
        with np.load(path) as file:
            assert file["poses"].shape[1] == 165 and file["mocap_frame_rate"] == 30
            assert file["surface_model_type"] == "smplx" and file["trans"].shape[1] == 3
            frames[path.stem] = len(file["poses"])
    lengths = {"1_wayne_0_86_87": 60, "2_scott_0_1_1": 45}
    assert frames == {f"{name}_s{n}": length for name, length in lengths.items() for n in (1, 2)}
    assert check(submission, published_sounds(beat2), "smplx", 2) == []


def test_every_fault_is_named(beat2, submission, tmp_path):
    sounds = published_sounds(beat2)
    assert list(sounds) == ["1_wayne_0_86_87", "2_scott_0_1_1"]
    good = Motion.load(submission / "2_scott_0_1_1_s1.npz")
    good.save(tmp_path / "2_scott_0_1_1_s1.npz")
    good.save(tmp_path / "2_scott_0_1_1_s2.npz")
    good[:44].save(tmp_path / "2_scott_0_1_1_s3.npz")
    (tmp_path / "1_wayne_0_86_87_s1.npz").write_bytes(b"no npz")
    with pytest.warns(UserWarning, match="25 fps"):
        replace(good, fps=25.0).save(tmp_path / "1_wayne_0_86_87_s3.npz")
    broken = tmp_path / "broken.wav"
    broken.write_text("no sound")
    unreadable, *faults = check(tmp_path, {"broken": broken, **sounds}, "smplx", 3)
    assert str(broken) in unreadable and len(faults) == 5
    for says in (
        "2_scott_0_1_1_s2.npz & same",
        r"2_scott_0_1_1_s3.npz & 44 frames & \b45\b",
        r"1_wayne_0_86_87_s3.npz & 25 fps & \b30\b",
        "1_wayne_0_86_87_s2.npz & missing",
        "1_wayne_0_86_87_s1.npz",
    ):
        assert any(all(re.search(fact, fault) for fact in says.split(" & ")) for fault in faults)
    (fault,) = check(submission, {"2_scott_0_1_1": sounds["2_scott_0_1_1"]}, "smplh", 2)[:1]
    assert "55 joints" in fault and "52" in fault


def test_the_command_makes_what_is_missing_and_says_what_is_wrong(beat2, tmp_path, capsys):
    def run(*arguments: str) -> int:
        with pytest.raises(SystemExit) as left:
            main(["genea", *arguments, str(beat2), "--out", str(tmp_path), "--samples", "1"])
        return left.value.code

    assert run("check") == 1
    assert "2 of 2" in capsys.readouterr().out
    assert run("export") == 2
    assert "--model demo" in capsys.readouterr().err
    assert run("export", "--model", "demo") == 0
    said = capsys.readouterr()
    assert "2 sounds" in said.out
    (tmp_path / "2_scott_0_1_1.npz").unlink()
    kept = (tmp_path / "1_wayne_0_86_87.npz").stat().st_mtime_ns
    assert run("export", "--model", "demo") == 0
    assert (tmp_path / "1_wayne_0_86_87.npz").stat().st_mtime_ns == kept
    assert run("check") == 0
    assert run("export", "--model", "demo", "--seed", "1") == 2
    assert "--existing replace" in capsys.readouterr().err
