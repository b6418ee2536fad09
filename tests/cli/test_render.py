"""gesturekit render: what comes out, under which name, and what is said about what does not."""

from __future__ import annotations

import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from fractions import Fraction
from math import floor
from pathlib import Path

import click
import numpy as np
import pytest
import soundfile
from sounds import voiced

import gesturekit as gk
from gesturekit import Motion, systems
from gesturekit.cli.render import CONTROLS, GROUPS, command, control_options
from gesturekit.corpus import Manifest
from gesturekit.corpus.item import SPLITS
from gesturekit.multires.network.generator import MultiresGenerator

FPS = 30


def make_sound(path: Path, n_samples: int, rate: int, channels: int = 1) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    sound = 0.1 * voiced(n_samples / rate, rate)
    soundfile.write(path, np.tile(sound[:, None], (1, channels)), rate)
    return path


@pytest.fixture
def wav(tmp_path) -> Path:
    return make_sound(tmp_path / "in" / "speech.wav", 24_000, 16_000)


@pytest.fixture
def render(gesturekit, model, tmp_path):
    """render(*inputs and options, out="out"): the command, of the tiny model into tmp_path/out."""
    made = ("render", "--model", model, "--out")
    return lambda *arguments, out="out": gesturekit(*made, tmp_path / out, *arguments)


@pytest.fixture
def broken(tmp_path) -> dict[str, Path]:
    """What users give by accident, by what is wrong with it."""
    folder = tmp_path / "in"
    folder.mkdir(exist_ok=True)
    files = {
        "no such file": folder / "missing.wav",
        "empty": folder / "empty.wav",
        "10.0 ms": make_sound(folder / "short.wav", 160, 16_000),
        "cannot be read as sound": folder / "text.wav",
        "truncated": make_sound(folder / "truncated.wav", 16_000, 16_000),
        "is nan": folder / "nan.wav",
    }
    files["empty"].touch()
    files["cannot be read as sound"].write_text("Dear diary,\n")
    whole = files["truncated"].read_bytes()
    files["truncated"].write_bytes(whole[: len(whole) // 2])
    soundfile.write(files["is nan"], np.full(16_000, np.nan), 16_000, subtype="FLOAT")
    return files


def frames_in(bvh: Path) -> int:
    return int(re.search(r"^Frames: (\d+)$", bvh.read_text(), re.MULTILINE)[1])


def names(folder: Path) -> list[str]:
    """Names in a folder, but for hidden files."""
    return sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))


def problems(err: str) -> list[str]:
    """Lines on stderr beside progress, the rate, and the summary, which is the last line."""
    *lines, summary = err.splitlines()
    assert re.match(r"\d+ rendered.* in .*: ", summary), summary
    return [line for line in lines if not line.startswith(("Rendering: ", "Written at "))]


def test_every_sound_becomes_motion_of_its_own_length(render, tmp_path):
    sounds = {
        "stereo.wav": (54_551, 44_100, 2),
        "telephone.wav": (9_999, 8_000, 1),
        "lossless.flac": (33_333, 48_000, 1),
        "half_a_frame.wav": (2_000, 8_000, 1),  # 7.5 frames: rounded up
        "odd.wav": (32_321, 16_000, 1),
        "compressed.ogg": (40_000, 32_000, 2),
        "one_frame.wav": (400, 16_000, 1),
    }
    for name, (n_samples, rate, channels) in sounds.items():
        make_sound(tmp_path / "in" / name, n_samples, rate, channels)
    out = tmp_path / "out"
    done = render(tmp_path / "in")
    assert done.status == 0 and problems(done.err) == []
    assert names(out) == sorted(f"{Path(name).stem}.bvh" for name in sounds)
    assert set(done.out.split()) == {str(out / name) for name in names(out)}
    for name, (n_samples, rate, _) in sounds.items():
        n_frames = floor(Fraction(n_samples, rate) * FPS + Fraction(1, 2))
        assert frames_in(out / f"{Path(name).stem}.bvh") == n_frames, name


