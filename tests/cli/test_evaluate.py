"""gesturekit evaluate, as it is typed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest


@pytest.fixture(scope="module")
def folders(tmp_path_factory, write_pair, gesture) -> Path:
    """Three recordings with sound, two folders of generated motion."""
    root = tmp_path_factory.mktemp("evaluate")
    for i in range(3):
        write_pair(root / "recordings", f"clip{i}", 3.0, fps=25.0, seed=i)
        for k, model in enumerate(("ours", "baseline"), start=1):
            (root / model).mkdir(exist_ok=True)
            gesture(3.0, 25.0, seed=10 * k + i).save(root / model / f"clip{i}.npz")
    return root


def test_it_prints_a_table_and_writes_report_and_json(gesturekit, folders, tmp_path):
    recordings = folders / "recordings"
    done = gesturekit(
        "evaluate", folders / "ours", recordings, "--audio", recordings,
        "--out", tmp_path / "r.html", "--json", tmp_path / "r.json",
        "--compare", folders / "baseline",
    )  # fmt: skip
    assert done.status == 0, done.err
    lines = done.out.splitlines()
    assert lines[0].split() == ["ours", "baseline", "recording"]
    assert any(line.startswith("Sync  ") and "[" in line for line in lines)
    found = json.loads((tmp_path / "r.json").read_text())
    assert [model["label"] for model in found["models"]] == ["ours", "baseline"]
    assert "ours, baseline against recordings" in (tmp_path / "r.html").read_text()


def test_clips_that_are_left_out_make_it_exit_1(gesturekit, folders, tmp_path):
    made = tmp_path / "made"
    made.mkdir()
    (made / "clip0.npz").write_bytes((folders / "ours" / "clip0.npz").read_bytes())
    (made / "clip1.npz").write_bytes(b"no npz")
    done = gesturekit("evaluate", made, folders / "recordings")
    assert done.status == 1
    assert "Left out: made: clip1: clip: " in done.err and "clip1.npz" in done.err
    assert "Arm speed, rad/s" in done.out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["absent", "recordings"], "absent: no such file or folder"),
        (["ours", "empty"], "empty: no motion files"),
        (["ours", "recordings", "baseline"], "Add --compare"),
        (["ours", "recordings", "--compare"], "needs folders"),
        (["ours", "recordings", "--compare", "ours"], "is named twice"),
        (["ours", "recordings", "--audio", "ours"], "no sound files"),
        (["ours", "recordings", "--features", "ours"], "ours"),
        (["demo", "recordings"], "demo is a model"),
        (["made", "recordings", "--out", "recordings/clip0.bvh/r.html"], "cannot be written"),
        (["demo", "recordings", "--protocol", "lda"], "give --audio"),
    ],
)
def test_what_cannot_start_is_one_line_and_exit_2(
    gesturekit, folders, monkeypatch, arguments, said
):
    monkeypatch.chdir(folders)
    (folders / "empty").mkdir(exist_ok=True)
    done = gesturekit("evaluate", *arguments)
    assert done.status == 2 and said in done.err
    assert "Traceback" not in done.err and not done.out


@pytest.mark.parametrize(
    ("protocol", "names", "measure"),
    [
        ("multires", ["clip0_s1", "clip0_s2", "clip1_s1", "clip1_s2"], "coverage"),
        ("lda", ["clip0_w000_s1", "clip0_w000_s2", "clip1_w000_s1", "clip1_w000_s2"], "fid_k"),
    ],
)
def test_a_protocol_samples_models(
    gesturekit, model, write_pair, tmp_path, protocol, names, measure
):
    for i in range(2):
        write_pair(tmp_path / "recordings", f"clip{i}", 12.0 if protocol == "lda" else 3.0, seed=i)
    recordings = tmp_path / "recordings"
    done = gesturekit(
        "evaluate", model, recordings, "--protocol", protocol, "--audio", recordings,
        "--samples", 2, "--samples-dir", tmp_path / "samples", "--json", tmp_path / "r.json",
    )  # fmt: skip
    assert done.status == 0, done.err
    written = sorted(path.stem for path in (tmp_path / "samples" / "model").iterdir())
    assert written == names
    (found,) = json.loads((tmp_path / "r.json").read_text())["models"]
    assert measure in found["figures"]
    seconds = {round(clip["seconds"], 2) for clip in found["clips"]}
    assert seconds == ({10.0} if protocol == "lda" else {6.0})
    assert "the protocol takes" in done.err
    again = gesturekit(
        "evaluate", model, recordings, "--protocol", protocol, "--audio", recordings,
        "--samples", 1, "--samples-dir", tmp_path / "samples",
    )  # fmt: skip
    assert again.status == 2 and "samples of an earlier run" in again.err
