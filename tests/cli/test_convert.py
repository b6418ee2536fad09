"""gesturekit convert and view: what is printed, exit codes, and never a traceback."""

import re
import shutil
from pathlib import Path

import imageio_ffmpeg
import pytest
from pages import data_of

from gesturekit import Motion


@pytest.fixture
def takes(gesture, tmp_path) -> Path:
    """A folder with two good motions, and one that is broken."""
    folder = tmp_path / "takes"
    (folder / "sub").mkdir(parents=True)
    gesture(1.0).save(folder / "a.bvh")
    gesture(0.5, seed=1).save(folder / "sub" / "für später.npz")
    (folder / "broken.bvh").write_text("Dear diary,\n")
    return folder


def test_one_file_is_one_line_of_what_was_found_and_done(gesturekit, takes, monkeypatch):
    monkeypatch.chdir(takes)
    done = gesturekit("convert", "a.bvh", "out.npz", "--fps", 25, "--mirror")
    assert (done.status, done.err) == (0, "")
    for fact in ("cm", "30 fps", "30 frames", "19 joints", "out.npz", "mirrored", "25 fps"):
        assert fact in done.out
    assert Motion.load("out.npz").fps == 25
    done = gesturekit("convert", "a.bvh", "a.npz", "--antialias").ok()
    assert "--antialias" in done.err and "--fps" in done.err


def test_a_folder_lists_what_failed_and_does_the_rest(gesturekit, takes, tmp_path):
    out = tmp_path / "out"
    done = gesturekit("convert", takes, out, "--format", "npz, html").fails(1)
    assert "broken.bvh:1" in done.err and "1 of 3" in done.err
    assert {path.name for path in out.rglob("*.html")} == {"a.html", "für später.html"}
    convert = ("convert", takes, out, "--format", "npz,html")
    assert gesturekit(*convert, "--mirror").fails(2, "mirror", "4 refused").out == ""
    for options in ((), ("--existing", "skip")):
        again = gesturekit(*convert, *options).fails(1)
        assert again.out.count("skipped") == 2


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["a.bvh", "x.npz", "--trim", "5"], "START:END"),
        (["a.bvh", "x.npz", "--rig", "avatar.bvh"], "avatar.bvh"),
        (["a.bvh", "x.npz", "--in-unit", "yard"], "--in-unit"),
        (["a.bvh", "x.npz", "--part", "tail=Hips"], "PART=JOINT"),
        (["a.bvh", "x.npz", "--rig-part", "head=Hips"], "--rig-part & --rig\\b(?!-)"),
        (["a.bvh", "sub", "--format", "bhv"], "bhv"),
        (["a.bvh", "sub"], "--format npz"),
        (["a.bvh", "x.npz", "--in-up", "w"], "--in-up"),
        (["a.bvh", "sub/für später.npz", "x.npz"], "2 inputs"),
    ],
)
def test_wrong_usage_starts_nothing(gesturekit, takes, monkeypatch, arguments, says):
    monkeypatch.chdir(takes)
    done = gesturekit("convert", *arguments)
    assert done.status == 2 and not Path("x.npz").exists()
    assert all(re.search(fact, done.err) for fact in says.split(" & "))


def test_joints_and_parts_that_are_not_there(gesturekit, takes, tmp_path):
    for options, says in (
        (("--joints", "Tail"), "'Tail'"),
        (("--joints", ","), "joint"),
        (("--joints", "LeftArm,RightArm"), "'Chest'"),
        (("--rig", "smplx", "--part", "head=Tail"), "'Tail'"),
    ):
        gesturekit("convert", takes / "a.bvh", tmp_path / "x.npz", *options).fails(1, says, "a.bvh")


def test_the_rate_of_a_file_that_has_none_is_given(gesturekit, takes, tmp_path):
    text = re.sub("Frame Time: .*", "Frame Time: 0", (takes / "a.bvh").read_text())
    (takes / "a.bvh").write_text(text)
    convert = ("convert", takes / "a.bvh", tmp_path / "x.npz")
    gesturekit(*convert).fails(1, "'0'", "--in-fps")
    gesturekit(*convert, "--in-fps", 60).ok()
    assert Motion.load(tmp_path / "x.npz").fps == 60


