"""Inspecting sounds, features, models, corpora and runs."""

from __future__ import annotations

import json
import os
import re
import shutil
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
import yaml
from safetensors.numpy import save_file
from sounds import voiced

import audio_features as af
import gesturekit.viewer
from gesturekit.corpus import Item, Manifest
from gesturekit.errors import ConfigError, FormatError, GestureKitError, ModelError
from gesturekit.inspection import Summary, inspect
from gesturekit.inspection.summary import size, span
from gesturekit.systems import load, model_folder


def row(summary: Summary, label: str) -> str:
    return dict(summary.rows)[label]


def plain(summary: Summary) -> dict:
    return json.loads(json.dumps(summary.to_json(), allow_nan=False))


# Text and JSON


def test_sizes_and_durations_have_a_fitting_unit():
    sizes = {999: "999 bytes", 1000: "1.0 kB", 1_500_000: "1.5 MB", 2_500_000_000_000: "2500.0 GB"}
    assert {n: size(n) for n in sizes} == sizes
    spans = {119.99: "119.99 s", 120: "2.0 min", 7199: "120.0 min", 7200: "2.0 h"}
    assert {seconds: span(seconds) for seconds in spans} == spans


def test_a_summary_as_lines_and_as_json():
    problems = tuple(f"problem {k}" for k in range(10))
    rows = (("a", "x " * 12), ("a label beyond 15 columns", "y"))
    facts = {"n": np.int64(3), "v": np.array([0.12345678, -np.inf]), "t": (True, None, Path("p"))}
    summary = Summary("other", "A title", facts, rows, lambda width: ["=" * width], problems)
    lines = summary.lines(30)
    assert lines[:5] == [
        "A title",
        "  a                x x x x x x",
        "                   x x x x x x",
        "  a label beyond 15 columns y",
        "  problem          problem 0",
    ]
    assert lines[-5:] == [
        "  problem          and 2 more;",
        "                   --json has",
        "                   all",
        "",
        "=" * 30,
    ]
    assert sum("problem " in line[10:] for line in lines) == 8
    assert summary.to_json() == {
        "kind": "other",
        "n": 3,
        "v": [0.123457, None],
        "t": [True, None, "p"],
        "problems": list(problems),
    }
    few = Summary("other", "A title", {}, problems=problems[:8]).lines(100)
    assert len(few) == 9 and few[1] == "  problem  problem 0"
    assert Summary("other", "A title", {}).lines(100) == ["A title"]
    hyphens = Summary("other", "A title", {}, (("a", "non-fatal well-known"),)).lines(18)
    assert hyphens[1:] == ["  a  non-fatal", "     well-known"]


# Sounds


def test_speech(write_speech, tmp_path):
    summary = inspect(write_speech(tmp_path / "a.wav", 3.0, 22_050))
    assert row(summary, "time") == "3.00 s: 66150 samples at 22050 Hz, all of them decoded"
    assert row(summary, "channels") == "mono" and not summary.problems
    facts = plain(summary)
    assert facts["sample_rate"] == 22_050
    # Syllables of a fifth of a second.
    assert 0.4 < facts["active_share"] < 0.7 and 0.1 < facts["longest_pause"] < 0.25


def test_sounds_with_something_wrong(tmp_path):
    rng = np.random.default_rng(0)
    voice = 0.1 * np.tile(voiced(1.0)[:, None], (1, 2))
    noise = 0.1 * rng.standard_normal((16_000, 2))
    for name, samples, says in (
        ("loud", np.clip(30 * voice, -1, 1), "at full scale"),
        ("shifted", voice + 0.2, "DC offset of 0.2"),
        ("half", voice * [1, 0], "channel 2 is silent"),
        ("zeros", 0 * voice, "silence: no speech above -75 dBFS"),
        ("opposite", voice[:, :1] * [1, -1], "the channels cancel each other"),
        ("quiet", 0.01 * voice, "quiet: speech is at -6"),
        ("nan", np.where(rng.random((16_000, 2)) < 0.02, np.nan, voice), "nan"),
        ("few_nan", np.where(rng.random((16_000, 2)) < 0.0001, np.nan, voice), "interpolated"),
        ("noise", noise, "no voice (noise, hum or whispering)"),
    ):
        path = tmp_path / f"{name}.wav"
        soundfile.write(path, samples, 16_000, subtype="FLOAT")
        summary = inspect(path)
        assert any(says in problem for problem in summary.problems), (name, summary.problems)
        facts = plain(summary)
        assert facts["channels"] == 2 and "\n".join(summary.lines(100))
        assert facts.get("has_voice", True) == (name not in ("zeros", "noise")), name


