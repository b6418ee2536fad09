"""gesturekit render: what comes out, under which name, and what is said about what does not."""

import os
import re
import shutil
from fractions import Fraction
from math import floor
from pathlib import Path

import numpy as np
import pytest
import soundfile
from pages import data_of
from sounds import voiced

import gesturekit as gk
from gesturekit import Motion
from gesturekit.corpus import Manifest

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
    """Files that users give by accident, by a word on what is wrong with them."""
    folder = tmp_path / "in"
    folder.mkdir(exist_ok=True)
    files = {
        "no such": folder / "missing.wav",
        "empty": folder / "empty.wav",
        r"\b10(\.0)? ms": make_sound(folder / "short.wav", 160, 16_000),
        "Dear dia": folder / "text.wav",
        "truncated": make_sound(folder / "truncated.wav", 16_000, 16_000),
        "nan": folder / "damaged.wav",
    }
    files["empty"].touch()
    files["Dear dia"].write_text("Dear diary,\n")
    whole = files["truncated"].read_bytes()
    files["truncated"].write_bytes(whole[: len(whole) // 2])
    soundfile.write(files["nan"], np.full(16_000, np.nan), 16_000, subtype="FLOAT")
    return files


def frames_in(bvh: Path) -> int:
    return int(re.search(r"^Frames: (\d+)$", bvh.read_text(), re.MULTILINE)[1])


def names(folder: Path) -> list[str]:
    """Names in a folder, but for hidden files."""
    return sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))


def problems(err: str) -> list[str]:
    """Lines on stderr that name a sound."""
    return [line for line in err.splitlines() if re.search(r"\.(wav|WAV|flac|ogg)\b", line)]


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


def test_every_format_holds_the_same_motion(render, wav, tmp_path):
    out = tmp_path / "a folder" / "ausgabe für später"
    done = render(wav, wav.parent, "--format", ".BVH,npz, html ,png", out=out)
    assert (done.status, problems(done.err)) == (0, [])
    assert "1 rendered" in done.err
    kinds = ("bvh", "html", "npz", "png")
    assert names(out) == [f"speech.{kind}" for kind in kinds]
    bvh, npz = Motion.load(out / "speech.bvh"), Motion.load(out / "speech.npz")
    assert bvh.skeleton.names == npz.skeleton.names
    np.testing.assert_allclose(bvh.positions(), npz.positions(), atol=1e-4)
    assert data_of(out / "speech.html")["audio"]
    assert (out / "speech.png").read_bytes().startswith(b"\x89PNG")


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(render, wav, tmp_path):
    for name, seed in {"one": 3, "same": 3, "other": 4}.items():
        render(wav, "--format", "bvh,npz,html", "--seed", seed, out=name).ok()
    for kind in ("bvh", "npz", "html"):
        made = {n: (tmp_path / n / f"speech.{kind}").read_bytes() for n in ("one", "same", "other")}
        assert made["one"] == made["same"] != made["other"], kind


def test_other_items_do_not_change_a_rendering(render, wav, tmp_path):
    second = make_sound(tmp_path / "in" / "second.wav", 50_001, 22_050)
    render(wav, "--format", "bvh,npz", out="alone").ok()
    done = render(second, wav, "--samples", 3, "--format", "bvh,npz", out="last").ok()
    assert "2 rendered" in done.err and "6 motions" in done.err
    for kind in ("bvh", "npz"):
        made = [(tmp_path / "last" / f"speech_s{i}.{kind}").read_bytes() for i in (1, 2, 3)]
        assert len(set(made)) == 3, "samples differ"
        assert made[0] == (tmp_path / "alone" / f"speech.{kind}").read_bytes()


def test_options_of_a_motion_are_those_of_generate(render, model, wav, gesture, tmp_path):
    loaded = gk.load(model)
    for name, flags, controls in (
        ("as-is", ["--no-foot-lock"], {"foot_lock": False}),
        ("smooth", ["--smooth", 0.2], {"smooth": 0.2}),
        ("raw", ["--raw"], {"raw": True}),
    ):
        render(wav, "--format", "npz", *flags, out=name).ok()
        made = Motion.load(tmp_path / name / "speech.npz")
        wanted = loaded.generate(wav, item="speech", **controls)
        assert (made.rotations == wanted.rotations).all(), name
    gesture(1.0).save(tmp_path / "avatar.bvh")
    rig = ("--rig", tmp_path / "avatar.bvh", "--rig-part")
    render(wav, *rig, "head=Head", out="rig").ok()
    assert Motion.load(tmp_path / "rig" / "speech.bvh").n_frames == 45
    render(wav, *rig, "head=LeftHand").fails(2, "'LeftHand'")