def test_every_format_holds_the_same_motion(render, tmp_path):
    wav = make_sound(tmp_path / "in" / "speech.wav", 8_000, 16_000)
    out = tmp_path / "a folder" / "ausgabe für später"
    done = render(wav, "--format", "bvh,npz, html ,png,mp4", out=out)
    assert (done.status, problems(done.err)) == (0, [])
    assert names(out) == [f"speech.{kind}" for kind in ("bvh", "html", "mp4", "npz", "png")]
    bvh, npz = Motion.load(out / "speech.bvh"), Motion.load(out / "speech.npz")
    assert bvh.skeleton.names == npz.skeleton.names
    np.testing.assert_allclose(bvh.positions(), npz.positions(), atol=1e-4)
    page = (out / "speech.html").read_text(encoding="utf-8")
    assert "<script" in page and "audio" in page and page.rstrip().endswith("</html>")
    assert (out / "speech.png").read_bytes().startswith(b"\x89PNG")
    assert b"mp4a" in (out / "speech.mp4").read_bytes()  # with its sound


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(render, wav, tmp_path):
    for name, seed in {"one": 3, "same": 3, "other": 4}.items():
        render(wav, "--format", "bvh,npz,html", "--seed", seed, out=name).ok()
    for kind in ("bvh", "npz", "html"):
        made = {n: (tmp_path / n / f"speech.{kind}").read_bytes() for n in ("one", "same", "other")}
        assert made["one"] == made["same"] != made["other"], kind


def test_other_items_do_not_change_a_rendering(render, wav, tmp_path):
    second = make_sound(tmp_path / "in" / "second.wav", 50_001, 22_050)
    kinds = ("bvh", "npz")
    render(wav, "--format", "bvh,npz", out="alone").ok()
    render(wav, second, "--samples", 2, "--format", "bvh,npz", out="first").ok()
    render(second, wav, "--samples", 3, "--format", "bvh,npz", out="last").ok()
    stems = [f"{stem}_s{i}" for stem in ("second", "speech") for i in (1, 2)]
    assert names(tmp_path / "first") == [f"{stem}.{kind}" for stem in stems for kind in kinds]
    for kind in kinds:
        made = [(tmp_path / "last" / f"speech_s{i}.{kind}").read_bytes() for i in (1, 2, 3)]
        assert len(set(made)) == 3, "samples differ"
        assert made[0] == (tmp_path / "alone" / f"speech.{kind}").read_bytes()
        for i in (1, 2):
            assert made[i - 1] == (tmp_path / "first" / f"speech_s{i}.{kind}").read_bytes()


def test_another_body(render, wav, gesture, tmp_path):
    gesture(1.0).save(tmp_path / "avatar.bvh")
    done = render(wav, "--rig", tmp_path / "avatar.bvh", "--rig-part", "head=Head")
    assert (done.status, problems(done.err)) == (0, [])
    assert Motion.load(tmp_path / "out" / "speech.bvh").n_frames == 45
    for rig, part, says in (
        ("avatar.bvh", "head=LeftHand", "'LeftHand' cannot be the head"),
        ("avatar.bvh", "nose=Head", "part 'nose=Head'; expected PART=JOINT"),
        ("none.bvh", "head=Head", "none.bvh"),
    ):
        done = render(wav, "--rig", tmp_path / rig, "--rig-part", part).fails(2, says)
        assert done.err.startswith("Error: ") and len(done.err.splitlines()) == 1
    render(wav, "--rig-part", "head=Head").fails(2, "--rig")


def test_feet_may_be_left_and_the_arms_smoothed(render, model, wav, tmp_path):
    loaded, usual = gk.load(model), None
    for name, flags, controls in (
        ("usual", [], {}),
        ("locked", ["--foot-lock"], {}),
        ("as-is", ["--no-foot-lock"], {"foot_lock": False}),
        ("smooth", ["--smooth", 0.2], {"smooth": 0.2}),
        ("raw", ["--raw"], {"raw": True}),
    ):
        render(wav, "--format", "npz", *flags, out=name).ok()
        made = Motion.load(tmp_path / name / "speech.npz")
        wanted = loaded.generate(wav, item="speech", **controls)
        assert (made.rotations == wanted.rotations).all(), name
        assert (made.translation == wanted.translation).all(), name
        usual = made if usual is None else usual
        assert (made.rotations == usual.rotations).all() == (not controls), name
    render(wav, "--smooth", -1).fails(2, "--smooth")