def test_levels_of_square_waves(tmp_path):
    """Peaks of 1/2 and 3/8, RMS about the mean of 1/2 and 1/8: -6.0, -8.5 and -18.1 dBFS."""
    square = np.tile([0.5, -0.5], 4000)
    path = tmp_path / "a.wav"
    soundfile.write(path, np.stack([square, square / 4 + 0.25], 1), 8000, subtype="FLOAT")
    summary = inspect(path)
    assert summary.rows == (
        ("time", "1.00 s: 8000 samples at 8000 Hz, all of them decoded"),
        ("channels", "stereo, channels differ; models use their mean"),
        ("level", "peak -6.0 / -8.5 dBFS, RMS -6.0 / -18.1 dBFS"),
    )
    no_voice = "no voice (noise, hum or whispering): models of speech generate idle motion"
    assert summary.problems == (no_voice, "DC offset of 0.250 of full scale")
    np.testing.assert_allclose(summary.facts["mean"], [0.0, 0.25], atol=1e-7)
    loud = np.where(np.arange(8000) < 7, 0.999, square)
    soundfile.write(path, np.stack([loud] * 3, 1), 8000, subtype="DOUBLE")
    summary = inspect(path)
    assert row(summary, "channels") == "3 channels, all channels equal; models use their mean"
    assert row(summary, "level") == "peak -0.0 dBFS, RMS -6.0 dBFS"
    assert summary.problems == (no_voice, "clipped: 21 samples at full scale")
    assert summary.facts["clipped"] == [7, 7, 7]
    square[[3, 5, 8]] = np.inf, -np.inf, np.nan  # taken as 0
    soundfile.write(path, square, 8000, subtype="DOUBLE")
    facts = inspect(path).facts
    assert (facts["peak_dbfs"], facts["clipped"]) == ([20 * np.log10(0.5)], [0])
    assert facts["mean"] == [0.5 / 8000]  # two of -1/2 and one of 1/2 are gone


def test_faults_at_their_bounds(tmp_path):
    """Clipping counts above one sample in 100,000, an offset above 1 % of full scale, or of the
    peak of a file whose full scale is not 1, and silence of a channel below -75 dBFS.
    """

    def problems(samples: np.ndarray, rate: int = 8000) -> tuple[str, ...]:
        soundfile.write(tmp_path / "a.wav", samples, rate, subtype="DOUBLE")
        return inspect(tmp_path / "a.wav").problems

    short = problems(np.array([0.01]))
    assert len(short) == 1 and "1 samples" in short[0]
    assert inspect(tmp_path / "a.wav").facts["mean"] == [0.01]
    assert row(inspect(tmp_path / "a.wav"), "time").startswith("0.00 s: 1 sample at 8000 Hz")
    square = np.tile([0.5, -0.5], 50_000)
    square[9] = 1.0
    assert not any("clipped" in problem for problem in problems(square))
    square[7] = 1.0
    assert problems(square)[1:] == ("clipped: 2 samples at full scale",)
    # One loud channel says that full scale is not 1; of 10,500 its offset is 4.8 %.
    large = np.stack([np.tile([0.5, -0.5], 4000), np.tile([1e4, -1e4], 4000) + 500], 1)
    assert problems(large)[1:] == ("DC offset of 0.048 of full scale",)
    voice = voiced(1.0) / np.abs(voiced(1.0)).max()
    channels = np.stack([0.5 * voice, 10 ** (-75.5 / 20) * voice, 10 ** (-74.5 / 20) * voice], 1)
    assert problems(channels, 16_000) == ("channel 2 is silent: the mean loses 6 dB or more",)


def test_the_rows_and_faults_of_speech(tmp_path):
    """A voice of a second, half a second after the beginning and a second before the end."""
    voice = 0.1 * voiced(1.0)
    quiet = np.concatenate([np.zeros(8000), voice, np.zeros(16_000)])
    soundfile.write(tmp_path / "a.wav", quiet, 16_000)
    summary = inspect(tmp_path / "a.wav")
    facts, rows = summary.facts, dict(summary.rows)
    share = 100 * facts["active_share"]
    # The voice sounds for half of its second; its last pause and the second after it are one.
    assert 20 < share < 32 and 0.9 < facts["longest_pause"] < 1.2
    pause = f"the longest pause takes {facts['longest_pause']:.2f} s"
    spoken = f"{share:.0f} % of the time, silence {100 - share:.0f} %; {pause}"
    assert rows["speech"] == spoken and summary.problems == ()
    level = 20 * np.log10(np.abs(quiet).max())
    assert rows["level"].startswith(f"peak {level:.1f} dBFS, RMS ")
    assert rows["level"].endswith(f", speech {facts['active_level_dbfs']:.1f} dBFS")
    # Two thirds of the voice's own second, and of its first tenth all.
    for sound, says in (
        (voice, "66 % of the time, silence 34 %; the longest pause takes 0.17 s"),
        (voice[::-1], "66 % of the time, silence 34 %; the longest pause takes 0.17 s"),
        (voice[:1600], "100 % of the time, silence 0 %; the longest pause takes 0.00 s"),
    ):
        soundfile.write(tmp_path / "b.wav", sound, 16_000)
        assert row(inspect(tmp_path / "b.wav"), "speech") == says
    soundfile.write(tmp_path / "half.wav", np.stack([voice, 0 * voice], 1), 16_000)
    half = inspect(tmp_path / "half.wav")
    assert half.problems == ("channel 2 is silent: the mean loses 6 dB or more",)
    soundfile.write(tmp_path / "silence.wav", np.zeros(16_000), 16_000)
    silence = inspect(tmp_path / "silence.wav")
    assert silence.problems == ("silence: no speech above -75 dBFS",)
    assert "speech" not in dict(silence.rows) and "speech" not in row(silence, "level")


