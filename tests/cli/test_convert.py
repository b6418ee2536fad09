"""gesturekit convert and view: what is printed, exit codes, and never a traceback."""

from __future__ import annotations

import json
import os
import random
import re
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
import soundfile

from gesturekit import Motion
from gesturekit.cli.options import AXES, UNITS
from gesturekit.formats import axes, plausibility
from gesturekit.formats.registry import WRITABLE
from gesturekit.jobs.state import STATE
from gesturekit.rendering.renderer import RENDERED

TRIES = int(os.environ.get("GESTUREKIT_FUZZ", "120"))


@pytest.fixture
def takes(gesture, tmp_path) -> Path:
    """A folder with two good motions, and one that is broken."""
    folder = tmp_path / "takes"
    (folder / "sub").mkdir(parents=True)
    gesture(1.0).save(folder / "a.bvh")
    gesture(0.5, seed=1).save(folder / "sub" / "für später.npz")
    (folder / "broken.bvh").write_text("Dear diary,\n")
    return folder


def test_choices_of_the_options_match_the_readers():
    assert set(UNITS) == set(plausibility.METRES) and set(AXES) == set(axes.AXES)


def test_the_help_names_all_formats(gesturekit):
    for verb, formats in (("convert", WRITABLE), ("render", RENDERED)):
        shown = re.search(r"any of\s+([\w,\s]+)\.", gesturekit(verb, "--help").out)[1]
        assert re.sub(r"\s", "", shown).split(",") == list(formats)


def test_one_file_is_one_line_of_what_was_found_and_done(gesturekit, takes, monkeypatch):
    monkeypatch.chdir(takes)
    done = gesturekit("convert", "a.bvh", "out.npz", "--fps", 25, "--mirror")
    assert (done.status, done.err) == (0, "")
    found = "a.bvh (cm, Y up, Z forward, 30 fps, 30 frames, 19 joints)"
    assert " ".join(done.out.split()) == f"{found} -> out.npz (mirrored, 30 to 25 fps)"
    assert Motion.load("out.npz").fps == 25


def test_a_folder_lists_what_failed_and_does_the_rest(gesturekit, takes, tmp_path):
    out = tmp_path / "out"
    done = gesturekit("convert", takes, out, "--format", "npz, html").fails(1)
    failed, count = done.err.splitlines()
    assert failed.startswith("Failed: ") and "broken.bvh:1" in failed and count == "1 of 3 failed."
    assert {path.name for path in out.rglob("*.html")} == {"a.html", "für später.html"}
    convert = ("convert", takes, out, "--format", "npz,html")
    assert gesturekit(*convert, "--mirror").fails(2, "another mirror (4 refused").out == ""
    for options in ((), ("--existing", "skip")):
        again = gesturekit(*convert, *options).fails(1)
        assert again.out.count("skipped, its outputs exist") == 2


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["a.bvh"], "Missing argument"),
        (["a.bvh", "x.npz", "--trim", "5"], "START:END"),
        (["a.bvh", "x.npz", "--rig", "avatar.bvh"], "no such file"),
        (["a.bvh", "x.npz", "--fps", "0"], "--fps"),
        (["a.bvh", "x.npz", "--in-unit", "yard"], "--in-unit"),
        (["a.bvh", "x.npz", "--part", "elbow"], "PART=JOINT"),
        (["a.bvh", "x.npz", "--part", "tail=Hips"], "PART=JOINT"),
        (["a.bvh", "x.npz", "--rig-part", "head=Hips"], "--rig-part requires --rig"),
        (["a.bvh", "sub", "--format", "bhv"], "format bhv"),
        (["a.bvh", "sub"], "--format npz"),
        (["a.bvh", "sub/für später.npz", "x.npz"], "2 inputs cannot become one file"),
    ],
)
def test_wrong_usage_starts_nothing(gesturekit, takes, monkeypatch, arguments, says):
    monkeypatch.chdir(takes)
    done = gesturekit("convert", *arguments)
    assert done.status == 2 and says in done.err and not Path("x.npz").exists()