def test_idle_motion_needs_no_sound(render, tmp_path):
    done = render("--seconds", "2", "--samples", "2", "--format", "bvh,html,png")
    assert (done.status, problems(done.err)) == (0, [])
    assert len(names(tmp_path / "out")) == 6
    assert frames_in(tmp_path / "out" / "motion_s2.bvh") == 2 * FPS


def test_a_broken_file_never_stops_the_others(model, wav, broken, tmp_path):
    """In a process of its own, so that all that reaches the terminal is seen."""
    silent = tmp_path / "in" / "silent.wav"
    soundfile.write(silent, np.zeros(16_000), 16_000)
    out, kinds = tmp_path / "out", ("bvh", "npz", "html", "png")
    command = [sys.executable, "-m", "gesturekit", "render", *broken.values(), silent, wav]
    command += ["--model", model, "--out", out, "--format", ",".join(kinds)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    told = problems(done.stderr)
    assert len(told) == len(broken) + 1, done.stderr
    for (reason, path), line in zip(broken.items(), told, strict=False):
        assert line.startswith(f"Failed: {path}") and reason in line
    assert told[-1].startswith(f"Warning: {silent}: silent")
    made = [f"{stem}.{kind}" for stem in ("silent", "speech") for kind in kinds]
    assert names(out) == sorted(made)
    assert done.stdout.split() == [str(out / name) for name in made]


def test_channel_selects_one_of_two_speakers(render, tmp_path, caplog):
    one = voiced(2.0)
    two = 0.1 * np.stack([one, 0.5 * np.roll(one, 5_000)], axis=1) + [[0.0, 0.1]]
    (tmp_path / "mono").mkdir()
    second = tmp_path / "mono" / "two.wav"
    soundfile.write(tmp_path / "two.wav", two, 16_000)
    soundfile.write(second, two[:, 1], 16_000)
    render(tmp_path / "two.wav", "--format", "bvh,html", "--channel", "2").ok()
    render(second, "--format", "bvh,html", out="second").ok()
    motions = [(tmp_path / name / "two.bvh").read_bytes() for name in ("out", "second")]
    assert motions[0] == motions[1]
    assert caplog.text.count(f"{tmp_path / 'two.wav'}: DC offset") == 1
    render(tmp_path / "two.wav", "--existing", "replace").ok()
    assert (tmp_path / "out" / "two.bvh").read_bytes() != motions[1]
    replaced = ("--existing", "replace", "--channel", "2")
    render(second, *replaced, out="second").fails(1, "channel 2: the file has 1")


def test_a_silent_sound_gives_the_idle_motion_of_its_length(render, tmp_path, caplog):
    soundfile.write(tmp_path / "motion.wav", np.zeros(20_000), 16_000)
    render(tmp_path / "motion.wav", out="silent").ok()
    render("--seconds", 1.25, out="idle").ok()
    silent, idle = (Motion.load(tmp_path / name / "motion.bvh") for name in ("silent", "idle"))
    np.testing.assert_allclose(silent.positions(), idle.positions(), atol=1e-6)
    assert "motion.wav: silent" in caplog.text


def test_noise_is_idle_unless_voice_activity_detection_is_off(render, tmp_path, caplog):
    noise = 0.1 * np.random.default_rng(0).standard_normal(32_000)
    motions = {}
    for name, sound, options in (
        ("zeros", 0 * noise, []),
        ("noise", noise, []),
        ("whisper", noise, ["--no-vad"]),
    ):
        (tmp_path / "in" / name).mkdir(parents=True)
        wav = tmp_path / "in" / name / "sound.wav"
        soundfile.write(wav, sound, 16_000)
        render(wav, *options, out=name).ok()
        motions[name] = Motion.load(tmp_path / name / "sound.bvh").rotations
    assert f"{Path('noise', 'sound.wav')}: no voice found" in caplog.text
    assert str(Path("whisper", "sound.wav")) not in caplog.text
    np.testing.assert_array_equal(motions["noise"], motions["zeros"])
    assert not np.allclose(motions["whisper"], motions["zeros"], atol=1e-3)


def test_files_with_difficult_names(render, wav, tmp_path):
    odd = ["with space.wav", "Ünï 漢字 🎤.wav", "a.b.c.wav", "-dash.wav", "%s {0}.wav", "UPPER.WAV"]
    odd.append(os.fsdecode(b"\xff\xfe.wav"))
    folder = tmp_path / "odd names"
    folder.mkdir()
    shutil.copy(wav, folder / "._of_macos.wav")  # what macOS leaves on other disks is skipped
    try:
        for name in odd:
            shutil.copy(wav, folder / name)
    except OSError:
        odd.pop()  # this file system takes only Unicode names
    for rendered in (len(odd), 0):
        done = render(folder, "--format", "bvh,html")
        assert (done.status, problems(done.err)) == (0, [])
        assert done.err.splitlines()[-1].startswith(f"{rendered} rendered")
    made = sorted(f"{Path(name).stem}.{kind}" for name in odd for kind in ("bvh", "html"))
    assert names(tmp_path / "out") == made
    motions = {(tmp_path / "out" / f"{Path(name).stem}.bvh").read_bytes() for name in odd}
    assert len(motions) == len(odd), "each file is a draw of its own"


def test_a_file_named_twice_is_rendered_once(render, wav, tmp_path):
    done = render(wav, wav.parent, wav).ok()
    assert done.out.split() == [str(tmp_path / "out" / "speech.bvh")]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--format", "bvh,fbx"], "mp4, png; gesturekit convert x.bvh x.fbx writes it"),
        (["--format", ","], "known: bvh"),
        (["--model", "demmo"], "demmo: neither a model folder nor a bundled model"),
        (["--samples", "0"], "samples"),
        (["--seed", "one"], "seed"),
        (["--seconds", "2"], "--seconds is for motion without audio"),
        (["--colour", "red"], "--colour"),
        (["in/other/speech.flac"], "speech.flac would both be written as"),
        (["in/other/speech.flac", "in/third/speech.ogg"], "out/speech (and 1 more); write them"),
        (["in/nothing"], "in/nothing: the folder holds no audio files"),
        (["--out", "in/speech.wav"], "is a file"),
        (["--out", "in/speech.wav/out"], "in/speech.wav/out: cannot be created"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_usage_errors_are_reported_before_any_work(
    gesturekit, model, wav, tmp_path, monkeypatch, arguments, says
):
    monkeypatch.chdir(tmp_path)
    make_sound(tmp_path / "in" / "other" / "speech.flac", 16_000, 16_000)
    make_sound(tmp_path / "in" / "third" / "speech.ogg", 16_000, 16_000)
    (tmp_path / "in" / "nothing").mkdir()
    done = gesturekit("render", "in/speech.wav", "--model", model, "--out", "out", *arguments)
    assert done.status == 2
    assert says in done.err.splitlines()[-1] and done.out == ""
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("seconds", ["-1", "0", "1e12", "inf", "soon", None])
def test_lengths_that_cannot_be_and_none_without_a_sound(render, tmp_path, seconds):
    length = () if seconds is None else ("--seconds", seconds)
    render(*length).fails(2, "--seconds")
    assert not (tmp_path / "out").exists()


def edit(model: Path, old: str, new: str) -> None:
    text = (model / "config.yaml").read_text(encoding="utf-8")
    assert old in text
    (model / "config.yaml").write_text(text.replace(old, new), encoding="utf-8")


DAMAGES = {
    "format 2": lambda m: edit(m, "format: 1", "format: 2"),
    "kind 'telepathy'": lambda m: edit(m, "kind: multires", "kind: telepathy"),
    "kind ['multires']": lambda m: edit(m, "multires", "[multires]"),
    "fps is 0.0": lambda m: edit(m, "fps: 25.0", "fps: 0"),
    "lacks model.safetensors": lambda m: (m / "model.safetensors").unlink(),
    "lacks skeleton.json": lambda m: (m / "skeleton.json").unlink(),
    "config.yaml: no such": lambda m: (m / "config.yaml").unlink(),
    "model.safetensors is damaged": lambda m: (m / "model.safetensors").write_bytes(
        random.Random(0).randbytes(5000)
    ),
    "model is damaged": lambda m: (m / "skeleton.json").write_bytes(random.Random(0).randbytes(99)),
    "the model is damaged": lambda m: (m / "skeleton.json").write_text('{"skeleton": [1]}'),
    "config.yaml: cannot be read": lambda m: (m / "config.yaml").write_bytes(b"\xff\xfe\x00"),
    "config.yaml: not valid YAML": lambda m: (m / "config.yaml").write_text("kind: [multires"),
    "config.yaml: holds list": lambda m: (m / "config.yaml").write_text("[1, 2]"),
}


@pytest.mark.parametrize("says", DAMAGES)
def test_a_damaged_model_is_refused_in_one_line(gesturekit, model, wav, tmp_path, says):
    copy = tmp_path / "model"
    shutil.copytree(model, copy)
    DAMAGES[says](copy)
    done = gesturekit("render", wav, "--model", copy, "--out", tmp_path / "out").fails(2)
    (line,) = done.err.splitlines()
    assert line.startswith("Error: ") and str(copy) in line and says in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (MemoryError(), "the model cannot be loaded (MemoryError)"),
        (ImportError("no numba"), "the model cannot be loaded (ImportError: no numba)"),
        (PermissionError(13, "no", "a/skeleton.json"), "skeleton.json cannot be read"),
    ],
)
def test_only_a_damaged_file_is_called_damaged(render, model, wav, monkeypatch, error, says):
    def fail(self, *arguments, **keywords):
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(MultiresGenerator, "load_state_dict", fail)
        done = render(wav).fails(2, f"Error: {model}: {says}")
    assert "damaged" not in done.err
    render(wav).ok()