def test_a_floating_point_sound_beyond_full_scale_is_not_clipped(tmp_path):
    loud = 3.0 * voiced(1.0)
    soundfile.write(tmp_path / "a.wav", loud, 16_000, subtype="FLOAT")
    assert not any("clipped" in problem for problem in inspect(tmp_path / "a.wav").problems)
    soundfile.write(tmp_path / "b.wav", 10_000 * (loud - loud.mean()) + 50, 16_000, subtype="FLOAT")
    assert not inspect(tmp_path / "b.wav").problems, "an offset of 50 in 30000"


def test_a_truncated_sound_is_reported_with_its_remaining_length(write_speech, tmp_path):
    path = write_speech(tmp_path / "a.wav", 2.0)
    path.write_bytes(path.read_bytes()[:30_000])
    summary = inspect(path)
    assert any("truncated" in problem for problem in summary.problems)
    assert summary.facts["frames"] == 14_978
    path.write_text("Dear diary,\n")
    with pytest.raises(af.AudioError, match="cannot be read as sound"):
        inspect(path)


def test_features(write_speech, tmp_path):
    wave = af.Wave.load(write_speech(tmp_path / "a.wav", 2.0))
    af.LogMel(n_mels=24).extract(wave).save(tmp_path / "a.npz")
    summary = inspect(tmp_path / "a.npz")
    assert summary.kind == "features" and row(summary, "columns").startswith("24: mel_0, mel_1")
    spec = {"kind": "logmel", "n_mels": 24, "backend": "numpy"}
    assert plain(summary)["spec"] == spec and plain(summary)["rate"] == pytest.approx(100.0)


def test_every_row_of_a_feature_file(tmp_path):
    values = np.array([[1, 2, 5], [1, 4, 5], [1, 9, 5]], np.float32)
    af.FeatureTrack(values, [0.1, 0.35, 0.6]).save(tmp_path / "a.npz")
    summary = inspect(tmp_path / "a.npz")
    assert summary.rows == (
        ("time", "0.50 s: 3 frames at 4 a second, centred from 0.1000 to 0.6000 s"),
        ("columns", "3: 0, 1, 2"),
        ("values", "1 to 9"),
        ("made by", "unknown"),
    )
    assert summary.problems == ("never change: 0, 2",)
    uneven = [0.1, 0.35, 0.6, 1.6]
    for n in (4, 2):
        four = af.FeatureTrack(values[[0, 1, 2, 2]][:n], uneven[:n], {"kind": "Bär"})
        four.save(tmp_path / "b.npz")
        rows = dict(inspect(tmp_path / "b.npz").rows)
        assert f": {n} frames at 4 a second, " in rows["time"]
        assert rows["made by"] == '{"kind": "Bär"}'
        assert inspect(tmp_path / "b.npz").problems == summary.problems
    facts = plain(summary)
    assert (facts["first"], facts["last"], facts["rate"]) == (0.1, 0.6, 4.0)
    np.testing.assert_allclose(facts["mean"], [1, 5, 5])
    np.testing.assert_allclose(facts["sd"], [0, np.sqrt(26 / 3), 0], rtol=1e-5)
    af.FeatureTrack(values[:1], [0.1]).save(tmp_path / "one.npz")
    one = inspect(tmp_path / "one.npz")
    assert row(one, "time") == "0.00 s: 1 frame, centred from 0.1000 to 0.1000 s"
    assert one.problems == () and plain(one)["rate"] is None
    for array, rows, problems in (
        (np.zeros((3, 0)), "3 rows, 0 columns, float64", ("no values",)),
        (np.array([1.0, np.inf]), "(2,), float64", ("1 of 2 values are infinite",)),
        (np.ones((2, 1), np.int8), "2 rows, 1 column, int8", ()),
    ):
        np.save(tmp_path / "a.npy", array)
        summary = inspect(tmp_path / "a.npy")
        assert (row(summary, "shape"), summary.problems) == (rows, problems)
        assert ("train with" in dict(summary.rows)) == (array.ndim == 2)
    assert row(summary, "train with").startswith("{kind: files, dim: 1, suffix: .npy, ")