def test_a_broken_file_never_stops_the_others(render, wav, broken, tmp_path):
    silent = tmp_path / "in" / "silent.wav"
    soundfile.write(silent, np.zeros(16_000), 16_000)
    done = render(*broken.values(), silent, wav, "--format", "bvh,npz")
    output = problems(done.err)
    assert done.status == 1 and len(output) == len(broken) + 1, done.err
    for (reason, path), line in zip(broken.items(), output, strict=False):
        assert str(path) in line and re.search(reason, line.replace(str(path), ""))
    assert str(silent) in output[-1]
    made = [f"{stem}.{kind}" for stem in ("silent", "speech") for kind in ("bvh", "npz")]
    assert names(tmp_path / "out") == sorted(made)
    assert done.out.split() == [str(tmp_path / "out" / name) for name in made]


def test_channel_selects_one_of_two_speakers(render, tmp_path):
    one = voiced(2.0)
    two = 0.1 * np.stack([one, 0.5 * np.roll(one, 5_000)], axis=1)
    (tmp_path / "mono").mkdir()
    second = tmp_path / "mono" / "two.wav"
    soundfile.write(tmp_path / "two.wav", two, 16_000)
    soundfile.write(second, two[:, 1], 16_000)
    render(tmp_path / "two.wav", "--channel", 2).ok()
    render(second, out="second").ok()
    render(tmp_path / "two.wav", out="both").ok()
    made = [(tmp_path / n / "two.bvh").read_bytes() for n in ("out", "second", "both")]
    assert made[0] == made[1] != made[2]
    render(second, "--channel", 2, out="none").fails(1, "two.wav", "channel 2")


def test_silence_and_noise_are_idle_unless_voice_activity_detection_is_off(
    render, tmp_path, caplog
):
    noise = 0.1 * np.random.default_rng(0).standard_normal(20_000)
    render("--seconds", 1.25, out="idle").ok()
    motions = {"idle": Motion.load(tmp_path / "idle" / "motion.bvh")}
    for name, sound, options in (
        ("zeros", 0 * noise, []),
        ("noise", noise, []),
        ("whisper", noise, ["--no-vad"]),
    ):
        (tmp_path / "in" / name).mkdir(parents=True)
        wav = tmp_path / "in" / name / "motion.wav"
        soundfile.write(wav, sound, 16_000)
        render(wav, *options, out=name).ok()
        motions[name] = Motion.load(tmp_path / name / "motion.bvh")
    assert str(Path("noise", "motion.wav")) in caplog.text
    assert str(Path("zeros", "motion.wav")) in caplog.text
    idle = motions["idle"].positions()
    for name, is_idle in (("zeros", True), ("noise", True), ("whisper", False)):
        assert np.allclose(motions[name].positions(), idle, atol=1e-3) == is_idle, name


def test_files_with_difficult_names(render, wav, tmp_path):
    odd = ["with space", "Ünï 漢字 🎤", "a.b.c", "-dash", "%s {0}", os.fsdecode(b"\xff\xfe")]
    folder = tmp_path / "odd names"
    folder.mkdir()
    shutil.copy(wav, folder / "._of_macos.wav")  # what macOS leaves on other disks is skipped
    try:
        for stem in odd:
            shutil.copy(wav, folder / f"{stem}.WAV")
    except OSError:
        odd.pop()  # this file system takes only Unicode names
    for rendered in (len(odd), 0):
        done = render(folder, "--format", "bvh,html")
        assert (done.status, problems(done.err)) == (0, [])
        assert f"{rendered} rendered" in done.err
    made = sorted(f"{stem}.{kind}" for stem in odd for kind in ("bvh", "html"))
    assert names(tmp_path / "out") == made
    motions = {(tmp_path / "out" / f"{stem}.bvh").read_bytes() for stem in odd}
    assert len(motions) == len(odd), "each file is a draw of its own"


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--format", "bvh,fbx"], "convert x.npz x.fbx"),
        (["--model", "demmo"], "demmo"),
        (["--seed", "one"], "seed"),
        (["--smooth", "-1"], "--smooth"),
        (["--solver", "euler"], "--solver"),
        (["--change", "2"], "--change"),
        (["in/other/speech.flac"], "speech.flac"),
        (["in/nothing"], "in/nothing"),
        (["--out", "in/speech.wav/out"], "in/speech.wav/out"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_usage_errors_are_reported_before_any_work(
    gesturekit, model, wav, tmp_path, monkeypatch, arguments, says
):
    monkeypatch.chdir(tmp_path)
    make_sound(tmp_path / "in" / "other" / "speech.flac", 16_000, 16_000)
    (tmp_path / "in" / "nothing").mkdir()
    done = gesturekit("render", "in/speech.wav", "--model", model, "--out", "out", *arguments)
    assert done.status == 2
    assert re.search(says, done.err.splitlines()[-1]) and done.out == ""
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("name", "old", "new", "says"),
    [
        ("config.yaml", "kind: multires", "kind: telepathy", "'telepathy'"),
        ("config.yaml", None, "kind: [multires", "config.yaml"),
        ("config.yaml", None, None, "config.yaml"),
        ("model.safetensors", None, "x" * 5000, "model.safetensors"),
        ("skeleton.json", None, '{"skeleton": [1]}', "damaged"),
    ],
)
def test_a_damaged_model_is_refused_in_one_line(render, model, wav, tmp_path, name, old, new, says):
    copy = tmp_path / "model"
    shutil.copytree(model, copy)
    file = copy / name
    if old is not None:
        new = file.read_text(encoding="utf-8").replace(old, new)
    if new is None:
        file.unlink()
    else:
        file.write_text(new, encoding="utf-8")
    (line,) = render(wav, "--model", copy).fails(2).err.splitlines()
    assert str(copy) in line and says in line
    assert not (tmp_path / "out").exists()


