"""Public corpora by name: tiny folders in their shapes, beside lists written by hand."""

import json
import re
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
    assert "30_katya_1_9_9" in messages(report, "note")
    item = Manifest.load(tmp_path / "corpus.jsonl").in_split("test")[0]
    assert item.conditions["words"].name == "1_wayne_0_86_87.TextGrid"
    assert item.conditions["semantics"] == beat2 / "sem" / "1_wayne_0_86_87.txt"
    assert item.load_motion().n_frames == 45 and item.duration == 1.5
    assert item.load_wave().words == item.conditions["words"]


def test_missing_and_broken_beat2_files_are_listed(beat2):
    (beat2 / "wave16k" / "2_scott_0_1_1.wav").unlink()
    (beat2 / "smplxflame_30" / "1_wayne_0_103_103.npz").write_bytes(b"no npz")
    write(beat2 / "textgrid" / "1_wayne_0_86_87.TextGrid", WORDS[:-20])
    shutil.copy(beat2 / "wave16k" / "2_scott_0_65_65.wav", beat2 / "wave16k" / "9_new_0_1_1.wav")
    report = prepare(beat2, layout="beat2")
    assert {item.id for item in report.manifest} == {"2_scott_0_65_65", "1_wayne_0_86_87"}
    errors = messages(report, "error")
    assert "2_scott_0_1_1.wav" in errors
    assert "1_wayne_0_103_103.npz" in errors
    assert "textgrid/1_wayne_0_86_87.TextGrid" in messages(report, "warning")
    assert report.left_over == (beat2 / "wave16k" / "9_new_0_1_1.wav",)
    index = beat2 / "train_test_split.csv"
    index.write_text("id,type\n2_scott_0_1_1,training\n")
    with pytest.raises(CorpusError, match="(?=.*train_test_split.csv)(?=.*line 2).*'training'"):
        prepare(beat2, layout="beat2")
    index.unlink()
    with pytest.raises(CorpusError, match="train_test_split.csv"):
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
    assert "001_Neutral_0_mirror_x_1_0.bvh" in notes and "001_Neutral_0_x_0_9" in notes
    (zeggs / "clean" / "001_Neutral_0_x_1_0.wav").unlink()
    (zeggs / "clean" / "005_Neutral_4_x_1_0.bvh").write_text("HIERARCHY")
    errors = messages(prepare(zeggs, layout="zeggs"), "error")
    assert "001_Neutral_0_x_1_0.wav" in errors and "005_Neutral_4_x_1_0.bvh" in errors
    write(zeggs / "info.csv", (zeggs / "info.csv").read_text().replace("FALSE", "no"))
    with pytest.raises(CorpusError, match="(?=.*info.csv)(?=.*line 2).*'no'"):
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
    report = prepare(tmp_path, tmp_path / "corpus.jsonl", layout="zeggs")
    (item,) = Manifest.load(tmp_path / "corpus.jsonl")
    assert (item.motion_start, item.audio_start, item.duration) == (1.0, 2.0, 1.5)
    assert (item.id, item.split, item.audible) == ("001_Neutral_0", "train", ((2.25, 2.5),))
    assert item.load_motion().n_frames == 90
    heard = np.flatnonzero(item.load_wave().samples) / 16_000
    assert heard.size and heard.min() >= 0.25 and heard.max() < 0.5
    errors = messages(report, "error")
    for fact in ("003_Neutral_2.csv", "line 2", "'soon'", "002_Neutral_1.bvh"):
        assert fact in errors


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
    assert {"words", "partner_audio", "partner_motion", "partner_words"} <= set(item.conditions)
    assert item.conditions["partner_audio"].name == "val_2023_v0_000_interloctr.wav"
    notes = messages(report, "note")
    assert re.search("(?=.*fingers).*trn_2023_v0_001", notes)
    (root / "trn" / "main-agent" / "bvh" / "trn_2023_v0_001_main-agent.bvh").unlink()
    report = prepare(root, layout="genea2023")
    assert len(report.manifest) == 3
    assert "trn_2023_v0_001_main-agent.bvh" in messages(report, "error")


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
    assert f"{names[2]}.wav" in messages(report, "note")
    assert report.left_over == (tmp_path / "bvh" / "a.bvh",)
    # The released list of test files names copies of a dance; a number of its own is no copy.
    released = tmp_path / "dance_test_files.txt"
    released.write_text(f"{names[0]}_00\n{names[0]}_01\n{names[2]}_00_mirrored\n")
    held = prepare(tmp_path, layout="motorica", hold_out_list=released).manifest
    assert [item.id for item in held if item.split == "test"] == [names[0], names[2]]
    write_bvh(next(tmp_path.rglob(f"{names[0]}.bvh")), 1.0, 60.0)
    notes = messages(prepare(tmp_path, layout="motorica"), "note")
    assert re.search(rf"(?=.*{names[0]}\.bvh)(?=.*\b60\b).*\b120\b", notes)


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
    assert re.search("Recording_000.wav.*Recording_009.wav", messages(report, "error"))
    assert source / "bvh" / "A_pose.bvh" in report.left_over
    write_bvh(tmp_path / "raw" / "NaturalTalking_001.bvh")
    with pytest.raises(CorpusError, match="GENEA 2020"):
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
    assert "6 of 90" in messages(report, "note")
    (item,) = (item for item in report.manifest if item.id == f"{at}/{one.name}")
    assert item.conditions["partner_motion"] == two.with_suffix(".npz")
    assert [word.text for word in load_words(item.conditions["words"])] == ["well", "yes"]
    motion = item.load_motion()
    positions = motion.positions()
    head, foot = motion.skeleton.index("head"), motion.skeleton.index("left_foot")
    assert (positions[:, head, 1] - positions[:, foot, 1]).min() > 1.0  # upright


def test_layouts_that_cannot_be_used(tmp_path):
    page = (Path(__file__).parents[2] / "docs" / "corpora.md").read_text(encoding="utf-8")
    with pytest.raises(CorpusError, match="beat2"):
        prepare(tmp_path, layout="beat")
    with pytest.raises(CorpusError, match=r"(?=.*zeggs).*\b2\b"):
        prepare([tmp_path, tmp_path], layout="zeggs")
    for layout in LAYOUTS:
        assert f"`{layout}`" in page
        with pytest.raises(CorpusError, match="nowhere"):
            prepare(tmp_path / "nowhere", layout=layout)