def test_an_array_of_own_features_stays_on_disk(tmp_path):
    values = np.lib.format.open_memmap(
        tmp_path / "a.npy", "w+", np.float32, (8, 2_000_000), fortran_order=True
    )  # 64 MB, of holes in the file
    values[[0, 3, 7], [0, 1_999_999, 5]] = np.nan, np.inf, np.nan
    values.flush()
    tracemalloc.start()
    summary = inspect(tmp_path / "a.npy")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8e6
    assert row(summary, "shape") == "8 rows, 2000000 columns, float32"
    facts = plain(summary)
    assert (facts["shape"], facts["nan"], facts["infinite"]) == ([8, 2_000_000], 2, 1)
    assert summary.problems[0] == "2 of 16000000 values are NaN"
    np.save(tmp_path / "b.npy", np.array(["text"]))
    assert "<U4 is no number" in inspect(tmp_path / "b.npy").problems[0]
    np.save(tmp_path / "c.npy", np.array([{}]), allow_pickle=True)
    with pytest.raises(af.FeatureError, match="c.npy: not a whole npy of plain numbers"):
        inspect(tmp_path / "c.npy")


# Models


def test_the_bundled_model_and_its_folder():
    summary = inspect("demo")
    assert summary.kind == "model"
    moves = "22 of 52 joints at 30 fps; 30 more by recall: LeftHandThumb1"
    assert row(summary, "moves").startswith(moves) and "not" not in row(summary, "moves")
    assert "logmel (n_mels 24, backend numpy), prosody" in row(summary, "speech features")
    assert row(summary, "licence") == "Apache-2.0" and plain(summary)["parameters"] > 100_000
    assert inspect(model_folder("demo")).rows == summary.rows


def test_a_damaged_model_names_what_is_wrong(tmp_path):
    copy = tmp_path / "model"
    shutil.copytree(model_folder("demo"), copy)
    cut = r"skeleton\.json is damaged"
    for text, says in (
        ("{", cut),
        ('{"skeleton": 3, "speakers": {}}', "mapping"),
        ("{}", "damaged"),
    ):
        (copy / "skeleton.json").write_text(text)
        for read in (inspect, load):
            with pytest.raises(ModelError, match=says):
                read(copy)


def test_every_row_of_a_model_that_is_not_the_bundled_one(tmp_path):
    """Styles, reduced features, a network of another kind, no recall and no speech."""
    shutil.copytree(model_folder("demo"), copy := tmp_path / "model")
    path = copy / "config.yaml"
    config = yaml.safe_load(path.read_text(encoding="utf-8"))
    names = [f"s{k}" for k in range(14)]
    about = {"architecture": "diffwave", "heads": 4, "dilations": [1, 2], "blocks": 3}
    changes = {"styles": names, "network": about, "recorded_fps": 60.0, "recall": None}
    spec = {"kind": "stack", "parts": [{"kind": "mfcc"}, {"kind": "music", "hop": 2}]}
    path.write_text(yaml.safe_dump(config | changes | {"features": {"spec": spec}}))
    rig = json.loads((copy / "skeleton.json").read_bytes())
    rig["speakers"] = dict.fromkeys(names[::-1], 0.0)
    (copy / "skeleton.json").write_text(json.dumps(rig), encoding="utf-8")
    tensors = {"features.components": np.ones((3, 2), "f4"), "network.a": np.ones((5, 7), "f4")}
    save_file(tensors | {"other": np.ones(9, "f4")}, copy / "model.safetensors")
    notes = "# A\n- **Kind**: x\n- **Styles**: s0\n- **Data**: *für mich*\nelse\n"
    (copy / "README.md").write_text(notes, encoding="utf-8")
    summary = inspect(copy)
    fingers = "LeftHandThumb1, LeftHandThumb2, LeftHandThumb3, LeftHandIndex1 and 26 more"
    listed = ", ".join(names[:12]) + " and 2 more"
    speakers = ", ".join(sorted(names)[:12]) + " and 2 more"
    assert summary.rows == (
        ("moves", f"22 of 52 joints at 30 fps, resampled to 60 fps; not {fingers}"),
        ("speech features", "mfcc, music (hop 2)"),
        ("reduced features", "3 features reduced to 2 components"),
        ("network", "architecture diffwave, blocks 3, dilations 1-2"),
        ("parameters", "35"),
        ("styles", listed),
        ("speakers", speakers),
        ("data", "*für mich*"),
    )
    n_bytes = sum(file.stat().st_size for file in copy.iterdir())
    assert summary.title == f"{copy}: model, multires, format 1, {size(n_bytes)}"
    for features, text in ((None, "none"), ({}, "none"), ({"spec": "own"}, "own")):
        path.write_text(yaml.safe_dump(config | {"features": features, "network": "small"}))
        rows = dict(inspect(copy).rows)
        assert (rows["speech features"], rows["network"]) == (text, "small")
    (copy / "README.md").unlink()
    assert list(dict(inspect(copy).rows))[-1] == "speakers"
    path.write_text(yaml.safe_dump(config | {"features": "mfcc"}))
    with pytest.raises(ModelError, match="features is 'mfcc', expected a mapping"):
        inspect(copy)