def test_view_writes_one_page(gesturekit, takes, tmp_path, write_speech, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    wav, page = write_speech(tmp_path / "a.wav", 1.0), tmp_path / "page.html"
    done = gesturekit("view", takes / "a.bvh", takes / "a.bvh", "--audio", wav, "--out", page)
    assert (done.status, done.out.strip(), done.err) == (0, str(page), "")
    write_speech(wav, 3.0)
    done = gesturekit("view", takes / "a.bvh", "--audio", wav, "--out", page).ok()
    assert re.search(r"(?=.*\b3(\.0)? s)(?=.*\b1(\.0)? s)", done.err)
    done = gesturekit("view", takes / "a.bvh").ok()
    opened = Path(done.out.strip())
    assert "browser" in done.err
    assert opened.name == "a.html" and opened.read_text().rstrip().endswith("</html>")
    shutil.rmtree(opened.parent)
    for arguments, names in (
        ([takes / "broken.bvh", "--out", page], "broken.bvh:1"),
        ([takes / "a.bvh", "--out", tmp_path / "page.bvh"], "page.bvh"),
        ([takes / "a.bvh", "--audio", tmp_path / "none.wav", "--out", page], "none.wav"),
        ([takes / "a.bvh", "--out", page, "--size", "720p"], "--size"),
    ):
        gesturekit("view", *arguments).fails(2, names)


def test_view_opens_a_browser_where_there_are_windows(gesturekit, takes, monkeypatch):
    opened = []
    monkeypatch.setattr("webbrowser.open", lambda address: bool(opened.append(address)) or True)
    monkeypatch.setenv("DISPLAY", ":0")
    done = gesturekit("view", takes / "a.bvh").ok()
    page = Path(done.out.strip())
    assert done.err == "" and opened == [page.as_uri()]
    shutil.rmtree(page.parent)


def test_a_dry_run_of_convert_says_so(gesturekit, takes, tmp_path):
    done = gesturekit("convert", takes, tmp_path / "out", "--format", "npz", "--dry-run")
    done.fails(1, "Dry", "broken.bvh", "1 of 3")
    assert not (tmp_path / "out").exists()


def test_a_folder_is_viewed_by_its_motions(gesturekit, gesture, takes, tmp_path):
    page = tmp_path / "page.html"
    gesture(1.0).save(takes / "a.npz")  # the same take once more
    gesturekit("view", takes, "--out", page).fails(1, "broken.bvh:1")
    assert [figure["label"] for figure in data_of(page)["figures"]] == ["a", "für später"]
    (takes / "broken.bvh").unlink()
    for number in range(8):
        shutil.copy(takes / "a.bvh", takes / f"b{number}.bvh")
    done = gesturekit("view", takes, "--out", page).ok()
    assert re.search(r"(?=.*10 motions)(?=.*\b8\b)", done.err)
    assert len(data_of(page)["figures"]) == 8
    (tmp_path / "empty").mkdir()
    gesturekit("view", tmp_path / "empty").fails(2, str(tmp_path / "empty"))


@pytest.fixture
def clip(tmp_path, gesture):
    path = tmp_path / "a \u00fc.bvh"
    gesture(0.2).save(path)
    return path


@pytest.mark.stress
def test_view_writes_videos(tmp_path, clip, gesturekit):
    gesturekit("view", clip, "-o", tmp_path / "v.mp4", "--fps", 25).ok()
    about = next(imageio_ffmpeg.read_frames(tmp_path / "v.mp4"))
    assert about["fps"] == 25.0


def test_view_and_convert_write_pictures(tmp_path, clip, gesturekit):
    gesturekit("view", clip, clip, "-o", tmp_path / "v.svg").ok()
    assert "<svg" in (tmp_path / "v.svg").read_text(encoding="utf-8")
    gesturekit("convert", clip, tmp_path / "o", "--format", "pdf").ok()
    assert (tmp_path / "o" / "a \u00fc.pdf").read_bytes().startswith(b"%PDF")
    gesturekit("view", clip, "-o", tmp_path / "v.avi").fails(2, ".mp4")
