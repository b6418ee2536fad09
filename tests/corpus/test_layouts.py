"""Public corpora by name: tiny folders in their shapes, beside lists written by hand."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import published
import pytest
from published import DANCES, INFO, WORDS, info_row, write

from audio_features import load_words
from gesturekit.corpus import Manifest, Report, prepare
from gesturekit.corpus.layouts import LAYOUTS
from gesturekit.corpus.layouts.zeggs import read_zeggs
from gesturekit.errors import CorpusError


def messages(report: Report, severity: str) -> str:
    return "\n".join(p.text for p in report.problems if p.severity == severity)


def summary(report: Report) -> set[tuple]:
    """Return (id, split, speaker, style, has sound, has motion) of each item."""
    return {
        (i.id, i.split, i.speaker, i.style, i.audio is not None, i.motion is not None)
        for i in report.manifest
    }


@pytest.fixture
def write_bvh(gesture) -> Callable[..., Path]:
    def make(path: Path, seconds: float = 1.0, fps: float = 30.0, seed: int = 0) -> Path:
        path.parent.mkdir(parents=True, exist_ok=True)
        gesture(seconds, fps, seed=seed).save(path)
        return path

    return make


@pytest.fixture
def publish(write_bvh, write_speech, tmp_path) -> Callable[..., Path]:
    """publish("beat2"): a tiny folder in the shape of a public corpus."""

    def make(corpus: str, root: Path = tmp_path) -> Path:
        getattr(published, corpus)(root, write_bvh, write_speech)
        return root

    return make


@pytest.fixture
def beat2(tmp_path, publish) -> Path:
    return publish("beat2", tmp_path / "BEAT2" / "beat_english_v2.0.0")


@pytest.fixture
def zeggs(tmp_path, publish) -> Path:
    """Clean recordings of three takes, one of them mirrored and at another speed too."""
    clean = publish("zeggs", tmp_path / "ZeroEGGS") / "clean"
    for copy in ("001_Neutral_0_mirror_x_1_0", "001_Neutral_0_x_0_9"):
        for suffix in ("bvh", "wav"):
            shutil.copy(clean / f"001_Neutral_0_x_1_0.{suffix}", clean / f"{copy}.{suffix}")
    return clean.parent


def test_beat2(beat2, tmp_path):
    report = prepare(beat2.parent, tmp_path / "corpus.jsonl", layout="beat2")
    assert summary(report) == {
        ("2_scott_0_1_1", "train", "scott", "neutral", True, True),
        ("2_scott_0_65_65", "valid", "scott", "happiness", True, True),
        ("1_wayne_0_86_87", "test", "wayne", "sadness", True, True),
        ("1_wayne_0_103_103", "train", "wayne", "fear", True, True),
    }
    assert report.is_complete
    assert "additional, in no split and left out: 1: 30_katya_1_9_9" in messages(report, "note")
    item = Manifest.load(tmp_path / "corpus.jsonl").in_split("test")[0]
    assert item.conditions["words"].name == "1_wayne_0_86_87.TextGrid"
    assert item.conditions["semantics"] == beat2 / "sem" / "1_wayne_0_86_87.txt"
    assert item.load_motion().n_frames == 45 and item.duration == 1.5
    assert item.load_wave().words == item.conditions["words"]


def test_missing_and_broken_beat2_files_are_listed(beat2):
    (beat2 / "wave16k" / "2_scott_0_1_1.wav").unlink()
    (beat2 / "smplxflame_30" / "1_wayne_0_103_103.npz").write_bytes(b"no npz")
    write(beat2 / "sem" / "1_wayne_0_86_87.txt", "beat\tx\n")
    write(beat2 / "textgrid" / "1_wayne_0_86_87.TextGrid", WORDS[:-20])
    (beat2 / "textgrid" / "2_scott_0_65_65.TextGrid").unlink()
    shutil.copy(beat2 / "wave16k" / "2_scott_0_65_65.wav", beat2 / "wave16k" / "9_new_0_1_1.wav")
    report = prepare(beat2, layout="beat2")
    assert {item.id for item in report.manifest} == {"2_scott_0_65_65", "1_wayne_0_86_87"}
    errors = messages(report, "error")
    assert "not there: 1 wav file: 2_scott_0_1_1.wav" in errors
    assert "1_wayne_0_103_103.npz" in errors
    warnings = messages(report, "warning")
    assert "sem/1_wayne_0_86_87.txt: line 1" in warnings
    assert "textgrid/1_wayne_0_86_87.TextGrid" in warnings
    assert "1 TextGrid: 2_scott_0_65_65.TextGrid" in messages(report, "note")
    (item,) = report.manifest.in_split("test")
    assert not item.conditions and report.left_over == (beat2 / "wave16k" / "9_new_0_1_1.wav",)
    index = beat2 / "train_test_split.csv"
    for text, complaint in (
        ("id,type\n2_scott_0_1_1,training\n", "line 2: type is 'training'"),
        ("id,type\n2_scott_0_1_1,train\n2_scott_0_1_1,test\n", "line 3: .*listed twice"),
        ("name,split\n", "column 'name'"),
    ):
        index.write_text(text)
        with pytest.raises(CorpusError, match=f"train_test_split.csv, {complaint}|{complaint}"):
            prepare(beat2, layout="beat2")
    index.unlink()
    with pytest.raises(CorpusError, match="train_test_split.csv: not found"):
        prepare(beat2, layout="beat2")


def test_zeggs(zeggs):
    report = prepare(zeggs, layout="zeggs")
    assert summary(report) == {
        ("001_Neutral_0_x_1_0", "train", "zeggs", "Neutral", True, True),
        ("005_Neutral_4_x_1_0", "valid", "zeggs", "Neutral", True, True),
        ("067_Speech_2_x_1_0", "valid", "zeggs", "Speech", True, True),
    }
    assert report.is_complete
    notes = messages(report, "note")
    assert "left out: 2: 001_Neutral_0_mirror_x_1_0.bvh, 001_Neutral_0_x_0_9" in notes
    (zeggs / "clean" / "001_Neutral_0_x_1_0.wav").unlink()
    (zeggs / "clean" / "005_Neutral_4_x_1_0.bvh").write_text("HIERARCHY")
    (zeggs / "clean" / "067_Speech_2_x_1_0.wav").unlink()
    (zeggs / "clean" / "067_Speech_2_x_1_0.bvh").unlink()
    errors = messages(prepare(zeggs, layout="zeggs"), "error")
    for name in ("001_Neutral_0_x_1_0.wav", "005_Neutral_4_x_1_0.bvh", "info.csv: 067_Speech_2"):
        assert name in errors
    text = (zeggs / "info.csv").read_text()
    write(zeggs / "info.csv", text.replace("FALSE", "no"))
    with pytest.raises(CorpusError, match="info.csv, line 2: validation is 'no'"):
        prepare(zeggs, layout="zeggs")


def test_original_zeggs_is_aligned_trimmed_and_masked(tmp_path, write_bvh, write_speech):
    """Sound begins at 1.5 s, motion at 2.5 s, acting lasts from 3.5 s to 5 s of the time code."""
    original = tmp_path / "original"
    for take in ("001_Neutral_0", "002_Neutral_1", "003_Neutral_2"):
        write_bvh(original / f"{take}.bvh", 3.0, 60.0)
        write_speech(original / f"{take}.wav", 5.0)
        turns = "R1,00:02.250,00:02.500,yes\nM1,00:03.0,00:09.0,no\n"
        write(original / f"{take}.csv", f"#,Start,End,Text\n{turns}")
    rows = info_row("001_Neutral_0", "Neutral", "FALSE") + info_row("003_Neutral_2", "Sad", "TRUE")
    write(tmp_path / "info.csv", INFO + rows)
    write(original / "003_Neutral_2.csv", "#,Start,End\nR1,soon,00:02.500\n")
    report = prepare(tmp_path, layout="zeggs")
    (item,) = report.manifest
    assert (item.motion_start, item.audio_start, item.duration) == (1.0, 2.0, 1.5)
    assert (item.id, item.split, item.audible) == ("001_Neutral_0", "train", ((2.25, 2.5),))
    assert item.load_motion().n_frames == 90
    heard = np.flatnonzero(item.load_wave().samples) / 16_000
    assert heard.size and heard.min() >= 0.25 and heard.max() < 0.5
    errors = messages(report, "error")
    assert "003_Neutral_2.csv, line 2: start is 'soon'" in errors
    assert "002_Neutral_1.bvh: no row in" in errors
    manifest = tmp_path / "corpus.jsonl"
    prepare(tmp_path, manifest, layout="zeggs")
    assert Manifest.load(manifest).items[0].audible == ((2.25, 2.5),)
    (original / "001_Neutral_0.csv").unlink()
    report = prepare(tmp_path, layout="zeggs")
    assert report.manifest.items[0].audible == ()
    assert "001_Neutral_0.wav: without 001_Neutral_0.csv other voices" in messages(
        report, "warning"
    )


def original(folder: Path, times: str, turns: str | None = None):
    """Read an original recording with these times of audio, anim, acting and its end."""
    (folder / "original").mkdir(exist_ok=True)
    for suffix in ("bvh", "wav"):
        (folder / "original" / f"001_Neutral_0.{suffix}").touch()
    table = folder / "original" / "001_Neutral_0.csv"
    table.unlink(missing_ok=True)
    if turns is not None:
        write(table, f"#,Start,End\n{turns}\n")
    audio, anim, acting, end = times.split()
    row = f"001_Neutral_0.wav,{audio},{anim},Neutral,{acting},{end},001_Neutral_0.bvh,FALSE\n"
    write(folder / "info.csv", INFO + row)
    return read_zeggs(folder)


def test_time_codes_of_zeggs_have_hours_and_frames(tmp_path):
    """Sound counts 30 frames a second, motion and acting 60."""
    times = "01:02:03:15 01:02:04:45 01:02:05:00 01:03:04:30"
    turns = "R1,01:02.250,01:03.5\nM,00:01.0,00:02.0\nRM,00:00:125,00:00.125"
    (found,) = original(tmp_path, times, turns).recordings
    assert found.audio_offset == pytest.approx(4.75 - 3.5)
    assert found.limits == pytest.approx((0.25, 59.75))
    assert found.audible == ((62.25, 63.5), (0.125, 0.125))
    assert (found.speaker, found.style, found.split) == ("zeggs", "Neutral", "train")
    # Over the hour; acting may begin with the motion.
    (found,) = original(tmp_path, "00:59:59:00 01:00:00:00 01:00:00:00 01:00:01:00", "").recordings
    assert (found.audio_offset, found.limits, found.audible) == (1.0, (0.0, 1.0), ())


@pytest.mark.parametrize(
    ("times", "turns", "says"),
    [
        ("0:0:0:0 0:0:1:0 0:0:0:59 0:0:2:0", "", "acting from -0.02 to 1.00 s"),
        ("0:0:0:0 0:0:1:0 0:0:2:0 0:0:2:0", "", "acting from 1.00 to 1.00 s"),
        ("0:0:0:0 0:0:1 0:0:2:0 0:0:3:0", "", "anim_start_time is '0:0:1'; expected HH:MM"),
        ("0:0:0:0 0:0:1:0 0:0:1:0 0:0:2:0", "R,00:02.0,00:01.999", "before 2.0 s"),
        ("0:0:0:0 0:0:1:0 0:0:1:0 0:0:2:0", "R,00:02.0,soon", "end is 'soon'; expected MM:SS"),
    ],
)
def test_wrong_times_of_zeggs_leave_their_recording_out(tmp_path, times, turns, says):
    listing = original(tmp_path, times, turns)
    assert listing.recordings == [] and listing.left_over == []
    (problem,) = [problem for problem in listing.problems if problem.severity == "error"]
    assert says in problem.text


def test_genea2023(publish):
    root = publish("genea2023")
    report = prepare(root, layout="genea2023")
    assert summary(report) == {
        ("trn/trn_2023_v0_000_main-agent", "train", "1", None, True, True),
        ("trn/trn_2023_v0_001_main-agent", "train", "2", None, True, True),
        ("val/val_2023_v0_000_main-agent", "valid", "1", None, True, True),
        ("tst/tst_2023_v0_000_main-agent", "test", "1", None, True, False),
    }
    item = report.manifest.in_split("valid")[0]
    assert set(item.conditions) == {"words", "partner_audio", "partner_motion", "partner_words"}
    assert item.conditions["partner_audio"].name == "val_2023_v0_000_interloctr.wav"
    notes = messages(report, "note")
    assert "fingers were not recorded (metadata.csv): 1: trn_2023_v0_001" in notes
    (root / "trn" / "main-agent" / "bvh" / "trn_2023_v0_001_main-agent.bvh").unlink()
    (root / "val" / "main-agent" / "wav" / "val_2023_v0_000_main-agent.wav").write_text("x")
    words = root / "trn" / "main-agent" / "tsv" / "trn_2023_v0_000_main-agent.tsv"
    words.write_text("a\tb\n")
    report = prepare(root, layout="genea2023")
    assert len(report.manifest) == 2
    assert "trn_2023_v0_001_main-agent.bvh" in messages(report, "error")
    assert "val_2023_v0_000_main-agent.wav" in messages(report, "error")
    assert f"{words}, line 1" in messages(report, "warning")


def test_motorica(tmp_path, publish, write_bvh):
    names = DANCES
    publish("motorica")
    write_bvh(tmp_path / "bvh" / "a.bvh")
    report = prepare(tmp_path, layout="motorica", hold_out_pattern="song_001")
    assert summary(report) == {
        (names[0], "train", "d02", "gLO", True, True),
        (names[1], "test", "d01", "gPO", True, True),
        (names[2], "train", "d02", "gPO", False, True),
    }
    assert f"(motion alone): {names[2]}.wav" in messages(report, "note")
    assert report.left_over == (tmp_path / "bvh" / "a.bvh",)
    # The released list of test files names copies of a dance; a number of its own is no copy.
    released = tmp_path / "dance_test_files.txt"
    released.write_text(f"{names[0]}_00\n{names[0]}_01\n{names[2]}_00_mirrored\n")
    held = prepare(tmp_path, layout="motorica", hold_out_list=released).manifest
    assert [item.id for item in held if item.split == "test"] == [names[0], names[2]]
    released.write_text(f"{names[0].replace('_000', '')}_00\n")
    with pytest.raises(CorpusError, match="1 name without a usable recording: .*_song_00"):
        prepare(tmp_path, layout="motorica", hold_out_list=released)
    # A hundredth of the published rate is rounding, more is not.
    for fps, is_noted in ((119.0, False), (121.0, False), (118.0, True), (122.0, True)):
        write_bvh(next(tmp_path.rglob(f"{names[0]}.bvh")), 1.0, fps)
        notes = messages(prepare(tmp_path, layout="motorica"), "note")
        assert (f"{names[0]}.bvh: {fps:g} fps; published at 120 fps" in notes) == is_noted
    with pytest.raises(CorpusError, match="no recording of Motorica"):
        prepare(tmp_path / "wav", layout="motorica")


def test_100style(tmp_path, publish):
    publish("style100")
    report = prepare(tmp_path, layout="100style", holdout=0.0)
    assert summary(report) == {
        ("Angry/Angry_BR", "train", None, "Angry", False, True),
        ("Angry/Angry_ID", "train", None, "Angry", False, True),
        ("Old/Old_BR", "train", None, "Old", False, True),
    }
    cuts = {i.id: (i.motion_start, i.duration) for i in report.manifest}
    assert cuts["Angry/Angry_BR"] == (0.1, 0.9) and cuts["Angry/Angry_ID"] == (0.2, 1.3)
    assert "not there: 1 bvh file: Old_ID.bvh" in messages(report, "error")
    assert "without a cut in Frame_Cuts.csv, left out: 1: Angry_FW.bvh" in messages(report, "note")
    text = (tmp_path / "Frame_Cuts.csv").read_text()
    write(tmp_path / "Frame_Cuts.csv", text.replace("12,90", "90,12"))
    with pytest.raises(CorpusError, match=r"Frame_Cuts.csv, line 2: ID_START"):
        prepare(tmp_path, layout="100style")


def test_trinity(tmp_path, publish, write_bvh):
    source = publish("trinity") / "source"
    (source / "audio" / "Recording_009.wav").unlink()
    write_bvh(source / "bvh" / "A_pose.bvh")
    write_bvh(source / "bvh" / "Recording_000.bvh")
    report = prepare(tmp_path, layout="trinity")
    assert summary(report) == {
        ("Recording_001", "train", "trinity", None, True, True),
        ("Recording_008", "test", "trinity", None, True, True),
    }
    assert "Recording_000.wav, Recording_009.wav" in messages(report, "error")
    assert source / "bvh" / "A_pose.bvh" in report.left_over
    write_bvh(tmp_path / "raw" / "NaturalTalking_001.bvh")
    with pytest.raises(CorpusError, match="raw form"):
        prepare(tmp_path / "raw", layout="trinity")


def test_seamless(tmp_path, write_speech):
    def make(split: str, name: str, valid: np.ndarray | None = None, seed: int = 0) -> Path:
        stem = tmp_path / "improvised" / split / "0000" / "0001" / name
        write_speech(stem.with_suffix(".wav"), 3.0, 48_000)
        said = [{"start": 0.5, "end": 1.0, "text": "well yes"}]
        write(stem.with_suffix(".json"), json.dumps({"metadata:transcript": said}))
        body = 0.1 * np.sin(np.arange(90)[:, None, None] / 9 + np.arange(63).reshape(21, 3) + seed)
        body[:, 15, 2], body[:, 16, 2] = -1.2, 1.2  # the arms hang
        hands = {f"smplh:{s}_hand_pose": np.zeros((90, 15, 3)) for s in ("left", "right")}
        camera = {"smplh:global_orient": np.tile([np.pi, 0, 0], (90, 1))}
        camera["smplh:translation"] = np.tile([0.0, 0.3, 4.0], (90, 1))
        valid = np.ones(90, bool) if valid is None else valid
        arrays = {"smplh:body_pose": body, "smplh:is_valid": valid, **hands, **camera}
        np.savez(stem.with_suffix(".npz"), **arrays)
        return stem

    gap = ~np.isin(np.arange(90), [*range(40, 45), 70])
    one = make("train", "V00_S0809_I00000582_P0947")
    two = make("train", "V00_S0809_I00000582_P0951", gap, 1)
    three = make("dev", "V00_S0810_I00000001_P0947", seed=2)
    report = prepare(tmp_path, layout="seamless")
    at = "improvised/train/0000/0001"
    assert summary(report) == {
        (f"{at}/{one.name}", "train", "P0947", "improvised", True, True),
        (f"{at}/{two.name}@0.00-1.33", "train", "P0951", "improvised", True, True),
        (f"{at.replace('train', 'dev')}/{three.name}", "valid", "P0947", "improvised", True, True),
    }
    assert "6 of 90 frames are marked invalid" in messages(report, "note")
    (item,) = (item for item in report.manifest if item.id == f"{at}/{one.name}")
    assert item.conditions["partner_motion"] == two.with_suffix(".npz")
    assert [word.text for word in load_words(item.conditions["words"])] == ["well", "yes"]
    motion = item.load_motion()
    positions = motion.positions()
    head, foot = motion.skeleton.index("head"), motion.skeleton.index("left_foot")
    assert (positions[:, head, 1] - positions[:, foot, 1]).min() > 1.0  # upright
    np.savez(three.with_suffix(".npz"), **{"smplh:body_pose": np.zeros((90, 20, 3))})
    one.with_suffix(".wav").unlink()
    errors = messages(prepare(tmp_path, layout="seamless"), "error")
    assert f"{three.name}.npz" in errors and f"1 wav file: {one.name}.wav" in errors


def test_layouts_that_cannot_be_used(tmp_path):
    page = (Path(__file__).parents[2] / "docs" / "corpora.md").read_text(encoding="utf-8")
    with pytest.raises(CorpusError, match="did you mean beat2"):
        prepare(tmp_path, layout="beat")
    with pytest.raises(CorpusError, match="2 folders"):
        prepare([tmp_path, tmp_path], layout="zeggs")
    for layout in LAYOUTS:
        assert f"\n| `{layout}` |" in page
        with pytest.raises(CorpusError, match="nowhere: no such folder"):
            prepare(tmp_path / "nowhere", layout=layout)


def test_hold_outs_by_name(tmp_path, write_pair):
    for seed, name in enumerate(("ann/a1", "ann/a2", "bob/b1", "bob/b2")):
        write_pair(tmp_path / "in", name, 1.0, seed=seed)
    speakers = {"style_pattern": "(?P<speaker>ann|bob)/"}

    def held(**options) -> set[str]:
        report = prepare(tmp_path / "in", **speakers, **options)
        assert {i.split for i in report.manifest} == {"train", "test"}
        return {item.id for item in report.manifest if item.split == "test"}

    names = tmp_path / "test.txt"
    names.write_text("a1.wav\nbob/b2\n\n")
    assert held(hold_out_list=names) == {"ann/a1", "bob/b2"}
    assert held(hold_out_speakers="ann") == {"ann/a1", "ann/a2"}
    assert held(hold_out_pattern=r"2$") == {"ann/a2", "bob/b2"}
    assert held(hold_out_pattern=r"1$", hold_out_speakers=["bob"]) == {"ann/a1", "bob/b1", "bob/b2"}
    names.write_text("a1\nc9\n.\n")
    for options, complaint in (
        ({"hold_out_list": names}, r"2 names without a usable recording: c9, \."),
        ({"hold_out_list": tmp_path / "none"}, "none: cannot read"),
        ({"hold_out_speakers": "carl"}, "no .* speaker 'carl'; the speakers are ann, bob"),
        ({"hold_out_speakers": "ann,bob"}, "all 4 recordings would be held out"),
        ({"hold_out_pattern": "x"}, "matches none of 4 recordings"),
        ({"hold_out_pattern": "("}, "not a regular expression"),
        ({"hold_out_pattern": "1", "hold_out_seconds": "1-2"}, "not both"),
    ):
        with pytest.raises(CorpusError, match=complaint):
            prepare(tmp_path / "in", **speakers, **options)