def test_a_model_that_lacks_a_part_names_it(tmp_path):
    shutil.copytree(model_folder("demo"), copy := tmp_path / "model")
    weights = copy / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:1000])
    with pytest.raises(ModelError, match="model: model.safetensors is damaged: "):
        inspect(copy)
    for name in ("model.safetensors", "skeleton.json"):
        (copy / name).unlink()
        with pytest.raises(ModelError, match=f"model: the model lacks {name}$"):
            inspect(copy)


# Corpora


def test_a_manifest(corpus):
    summary = inspect(corpus)
    assert row(summary, "paired").startswith("2 recordings, 8.50 s: train 2")
    assert row(summary, "speech alone").startswith("1 recording, 5.00 s")
    assert row(summary, "rig").startswith("19 joints, 30 fps") and not summary.problems


def test_every_row_of_a_manifest(write_pair, tmp_path):
    audio, motion = write_pair(tmp_path, "a", seconds=3.0)
    pair = {"audio": audio, "motion": motion, "duration": 3.0}
    styles = iter("nmlkjihgfedcba")
    items = [
        Item(id="a", split="train", speaker="Zoe", style=next(styles), **pair),
        Item(id="m", split="train", speaker="Zoe", mirror=True, **pair),
        Item(id="b", split="test", speaker="Bob", reading={"up": "y", "parts": {}}, **pair),
        Item(id="s", split="train", **pair | {"motion": None, "duration": 130.0}),
        Item(id="k", split="valid", speaker="Al", **pair | {"audio": None}),
    ]
    path = tmp_path / "corpus.jsonl"
    Manifest(items).save(path)
    summary = inspect(path)
    pairs, alone = "paired", "speech alone"
    rows = dict(summary.rows)
    assert rows[pairs].endswith(", 9.00 s: train 2 (6.00 s), test 1 (3.00 s)")
    assert rows[alone].endswith(", 2.2 min: train 1 (2.2 min)")
    assert rows["motion alone"].endswith(", 3.00 s: valid 1 (3.00 s)")
    assert (rows["speakers"], rows["styles"]) == ("Zoe (2), Al (1), Bob (1)", "n (1)")
    assert (rows["reading"], rows["mirrored"]) == ("up y (1)", "1 of 5")
    assert rows["rig"] == "19 joints, 30 fps (of recording a)"
    assert summary.facts["seconds"] == 142.0 and summary.title.endswith(", 2.4 min")
    assert summary.facts["splits"]["paired"] == {
        "train": {"items": 2, "seconds": 6.0},
        "test": {"items": 1, "seconds": 3.0},
    }
    alone = [
        Item(id=f"{k}", style=style, **pair | {"motion": None, "audio_start": float(k)})
        for k, style in enumerate(styles)
    ]
    Manifest(alone).save(path)
    rows = dict(inspect(path).rows)
    assert rows["speakers"] == "none named" and "rig" not in rows and "mirrored" not in rows
    assert rows["styles"].startswith("a (1), b (1), c") and rows["styles"].endswith(" and 1 more")


def test_missing_files_and_leaks_between_splits_are_reported(write_pair, tmp_path):
    audio, motion = write_pair(tmp_path, "a")
    about = {"audio": audio, "motion": motion}
    items = [
        Item(id="b", duration=1.0, split="test", audio_start=2.5, **about),
        Item(id="a", duration=3.0, split="train", **about | {"motion": None}),
        Item(id="c", duration=1.0, audio=None, motion=tmp_path / "gone.bvh"),
    ]
    path = tmp_path / "corpus.jsonl"
    Manifest(items).save(path)
    missing, leak = inspect(path).problems
    assert missing == f"1 file missing: {tmp_path / 'gone.bvh'}"
    assert leak == f"{audio} is in train (a) and in test (b) at 2.50 s"
    # Pieces may overlap by a millisecond.
    for start, split, n in ((2.999, "test", 0), (2.9985, "test", 1), (1.0, "train", 0)):
        items[0] = replace(items[0], audio_start=start, split=split, motion=None)
        Manifest(items[:2]).save(path)
        assert len(inspect(path).problems) == n, (start, split)
    Manifest([items[2], Item(id="d", duration=1.0, audio=None, motion=motion)]).save(path)
    assert row(inspect(path), "rig") == "19 joints, 30 fps (of recording d)"
    motion.write_text("Dear diary,\n")
    summary = inspect(path)
    assert "rig" not in dict(summary.rows) and "a.bvh:1" in summary.problems[-1]