def test_joints_and_parts_that_are_not_there(gesturekit, takes, tmp_path):
    for options, says in (
        (("--joints", "Tail"), "no joint 'Tail'"),
        (("--joints", ","), "at least one"),
        (("--joints", "LeftArm,RightArm"), "keep 'Chest' too"),
        (("--rig", "smplx", "--part", "head=Tail"), "no joint 'Tail'"),
    ):
        gesturekit("convert", takes / "a.bvh", tmp_path / "x.npz", *options).fails(1, says, "a.bvh")


def test_the_rate_of_a_file_that_has_none_is_given(gesturekit, takes, tmp_path):
    text = re.sub("Frame Time: .*", "Frame Time: 0", (takes / "a.bvh").read_text())
    (takes / "a.bvh").write_text(text)
    convert = ("convert", takes / "a.bvh", tmp_path / "x.npz")
    gesturekit(*convert).fails(1, "Frame Time: '0' s", "--in-fps")
    gesturekit(*convert, "--in-fps", 60).ok()
    assert Motion.load(tmp_path / "x.npz").fps == 60


def test_folders_without_permission(gesturekit, takes, tmp_path):
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o500)
    if os.access(locked, os.W_OK):
        pytest.skip("this user may write everywhere")
    done = gesturekit("convert", takes / "a.bvh", locked / "sub" / "x.npz")
    assert done.status == 2 and f"{locked} cannot be written to" in done.err
    (takes / "sub").chmod(0)
    done = gesturekit("convert", takes, tmp_path / "out", "--format", "npz")
    seen = gesturekit("inspect", takes / "sub")
    (takes / "sub").chmod(0o700)
    assert done.status == 1 and f"Failed: {takes / 'sub'}: Permission denied" in done.err
    assert (tmp_path / "out" / "a.npz").is_file()
    assert seen.status == 1 and "Permission denied" in seen.err