def test_a_rerun_says_what_it_kept_and_what_it_refuses(render, wav, tmp_path):
    make_sound(tmp_path / "in" / "day 2" / "more.wav", 16_000, 16_000)
    made = [str(tmp_path / "out" / name) for name in ("speech.bvh", "day 2/more.bvh")]
    assert render(wav.parent).out.splitlines() == made
    again = render(wav.parent)
    assert (again.status, again.out) == (0, "")
    assert "0 rendered" in again.err and "2 kept" in again.err
    render(wav.parent, "--seed", 1).fails(2, "speech.bvh", "seed")
    assert "2 kept" in render(wav.parent, "--seed", 1, "--existing", "skip").ok().err
    assert "2 rendered" in render(wav.parent, "--seed", 1, "--existing", "replace").ok().err


def test_an_output_rate_other_than_the_models_is_reported_once(render, wav, tmp_path):
    make_sound(tmp_path / "in" / "more.wav", 16_000, 16_000)
    lines = render(wav.parent).err.splitlines()
    assert sum("30 fps" in line and "25 fps" in line for line in lines) == 1
    assert "30 fps" not in render(wav.parent, "--fps", 25, "--existing", "replace").err
    assert frames_in(tmp_path / "out" / "speech.bvh") == 38


def test_a_missing_control_file_stops_before_the_first_item(render, wav, tmp_path):
    for option in ("--like", "--path", "--keyframes", "--keep"):
        done = render(wav, "--model", "demo", option, "no.bvh")
        done.fails(2, "no.bvh", option[2:])
    assert not (tmp_path / "out").exists()


def test_sounds_that_cannot_be_decoded_fail_alone_and_in_folders(gesturekit, model, wav, tmp_path):
    (wav.parent / "talk.m4a").write_bytes(b"\0\0\0\x20ftypM4A " + bytes(100))
    for verb, model_of in (("render", ("--model", model)), ("features", ())):
        for source in (wav.parent / "talk.m4a", wav.parent):
            done = gesturekit(verb, source, *model_of, "--out", tmp_path / verb)
            (line,) = [line for line in done.err.splitlines() if "m4a" in line]
            assert done.status == 1 and "ffmpeg -i" in line and "talk.m4a" in line
        assert [path.stem for path in (tmp_path / verb).glob("*.[bn]*")] == [wav.stem]


def test_a_split_of_a_corpus_and_lengths(render, corpus, tmp_path):
    render("--corpus", corpus, "--split", "train").ok()
    for item in Manifest.load(corpus):
        n_frames = floor(item.duration * FPS + 0.5)
        assert frames_in(tmp_path / "out" / f"{item.id}.bvh") == n_frames
    done = render("--corpus", corpus).fails(2)
    assert re.search(r"(?=.*\btest\b)(?=.*\b3\b)(?=.*\btrain\b)", done.err)
    for seconds in ("-1", "0", "1e12", "inf", "soon"):
        render("--seconds", seconds).fails(2, "--seconds")