def test_a_folder_of_recordings(write_pair, write_speech, gesture, tmp_path):
    write_pair(tmp_path, "a")
    write_speech(tmp_path / "more" / "b.wav", 3.0)
    gesture(2.0).save(tmp_path / "more" / "c.bvh")
    (tmp_path / "more" / "c.mp4").write_bytes(b"video of c")
    (tmp_path / "broken.bvh").write_text("Dear diary,\n")
    summary = inspect(tmp_path)
    assert row(summary, "paired") == "1 recording, 4.0 s"
    assert row(summary, "speech alone") == "1 recording, 3.0 s"
    assert row(summary, "motion alone") == "1 recording, 2.0 s"
    assert sum("broken.bvh:1" in problem for problem in summary.problems) == 1
    assert row(summary, "videos") == "c.mp4, not read" and "mp4" not in str(summary.problems)
    assert not {"speakers", "styles"} & dict(summary.rows).keys()
    facts = plain(summary)
    assert [facts[key] for key in ("items", "paired", "speech_alone", "motion_alone")] == [
        3,
        1,
        1,
        1,
    ]
    assert (facts["seconds"], summary.title) == (9.0, f"{tmp_path}: 3 recordings, 9.00 s")
    assert (facts["joints"], facts["frame_rates"]) == ({"19": 2}, {"30.0": 2})
    assert facts["sample_rates"] == {"16000": 2}
    read: list[object] = []
    inspect(tmp_path, read={"height": 1.2}, progress=lambda tasks: read.extend(tasks) or tasks)
    assert len(read) == 4
    heights = row(inspect(tmp_path, read={"height": 1.2}), "body heights")
    assert heights == "1.2 m" != row(summary, "body heights")
    named = inspect(tmp_path, parts={"left_elbow": "Elbow"})
    assert any("no joint 'Elbow'" in problem for problem in named.problems)
    (tmp_path / "none").mkdir()
    (tmp_path / "none" / "a.bvh").write_text("Dear diary,\n")
    assert any("a.bvh:1" in problem for problem in inspect(tmp_path / "none").problems)


# Runs


def make_run(folder):
    (folder / "checkpoints").mkdir(parents=True)
    (folder / "config.yaml").write_text("system: multires\nfps: 25.0\nseed: 3\n")
    (folder / "command.txt").write_text("gesturekit train hell_für_mich.yaml\n", encoding="utf-8")
    (folder / "versions.json").write_text('{"torch": "2.1", "platform": "x"}')
    (folder / "metrics.jsonl").write_text(
        '{"step": 10, "rec": 0.5}\n3\n{"st\n{"step": 20, "rec": 0.25, "note": "x"}\n{"st'
    )
    (folder / "checkpoints" / "step_00000020.pt").touch()
    return folder


def test_stopped_and_finished_runs_are_described(tmp_path):
    run = make_run(tmp_path / "run")
    summary = inspect(run)
    rows = dict(summary.rows)
    again = f"gesturekit train --resume {run}"
    assert re.fullmatch(rf"not .* last written \d+\.\d\d s ago; {again}", rows.pop("state"))
    assert rows == {
        "step": "20",
        "losses": "rec 0.25",
        "checkpoints": "1: steps 20",
        "settings": "system multires, fps 25.0, seed 3",
        "command": "gesturekit train hell_für_mich.yaml",
        "made with": "torch 2.1",
    }
    for path in run.rglob("*"):
        os.utime(path, (1e9, 1e9))
    os.utime(run / "metrics.jsonl", (1e10, 1e10))  # by a machine whose clock is ahead
    assert inspect(run).facts["silent_seconds"] == 0.0
    os.utime(run / "metrics.jsonl", (1e9, 1e9))
    old = inspect(run)
    assert row(old, "state").endswith(f" h ago; {again}")
    assert f"training run, stopped, {old.facts['bytes']} bytes" in old.title
    # One new file, whichever it is, is the last that was written.
    for name in ("metrics.jsonl", "checkpoints/step_00000020.pt"):
        (run / name).touch()
        assert plain(inspect(run))["silent_seconds"] < 60
        os.utime(run / name, (1e9, 1e9))
    (run / "versions.json").write_text("[1]")
    (run / "metrics.jsonl").write_text("")
    new = inspect(run)
    assert row(new, "step") == "none logged yet" and "made with" not in dict(new.rows)
    (run / "model").mkdir()
    (run / "model" / "config.yaml").write_text("kind: multires\n")
    (run / "model" / "README.md").write_text("- **Recordings**: 7 recordings, 70 s\n")
    line = '{"step": 20, "held_out/likeness": 0.5, "held_out/likeness_recording": 0.75, '
    line += '"held_out/jerk": 31.0, "kind": "held_out", "verdict": "Half of the reach."}'
    (run / "metrics.jsonl").write_text('{"step": 20, "rec": 0.25}\n' + line)
    done = inspect(run)
    assert plain(done)["state"] == "finished" and plain(done)["metrics"]["held_out/jerk"] == 31
    assert row(done, "verdict") == "Half of the reach." and row(done, "losses") == "rec 0.25"
    assert row(done, "metrics").startswith("likeness 0.5 (recordings 0.75); all of them: ")
    assert str(run / "report.html") in row(done, "metrics")
    assert row(done, "recordings") == "7 recordings, 70 s"