def test_view_writes_one_page(gesturekit, takes, tmp_path, write_speech, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    wav = write_speech(tmp_path / "a.wav", 1.0)
    page = tmp_path / "page.html"
    done = gesturekit("view", takes / "a.bvh", takes / "a.bvh", "--audio", wav, "--out", page)
    assert (done.status, done.out.strip(), done.err) == (0, str(page), "")
    done = gesturekit("view", takes / "a.bvh")
    opened = Path(done.out.strip())
    assert done.status == 0 and "No browser found" in done.err
    assert opened.name == "a.html" and opened.read_text().rstrip().endswith("</html>")
    shutil.rmtree(opened.parent)
    for arguments in (
        [takes / "broken.bvh", "--out", page],
        [takes / "a.bvh", "--out", tmp_path / "page.bvh"],
        [takes / "a.bvh", "--audio", tmp_path / "none.wav", "--out", page],
        [tmp_path / "none.bvh", "--out", page],
    ):
        done = gesturekit("view", *arguments)
        assert done.status == 2 and done.err.startswith("Error: ")
    (tmp_path / "all broken").mkdir()
    (takes / "broken.bvh").rename(tmp_path / "all broken" / "broken.bvh")
    done = gesturekit("view", tmp_path / "all broken", "--out", page)
    done.fails(2, "Failed: ", "broken.bvh:1: ", "Error: no motion to show")


def test_view_opens_a_browser_where_there_are_windows(gesturekit, takes, monkeypatch):
    opened = []
    monkeypatch.setattr("webbrowser.open", lambda address: bool(opened.append(address)) or True)
    monkeypatch.setenv("DISPLAY", ":0")
    done = gesturekit("view", takes / "a.bvh").ok()
    page = Path(done.out.strip())
    assert done.err == "" and opened == [page.as_uri()]
    shutil.rmtree(page.parent)


def test_view_labels_files_of_one_name_by_their_folders(gesturekit, gesture, tmp_path):
    for number in range(9):
        gesture(1.0 + 2.0 * (number == 8)).save(tmp_path / str(number) / "a.npz")
    files = [tmp_path / str(number) / "a.npz" for number in range(9)]
    sound = tmp_path / "a.wav"
    soundfile.write(sound, np.zeros(20_000), 8000)
    page = tmp_path / "page.HTM"
    done = gesturekit("view", *files, "--audio", sound, "--out", page, "--framing", "waist").ok()
    # All that are named are shown, and the longest decides whether the sound fits.
    assert done.err == ""
    labels = re.findall('"label":"(.*?)"', page.read_text())
    assert labels == [str(file) for file in files]
    picture = ("--out", tmp_path / "a.png", "--framing", "waist")
    gesturekit("view", files[0], *picture).fails(2, "--framing is an option of .html, .mp4;")


def test_view_says_when_sound_and_motion_do_not_fit(gesturekit, takes, tmp_path, write_speech):
    page = tmp_path / "page.html"
    for seconds, says in ((3.0, "lasts 3.0 s, the motion 1.0 s"), (2.0, ""), (1.5, "")):
        wav = write_speech(tmp_path / "a.wav", seconds)
        done = gesturekit("view", takes / "a.bvh", "--audio", wav, "--out", page)
        assert done.status == 0 and says in done.err and bool(says) == bool(done.err)


def test_a_page_that_exists_is_replaced_unless_asked(gesturekit, takes, tmp_path):
    page = tmp_path / "page.html"
    page.write_text("mine")
    view = ("view", takes / "a.bvh", "--out", page)
    gesturekit(*view, "--existing", "refuse").fails(2, "--existing replace")
    skipped = gesturekit(*view, "--existing", "skip").ok()
    assert "skipped, exists already" in skipped.err and page.read_text() == "mine"
    gesturekit(*view).ok()
    assert page.read_text() != "mine"


def test_odd_combinations_of_options_end_in_words(gesturekit, takes, tmp_path, write_speech):
    """Random command lines of convert, inspect and view on files good and bad."""
    rng = random.Random(0)
    write_speech(takes / "speech.wav", 0.5)
    shutil.copy(takes / "speech.wav", takes / "wav.bvh")
    whole = (takes / "a.bvh").read_bytes()
    (takes / "cut.bvh").write_bytes(whole[: len(whole) // 2])
    (takes / "cut.npz").write_bytes((takes / "sub" / "für später.npz").read_bytes()[:3000])
    np.savez(takes / "odd.npz", poses=np.zeros((3, 7)), trans=np.zeros((3, 3)))
    (takes / "000000.json").write_text('[{"id": 0, "Rh": 1, "poses": {}}]')
    (takes / "empty").mkdir()
    (takes / "line\nbreak.bvh").write_bytes(whole)
    files = [*takes.rglob("*"), takes, Path("none.bvh"), Path("/dev/null"), Path("demo")]
    values = {
        "--format": ["npz", "bvh,html", "obj", "png", ",", "bvh,bvh", "exe"],
        "--rig": ["smplx", "smpl", str(takes / "a.bvh"), str(takes / "cut.npz"), "", "x"],
        "--fps": ["25", "0.001", "1000", "nan", "-1"],
        "--trim": ["0.1:", ":0.1", "9:", "0.1:0.1", "x", "-1:"],
        "--joints": ["body", "Hips", "LeftArm,RightArm", "", "Hips,Spine,Chest,LeftHand"],
        "--up": ["z"],
        "--unit": ["m", "cmu"],
        "--frame": ["3", "-1", "99999"],
        "--existing": ["skip", "replace", "refuse"],
        "--in-unit": ["inch", "m"],
        "--in-up": ["-z", "y", "x"],
        "--in-forward": ["x", "-y"],
        "--in-fps": ["7.5", "1e3"],
        "--person": ["0", "5"],
        "--body-model": [str(takes / "odd.npz"), "x"],
        "--part": ["left_elbow=LeftForeArm", "head=Tail", "x", "=", "left_elbow=Hips"],
        "--rig-part": ["head=Head"],
        "--mirror": [None],
        "--antialias": [None],
        "--dry-run": [None],
        "--json": [None],
        "--audio": [str(takes / "speech.wav"), str(takes / "a.bvh")],
    }
    ours = {
        "inspect": ("--in-unit", "--in-up", "--in-forward", "--in-fps", "--part", "--json"),
        "view": ("--in-unit", "--in-up", "--in-fps", "--audio", "--person"),
    }
    ends = []
    for trial in range(TRIES):
        verb = rng.choice(["convert", "convert", "convert", "inspect", "view"])
        known = ours.get(verb, tuple(set(values) - {"--json", "--audio"}))
        arguments = [verb, *rng.sample(files, rng.choice([1, 1, 1, 2]))]
        if verb == "convert":
            out = rng.choice(["x.npz", "x.bvh", "x.html", "x.fbx", "folder", "folder/sub"])
            arguments.append(tmp_path / f"out{trial % 7}" / out)
        if verb == "view":
            arguments += ["--out", tmp_path / "page.html"]
        for option in rng.sample(sorted(known), rng.choice([0, 1, 2, 4])):
            value = rng.choice(values[option])
            arguments += [option] if value is None else [option, value]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            done = gesturekit(*arguments)
        assert done.status in (0, 1, 2), arguments
        assert done.err or done.status == 0, arguments
        assert "Traceback" not in done.err, arguments
        ends.append(done.status)
    assert all(ends.count(status) > TRIES / 20 for status in (0, 1, 2))
    hidden = [path for path in tmp_path.glob("out*/**/.*") if path.name != STATE]
    assert not hidden, "nothing temporary is left"


def test_a_warning_about_the_rig_is_one_line(gesture, tmp_path):
    frames = tmp_path / "people" / "smpl"
    frames.mkdir(parents=True)
    body = {"Rh": [[0, 0, 0]], "Th": [[0, 0.9, 0]], "poses": [[0] * 72], "shapes": [[0] * 10]}
    (frames / "000000.json").write_text(json.dumps([{"id": k, **body} for k in range(2)]))
    gesture(0.5).save(tmp_path / "take.bvh")
    command = [sys.executable, "-m", "gesturekit", "convert", "take.bvh", "on.npz"]
    command += ["--rig", "people"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0
    (line,) = done.stderr.splitlines()
    assert line.startswith("Warning: people: several people")


def test_a_long_line_of_what_was_done_is_two(gesturekit, gesture, tmp_path, monkeypatch):
    """The line has up to 99 characters; else the written file is on a line of its own."""
    monkeypatch.chdir(tmp_path)
    found = "{} (cm, Y up, Z forward, 30 fps, 6 frames, 19 joints)"
    for length, is_one in ((99, True), (100, False)):
        name = "x" * (length - len(found.format("")) - len("-> y.npz") - 4) + ".bvh"
        gesture(0.2).save(tmp_path / name)
        lines = gesturekit("convert", name, "y.npz", "--existing", "replace").ok().out.splitlines()
        one, two = found.format(name), "-> y.npz"
        assert len(one) + len(two) == length
        assert lines == ([f"{one} {two}"] if is_one else [one, f"    {two}"])


def test_a_dry_run_of_convert_says_so(gesturekit, takes, tmp_path):
    done = gesturekit("convert", takes, tmp_path / "out", "--format", "npz", "--dry-run")
    assert done.status == 1 and "Dry run: nothing was written." in done.err
    assert "1 of 3 failed." in done.err and not (tmp_path / "out").exists()
    (takes / "a.bvh").unlink()
    two = gesturekit("convert", takes, tmp_path / "out", "--format", "npz", "--dry-run").fails(1)
    assert "1 of 2 failed." in two.err
    done = gesturekit("convert", takes / "broken.bvh", tmp_path / "out" / "b.npz")
    assert done.status == 1 and "failed." not in done.err and "Dry run" not in done.err


def test_antialias_without_a_rate_is_said_to_do_nothing(gesturekit, takes, tmp_path):
    done = gesturekit("convert", takes / "a.bvh", tmp_path / "a.npz", "--antialias")
    assert done.status == 0 and "--antialias has no effect without --fps" in done.err


def test_a_folder_is_viewed_by_its_motions(gesturekit, gesture, takes, tmp_path):
    page = tmp_path / "page.html"
    gesture(1.0).save(takes / "a.npz")  # the same take once more
    done = gesturekit("view", takes, "--out", page)
    assert done.status == 1 and done.err.startswith("Failed: ") and "broken.bvh:1" in done.err
    assert re.findall('"label":"(.*?)"', page.read_text()) == ["a", "f\\u00fcr sp\\u00e4ter"]
    (takes / "broken.bvh").unlink()
    for number in range(8):
        shutil.copy(takes / "a.bvh", takes / f"b{number}.bvh")
    for number in range(6, 8):
        (takes / f"b{number}.bvh").rename(tmp_path / f"b{number}.bvh")
    done = gesturekit("view", takes, "--out", page)
    assert (done.status, done.err) == (0, "")
    for number in range(6, 8):
        (tmp_path / f"b{number}.bvh").rename(takes / f"b{number}.bvh")
    done = gesturekit("view", takes, "--out", page)
    assert done.status == 0 and "10 motions; the page shows the first 8" in done.err
    assert page.read_text().count('"label":') == 8
    (tmp_path / "empty").mkdir()
    gesturekit("view", tmp_path / "empty").fails(2, "no motion in it; looked for .bvh")


def facts(path) -> dict:
    return next(imageio_ffmpeg.read_frames(path))


@pytest.fixture
def clip(tmp_path, gesture):
    path = tmp_path / "a \u00fc.bvh"
    gesture(0.2).save(path)
    return path


def test_view_writes_videos_and_pictures(tmp_path, clip, gesturekit):
    assert gesturekit("view", clip, "-o", tmp_path / "v.mp4", "--fps", 25).status == 0
    assert facts(tmp_path / "v.mp4")["fps"] == 25.0
    assert gesturekit("view", clip, clip, "-o", tmp_path / "v.svg").status == 0
    assert "<svg" in (tmp_path / "v.svg").read_text(encoding="utf-8")


def test_a_file_that_cannot_be_shown_is_named_and_the_exit_code_is_1(tmp_path, clip, gesturekit):
    clip.with_name("b.bvh").write_text("HIERARCHY")
    done = gesturekit("view", tmp_path, "--out", tmp_path / "v.html")
    assert done.status == 1 and "b.bvh" in done.err
    assert (tmp_path / "v.html").read_text(encoding="utf-8").count('"label":') == 1


def test_options_of_videos_are_refused_for_pages(tmp_path, clip, gesturekit):
    view = ("view", clip, "-o", tmp_path / "v.html", "--size", "720p")
    gesturekit(*view).fails(2, "--size is an option of .mp4;")
    gesturekit("view", clip, "-o", tmp_path / "v.avi").fails(2, ".mp4")


def test_convert_writes_videos_and_pictures_too(tmp_path, clip, gesturekit):
    gesturekit("convert", clip, tmp_path / "o", "--format", "mp4,pdf", "--size", "1080p").ok()
    assert facts(tmp_path / "o" / "a \u00fc.mp4")["size"] == (1920, 1080)
    assert (tmp_path / "o" / "a \u00fc.pdf").read_bytes().startswith(b"%PDF")