def test_bytes_changed_at_random_never_end_in_a_traceback(gesturekit, model, tmp_path):
    rng = random.Random(0)
    copy = tmp_path / "model"
    refused = 0
    for _ in range(40):
        shutil.copytree(model, copy, dirs_exist_ok=True)
        path = copy / rng.choice(["config.yaml", "skeleton.json", "model.safetensors"])
        data = bytearray(path.read_bytes())
        end = len(data)
        if path.suffix == ".safetensors":  # its header; damaged numbers are still numbers
            end = 8 + int.from_bytes(data[:8], "little")
        if rng.random() < 0.3:
            del data[rng.randrange(end) :]
        else:
            for _ in range(rng.choice([1, 4])):
                data[rng.randrange(end)] = rng.randrange(256)
        path.write_bytes(data)
        made = ("render", "--seconds", 0.4, "--model", copy, "--out", tmp_path / "out")
        done = gesturekit(*made, "--existing", "replace")
        assert done.status in (0, 1, 2), path
        if done.status < 2:
            assert (problems(done.err) == []) == (done.status == 0)
        refused += done.status == 2
    assert refused > 13


def test_ctrl_c_leaves_whole_files_only(model, wav, tmp_path):
    folder, out = tmp_path / "many", tmp_path / "out"
    folder.mkdir()
    for i in range(300):
        shutil.copy(wav, folder / f"{i:03d}.wav")
    command = [sys.executable, "-m", "gesturekit", "render", folder, "--model", model]
    command += ["--out", out, "--format", "npz,html"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    # A shell that runs the tests in the background has children ignore SIGINT.
    heeding = {"preexec_fn": lambda: signal.signal(signal.SIGINT, signal.default_int_handler)}
    running = subprocess.Popen(command, **pipes, **heeding)
    deadline = time.monotonic() + 60
    while not (out / "001.html").exists():
        assert running.poll() is None and time.monotonic() < deadline, running.communicate()
        time.sleep(0.01)
    for pause in (0.1, 0.02, 0.3):  # of somebody in a hurry
        running.send_signal(signal.SIGINT)
        time.sleep(pause)
    told = running.communicate(timeout=60)[1]
    assert running.returncode == 130 and "Traceback" not in told
    assert re.search(r"^Interrupted\. \d+ rendered in .*; the same command continues$", told, re.M)
    assert 2 <= len(names(out)) < 600
    for path in map(out.joinpath, names(out)):
        assert re.fullmatch(r"\d{3}\.(npz|html)", path.name), "nothing temporary is left"
        if path.suffix == ".npz":
            assert Motion.load(path).n_frames == 45
        else:
            assert path.read_text(encoding="utf-8").rstrip().endswith("</html>")
    assert not [path for path in out.iterdir() if path.name.startswith((".0", ".1", ".2"))]


def test_a_rerun_says_what_it_kept_and_what_it_refuses(render, wav, tmp_path):
    make_sound(tmp_path / "in" / "day 2" / "more.wav", 16_000, 16_000)
    made = [str(tmp_path / "out" / name) for name in ("speech.bvh", "day 2/more.bvh")]
    assert render(wav.parent).out.splitlines() == made
    again = render(wav.parent)
    assert (again.status, again.out) == (0, "")
    assert again.err.splitlines()[-1].startswith("0 rendered, 2 kept in ")
    render(wav.parent, "--seed", 1).fails(2, "speech.bvh", "another seed")
    for options in (["--existing", "skip"], ["--skip-existing"]):
        done = render(wav.parent, "--seed", 1, *options)
        assert done.status == 0 and "0 rendered, 2 kept in " in done.err
    done = render(wav.parent, "--seed", 1, "--existing", "replace")
    assert done.status == 0 and "2 rendered in " in done.err


def test_a_split_of_a_corpus(render, corpus, tmp_path):
    render("--corpus", corpus, "--split", "train").ok()
    ids = {item.id: item.duration for item in Manifest.load(corpus)}
    assert len(ids) == 3
    for name, seconds in ids.items():
        assert frames_in(tmp_path / "out" / f"{name}.bvh") == floor(seconds * FPS + 0.5)
    render("--corpus", corpus).fails(2, "no item is in split test (3 in train)")
    for wrong in (["--seconds", 2], [tmp_path / "x.wav"], ["--channel", 1]):
        render("--corpus", corpus, *wrong).fails(2, "--corpus sets the sounds")
    render("--split", "test").fails(2, "--corpus")


def test_an_output_rate_other_than_the_models_is_reported_once(render, wav, tmp_path):
    make_sound(tmp_path / "in" / "more.wav", 16_000, 16_000)
    rate = "Written at 30 fps; the model's own rate is 25 fps (change it with --fps)."
    assert render(wav.parent).err.splitlines().count(rate) == 1
    done = render(wav.parent, "--fps", 25, "--existing", "replace")
    assert "Written at" not in done.err
    asked = render(wav.parent, "--fps", 60, out="asked")
    assert "Written at" not in asked.err, "who gave --fps needs no hint to it"
    assert frames_in(tmp_path / "out" / "speech.bvh") == 38


def test_help_shows_examples_first_and_every_option_in_one_group(gesturekit):
    shown = gesturekit("render", "--help-all").out
    options = [param for param in command.params if isinstance(param, click.Option)]
    grouped = [name for names in GROUPS.values() for name in names]
    assert sorted([*grouped, "help_all"]) == sorted(option.name for option in options)
    headings = re.findall(r"^(\S.*):$", shown, re.MULTILINE)
    assert headings == ["Examples", *GROUPS, "Other options"]
    for option in options:
        assert re.search(rf"^  {option.opts[0]}\b", shown, re.MULTILINE), option.name


def test_values_of_controls_are_checked_by_their_ranges():
    """The bounds of each control of all systems count; files are paths."""
    options = {param.name: param for param in control_options()}
    assert options["foot_lock"].opts == ["--foot-lock"]
    assert options["foot_lock"].secondary_opts == ["--no-foot-lock"]
    assert options["experts"].opts == ["--expert"] and options["experts"].multiple
    assert options["style"].type("3") == "3" and not options["style"].multiple
    assert options["solver"].type("ddim") == "ddim" and options["keep"].type("a") == {0: Path("a")}
    assert {option.default for option in options.values()} == {None}
    with pytest.raises(click.BadParameter):
        options["solver"].type("euler")
    numbers = 0
    for name, entry in {n: e for of_kind in CONTROLS.values() for n, e in of_kind.items()}.items():
        parse = options[name].type
        if entry.kind is Path and name not in ("keep", "level_speech"):
            assert parse("a.bvh") == Path("a.bvh")
        if entry.kind not in (int, float) or entry.choices:
            continue
        numbers += 1
        step = 1 if entry.kind is int else 1e-6
        inside, outside = [], []
        if entry.above is not None:
            inside, outside = [entry.above + step], [entry.above]
        if entry.least is not None:
            inside, outside = [*inside, entry.least], [*outside, entry.least - step]
        if entry.most is not None:
            inside, outside = [*inside, entry.most], [*outside, entry.most + step]
        for value in inside:
            found = parse(str(value))
            assert found == value and type(found) is entry.kind, name
        for value in outside:
            with pytest.raises(click.BadParameter):
                parse(str(value))
    assert numbers > 10
    for name in ("hold", "chance"):
        with pytest.raises(click.BadParameter):
            options["change"].type(name)


def test_the_splits_to_choose_from_are_those_of_a_manifest():
    (split,) = (param for param in command.params if param.name == "split")
    assert set(split.type.choices) == set(SPLITS)


def test_the_summary_counts_sounds_and_motions(render, wav):
    done = render(wav, "--samples", 3, "--format", ".BVH").ok()
    assert re.search(r"^1 rendered \(3 motions\) in ", done.err, re.MULTILINE)


@pytest.mark.parametrize("option", ["--like", "--path", "--keyframes", "--keep"])
def test_a_missing_control_file_stops_before_the_first_item(gesturekit, wav, option, tmp_path):
    done = gesturekit("render", wav, "--model", "demo", option, "no.bvh", "--out", tmp_path / "out")
    assert done.status == 2 and f"{option[2:]}: no.bvh: no such file" in done.err
    assert not (tmp_path / "out").exists()


def test_sounds_that_cannot_be_decoded_fail_alone_and_in_folders(gesturekit, model, wav, tmp_path):
    folder = wav.parent
    (folder / "talk.m4a").write_bytes(b"\0\0\0\x20ftypM4A " + bytes(100))
    (folder / f"{wav.stem}.m4a").write_bytes(b"\0\0\0\x20ftypM4A " + bytes(100))
    for verb, model_of in (("render", ("--model", model)), ("features", ())):
        for source in (folder / "talk.m4a", folder):
            done = gesturekit(verb, source, *model_of, "--out", tmp_path / verb)
            (line,) = [line for line in done.err.splitlines() if "m4a" in line]
            assert done.status == 1 and "ffmpeg -i" in line and "talk.m4a" in line
        assert [path.stem for path in (tmp_path / verb).glob("*.[bn]*")] == [wav.stem]


def test_a_dry_run_says_what_it_did_not_look_at(render, model, wav, tmp_path):
    (wav.parent / "talk.m4a").write_bytes(b"\0\0\0\x20ftypM4A " + bytes(100))
    (wav.parent / "text.wav").write_text("Dear diary,\n")
    (wav.parent / "void.flac").touch()
    done = render(wav.parent, "--dry-run")
    assert done.status == 0 and "1 to make, 0 to keep, 3 to fail" in done.err
    assert "only the headers of sounds were read: damage inside them is not counted" in done.err
    gk.load(model).generate(seconds=2.0).save(tmp_path / "edit.bvh")
    idle = render("--keyframes", tmp_path / "edit.bvh", "--dry-run")
    assert idle.status == 0 and "1 to make, 0 to keep, 0 to fail" in idle.err
    assert re.search(r"^fail .*text\.wav -> .*cannot be read as sound", done.out, re.MULTILINE)
    many = render(wav, "--dry-run", "--samples", 200)
    assert len(many.out) < 1000 and "196 more" in many.out
    of_one, of_many = (re.search(r"about ([\d.]+) MB", each.err)[1] for each in (done, many))
    assert float(of_many) / 200 == pytest.approx(float(of_one), abs=0.06)


def test_speakers_that_are_not_chosen_are_warned_about(gesturekit, wav, tmp_path, monkeypatch):
    """If any of the sounds has none: gestures are then those of all speakers."""
    demo = gk.load("demo")
    several = replace(demo, speakers=dict.fromkeys(("bob", "ann"), demo.skeleton))
    monkeypatch.setattr(systems, "load", lambda *_, **__: several)
    lines = [{"audio": str(wav), "id": "a", "speaker": "ann"}, {"audio": str(wav), "id": "b"}]
    says = "Warning: the model has 2 speakers and none is chosen: gestures are those of all of them"
    render = ("render", "--model", "demo", "--out", tmp_path / "out", "--dry-run")
    for rows, options, is_warned in (
        (lines, (), True),
        (lines[:1], (), False),
        (lines[1:], (), True),
        (lines, ("--speaker", "bob"), False),
    ):
        (tmp_path / "list.jsonl").write_text("".join(f"{json.dumps(row)}\n" for row in rows))
        done = gesturekit(*render, tmp_path / "list.jsonl", *options).ok()
        assert (says in done.err) == is_warned
        assert ("(ann, bob)" in done.err) == is_warned