# Everything else


def test_unknown_files_are_reported_in_one_line(gesture, tmp_path):
    (tmp_path / "empty").mkdir()
    gesture(0.5).save(tmp_path / "a.bvh")
    shutil.copy(tmp_path / "a.bvh", tmp_path / "a.txt")
    (tmp_path / "b.xyz").write_bytes(b"\x00\x01")
    for name, says in (
        ("empty", "not a folder that gesturekit recognises"),
        ("none", "no such file or folder, and no bundled model"),
        ("b.xyz", "not recognised"),
    ):
        with pytest.raises(FormatError, match=says) as told:
            inspect(tmp_path / name)
        assert "\n" not in str(told.value)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(FormatError, match="pipe: not a regular file"):
        inspect(tmp_path / "pipe")
    for options in ({"parts": {"head": "Head"}}, {"read": {"up": "z"}}):
        with pytest.raises(ConfigError, match="only motion has parts"):
            inspect("demo", **options)
    run = make_run(tmp_path / "run")
    assert "inspect its folder" in inspect(run / "config.yaml").title
    (run / "config.yaml").write_text("- a\n")
    with pytest.raises(GestureKitError, match="expected key: value"):
        inspect(run)
    assert "inspect its folder" in inspect(run / "metrics.jsonl").title


def test_other_kinds_of_files_are_recognised(gesture, tmp_path):
    np.savez(tmp_path / "foreign.npz", clips=np.zeros(3), rate=np.zeros(1))
    (tmp_path / "report.json").write_text('{"reference": "a", "models": [], "definitions": {}}')
    (tmp_path / "settings.json").write_text('{"colour": "red"}')
    template = Path(gesturekit.viewer.__file__).parent / "player" / "template.html"
    shutil.copy(template, tmp_path / "page.html")
    (tmp_path / "other.html").write_text("<html></html>")
    gesture(0.2).save(tmp_path / "still.png")
    (tmp_path / "skin.obj").write_text("v 0.0 0.0 0.0\n")
    (tmp_path / "words.obj").write_text("Dear diary,\n")
    (tmp_path / "words.xyz").write_text("v 0.0 0.0 0.0\n")
    (tmp_path / "kick.events.csv").write_text("time,name\n1.0,kick\n")
    (tmp_path / "walk.path.csv").write_text("time,x,z\n0,0,0\n")
    (tmp_path / "light.yaml").write_text("system: multires\n")
    (tmp_path / "dark.yml").write_text("system: multires\n")
    (tmp_path / "events.out.tfevents.1").write_bytes(b"\0")
    (tmp_path / "step.pt").write_bytes(b"\0")
    gesture(0.2).save(tmp_path / "motion.bvh")
    shutil.copy(tmp_path / "motion.bvh", tmp_path / "b.txt")
    (tmp_path / "raters.yaml").write_text("systems:\n  ours: clips\n")
    (tmp_path / "my_recipe").mkdir()
    (tmp_path / "my_recipe" / "config.yaml").write_text("system: multires\n")
    (tmp_path / "my_recipe" / "README.md").write_text("Mine\n")
    (tmp_path / "feature_model.json").write_text("{}")
    for name in ("talk.m4a", "take.fbx", "film.mp4", "take.pkl"):
        (tmp_path / name).write_bytes(b"\0\1\2\3")
    run = make_run(tmp_path / "run")
    (run / "data").mkdir()
    for name in ("data/data.json", "trained_on.json"):
        (run / name).write_text("{}")
    shutil.copy(run / "trained_on.json", tmp_path)
    shutil.copy(tmp_path / "light.yaml", run / "other.yaml")
    (tmp_path / "alone").mkdir()
    shutil.copy(tmp_path / "light.yaml", tmp_path / "alone" / "config.yaml")
    (tmp_path / "features").mkdir()
    shutil.copy(tmp_path / "feature_model.json", tmp_path / "features")
    shutil.copy(tmp_path / "still.png", tmp_path / "a.txt")
    for path, says in (
        ("step.pt", "not recognised"),
        ("words.obj", "not recognised"),
        ("words.xyz", "not recognised"),
        ("foreign.npz", "no key 'poses'.*AMASS and BEAT2; this one has clips, rate$"),
        ("settings.json", "a JSON object with the keys colour; of JSON, motion is read"),
        ("talk.m4a", "m4a is not read; make a wav of it: ffmpeg -i x.m4a x.wav$"),
        ("take.fbx", "fbx is not read; export it as bvh"),
        ("film.mp4", "mp4 is not read; make a wav"),
        ("take.pkl", "pkl is a pickle"),
    ):
        with pytest.raises(FormatError, match=says):
            inspect(tmp_path / path)
    for path, says in (
        ("report.json", "figures that gesturekit evaluate wrote"),
        (run / "data/data.json", "the prepared data of a run; inspect its folder"),
        (run / "trained_on.json", "part of a model or a run"),
        ("trained_on.json", "the list of recordings that a model was trained on"),
        ("features", "a feature model of fit-features; give it to evaluate$"),
        ("a.txt", "a PNG picture$"),
        ("page.html", "a page that gesturekit wrote .* open it in a browser$"),
        ("other.html", "an XML or HTML file$"),
        ("still.png", "a PNG picture$"),
        ("skin.obj", "a mesh"),
        ("kick.events.csv", "a table of events"),
        ("walk.path.csv", "a path of the root"),
        ("light.yaml", "gesturekit train .*light.yaml"),
        ("dark.yml", "gesturekit train .*dark.yml"),
        ("alone/config.yaml", "a configuration; gesturekit train .*config.yaml trains with"),
        (run / "other.yaml", "a configuration; gesturekit train .*other.yaml trains with it$"),
        ("events.out.tfevents.1", f"the log of a run, .* --logdir {tmp_path}$"),
        ("b.txt", "looks like .*BVH.* inside; give it the suffix of one$"),
        ("raters.yaml", "a user study; gesturekit study build .*raters.yaml makes its page$"),
        ("my_recipe", "a recipe; gesturekit train .*my_recipe trains it$"),
        ("feature_model.json", "part of a feature model"),
        (run / "checkpoints/step_00000020.pt", f"a checkpoint of a run; inspect its folder, {run}"),
    ):
        summary = inspect(tmp_path / path)
        assert summary.kind == "other" and re.search(says, summary.title), path


def test_a_folder_of_features_is_one(gesturekit, write_speech, tmp_path):
    for name in ("a", "more/b"):
        write_speech(tmp_path / "speech" / f"{name}.wav", 1.0)
    gesturekit("features", tmp_path / "speech", "--extractor", "prosody", "--out", tmp_path / "f")
    shown = gesturekit("inspect", tmp_path / "f").ok().out
    assert "features of 2 sounds" in shown and "a.npz, more/b.npz" in shown
    assert '"kind": "prosody"' in shown


def test_lines_are_as_wide_as_the_terminal_within_bounds(gesturekit, monkeypatch):
    shown = {}
    for columns in (40, 72, 90, 110, 300):
        monkeypatch.setenv("COLUMNS", str(columns))
        shown[columns] = gesturekit("inspect", "demo").ok().out
    assert shown[40] == shown[72] and shown[110] == shown[300]
    assert len({shown[72], shown[90], shown[110]}) == 3
    assert all(len(line) <= 72 for line in shown[40].splitlines() if "/" not in line)


def test_what_cannot_be_inspected_is_listed_and_the_others_are_shown(
    gesturekit, gesture, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    gesture(1.0).save("a.bvh")
    real = inspect

    def inspected(path: str, **options):
        if path == "a.bvh":
            return real(path, **options)
        raise {
            "big": MemoryError(),
            "own": OSError(13, "Permission denied", "own/x"),
            "odd": OSError("no reason"),
            "bad": FormatError("bad: damaged"),
            "mute": FormatError("damaged"),
        }[path]

    monkeypatch.setattr("gesturekit.inspection.inspect", inspected)
    done = gesturekit("inspect", "big", "own", "odd", "bad", "mute", "a.bvh")
    assert done.status == 1 and done.err.splitlines() == [
        "Failed: big: not enough memory",
        "Failed: own/x: Permission denied",
        "Failed: odd: no reason",
        "Failed: bad: damaged",
        "Failed: mute: damaged",
    ]
    assert "a.bvh" in done.out and done.out.startswith("\n")
    lines = gesturekit("inspect", "a.bvh", "a.bvh", "--json").ok().out.splitlines()
    assert [json.loads(line)["kind"] for line in lines] == ["motion", "motion"]
