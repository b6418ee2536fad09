"""Inspecting sounds, features, models, corpora and runs."""

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
from sounds import voiced

import audio_features as af
import gesturekit.viewer
from gesturekit.corpus import Item, Manifest
from gesturekit.errors import ConfigError, FormatError, GestureKitError, ModelError
from gesturekit.inspection import Summary, inspect
from gesturekit.systems import model_folder


def row(summary: Summary, label: str) -> str:
    return dict(summary.rows)[label]


def plain(summary: Summary) -> dict:
    return json.loads(json.dumps(summary.to_json(), allow_nan=False))


def test_speech(write_speech, tmp_path):
    summary = inspect(write_speech(tmp_path / "a.wav", 3.0, 22_050))
    assert re.search(r"(?=.*\b3(\.0+)? s)(?=.*\b66150\b)(?=.*22050 Hz)", row(summary, "time"))
    assert row(summary, "channels") == "mono" and not summary.problems
    facts = plain(summary)
    assert facts["sample_rate"] == 22_050
    # Syllables of a fifth of a second.
    assert 0.4 < facts["active_share"] < 0.7


def test_sounds_with_something_wrong(tmp_path):
    rng = np.random.default_rng(0)
    voice = 0.1 * np.tile(voiced(1.0)[:, None], (1, 2))
    noise = 0.1 * rng.standard_normal((16_000, 2))
    for name, samples, says in (
        ("loud", np.clip(30 * voice, -1, 1), "clipped"),
        ("half", voice * [1, 0], "channel 2"),
        ("zeros", 0 * voice, "silence"),
        ("opposite", voice[:, :1] * [1, -1], "cancel"),
        ("quiet", 0.01 * voice, "quiet"),
        ("nan", np.where(rng.random((16_000, 2)) < 0.02, np.nan, voice), "nan"),
        ("few_nan", np.where(rng.random((16_000, 2)) < 0.0001, np.nan, voice), "NaN"),
        ("noise", noise, "voice"),
    ):
        path = tmp_path / f"{name}.wav"
        soundfile.write(path, samples, 16_000, subtype="FLOAT")
        summary = inspect(path)
        assert re.search(says, "\n".join(summary.problems)), name
        facts = plain(summary)
        assert facts["channels"] == 2 and "\n".join(summary.lines(100))
        assert facts.get("has_voice", True) == (name not in ("zeros", "noise")), name


def test_the_level_and_the_pauses_of_speech(tmp_path):
    """A voice of a second, half a second after the beginning and a second before the end."""
    sound = np.concatenate([np.zeros(8000), 0.1 * voiced(1.0), np.zeros(16_000)])
    soundfile.write(tmp_path / "a.wav", sound, 16_000)
    summary = inspect(tmp_path / "a.wav")
    # The voice sounds for half of its second.
    assert 0.2 < summary.facts["active_share"] < 0.32
    assert summary.problems == []
    square = np.tile([0.5, -0.5], 4000)
    square = np.stack([square, square / 4 * (square > 0)], axis=1)
    soundfile.write(tmp_path / "b.wav", square, 8000, subtype="FLOAT")
    summary = inspect(tmp_path / "b.wav")
    # 20 log10 of 1/2 and 1/8; RMS of 1/2 and of 1/8 half of the time.
    np.testing.assert_allclose(summary.facts["peak_dbfs"], [-6.02, -18.06], atol=0.01)
    np.testing.assert_allclose(summary.facts["rms_dbfs"], [-6.02, -21.07], atol=0.01)
    soundfile.write(tmp_path / "c.wav", 3.0 * voiced(1.0), 16_000, subtype="FLOAT")
    assert inspect(tmp_path / "c.wav").problems == [], "floats may go beyond 1"


def test_a_truncated_sound_is_reported_with_its_remaining_length(write_speech, tmp_path):
    path = write_speech(tmp_path / "a.wav", 2.0)
    path.write_bytes(path.read_bytes()[:30_000])
    summary = inspect(path)
    assert any("truncated" in problem for problem in summary.problems)
    assert summary.facts["frames"] == 14_978
    path.write_text("Dear diary,\n")
    with pytest.raises(af.AudioError, match="a.wav"):
        inspect(path)


def test_features(write_speech, tmp_path):
    wave = af.Wave.load(write_speech(tmp_path / "a.wav", 2.0))
    af.LogMel(n_mels=24).extract(wave).save(tmp_path / "a.npz")
    summary = inspect(tmp_path / "a.npz")
    assert summary.kind == "features" and re.search("(?=.*24)(?=.*mel_0)", row(summary, "columns"))
    assert plain(summary)["spec"]["n_mels"] == 24 and plain(summary)["rate"] == pytest.approx(100.0)
    values = np.array([[1, 2, 5], [1, 4, 5], [1, 9, 5]], np.float32)
    af.FeatureTrack(values, [0.1, 0.35, 0.6]).save(tmp_path / "b.npz")
    summary = inspect(tmp_path / "b.npz")
    assert re.search(r"(?=.*\b0\.50* s)(?=.*3 frames)", row(summary, "time")) and re.search(
        r"(?=.*\b1\b)(?=.*\b9\b)", row(summary, "values")
    )
    assert len(summary.problems) == 1 and re.search(r"(?=.*\b0\b)(?=.*\b2\b)", summary.problems[0])
    np.testing.assert_allclose(summary.facts["sd"], [0, np.sqrt(26 / 3), 0], rtol=1e-5)
    np.save(tmp_path / "a.npy", np.ones((2, 1), np.int8))
    says = row(inspect(tmp_path / "a.npy"), "train with")
    assert re.search(r"(?=.*files)(?=.*dim\W+1\b)", says)


def test_an_array_of_own_features_stays_on_disk(tmp_path):
    shape = (8, 2_000_000)  # 64 MB, of holes in the file
    values = np.lib.format.open_memmap(tmp_path / "a.npy", "w+", np.float32, shape, True)
    values[[0, 3, 7], [0, 1_999_999, 5]] = np.nan, np.inf, np.nan
    values.flush()
    tracemalloc.start()
    summary = inspect(tmp_path / "a.npy")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8e6
    facts = plain(summary)
    assert (facts["shape"], facts["nan"], facts["infinite"]) == ([8, 2_000_000], 2, 1)
    assert re.search(r"(?=.*\b2\b)(?=.*16000000)", summary.problems[0])
    np.save(tmp_path / "b.npy", np.array(["text"]))
    assert "<U4" in inspect(tmp_path / "b.npy").problems[0]
    np.save(tmp_path / "c.npy", np.array([{}]), allow_pickle=True)
    with pytest.raises(af.FeatureError, match="c.npy"):
        inspect(tmp_path / "c.npy")


def test_the_bundled_model_and_its_folder():
    summary = inspect("demo")
    assert summary.kind == "model"
    for fact in (r"\b22\b", "52 joints", "30 fps"):
        assert re.search(fact, row(summary, "motion"))
    assert re.search(r"(?=.*logmel)(?=.*\b24\b)(?=.*prosody)", row(summary, "speech features"))
    assert row(summary, "licence") == "Apache-2.0" and plain(summary)["parameters"] > 100_000
    assert inspect(model_folder("demo")).rows == summary.rows


def test_a_model_that_lacks_a_part_names_it(tmp_path):
    shutil.copytree(model_folder("demo"), copy := tmp_path / "model")
    weights = copy / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:1000])
    with pytest.raises(ModelError, match=r"model\.safetensors"):
        inspect(copy)
    weights.unlink()
    with pytest.raises(ModelError, match=r"model\.safetensors"):
        inspect(copy)
    (copy / "skeleton.json").write_text("{")
    with pytest.raises(ModelError, match=r"skeleton\.json"):
        inspect(copy)
    os.truncate(copy / "skeleton.json", 65 << 20)
    with pytest.raises(ModelError, match="larger than 64 MiB"):
        inspect(copy)


def test_a_manifest(corpus, write_pair, tmp_path):
    summary = inspect(corpus)
    assert re.search("(?=.*2 recordings)(?=.*6.50* s)(?=.*train)", row(summary, "paired"))
    assert re.search("(?=.*1 recording)(?=.*5(.0+)? s)", row(summary, "speech alone"))
    assert re.search("(?=.*19 joints)(?=.*30 fps)", row(summary, "rig")) and not summary.problems
    audio, motion = write_pair(tmp_path, "a", seconds=3.0)
    pair = {"audio": audio, "motion": motion, "duration": 3.0}
    items = [
        Item(id="m", split="train", speaker="Zoe", style="sad", mirror=True, **pair),
        Item(id="b", split="test", speaker="Zoe", reading={"up": "y"}, **pair),
        Item(id="k", split="valid", speaker="Al", **pair | {"audio": None}),
    ]
    Manifest(items).save(path := tmp_path / "corpus.jsonl")
    summary = inspect(path)
    rows = dict(summary.rows)
    assert re.search("(?=.*3(.0+)? s)(?=.*valid)", rows["motion alone"])
    assert all(fact in rows["speakers"] for fact in ("Zoe", "2", "Al", "1"))
    assert "sad" in rows["styles"] and "up" in rows["reading"] and "1" in rows["mirrored"]
    assert re.search(r"test 1 \(3(\.0+)? s\)", rows["paired"])


def test_missing_files_and_leaks_between_splits_are_reported(write_pair, tmp_path):
    audio, motion = write_pair(tmp_path, "a")
    items = [
        Item(id="b", duration=1.0, split="test", audio_start=2.5, audio=audio, motion=motion),
        Item(id="a", duration=3.0, split="train", audio=audio, motion=None),
        Item(id="c", duration=1.0, audio=None, motion=tmp_path / "gone.bvh"),
    ]
    path = tmp_path / "corpus.jsonl"
    Manifest(items).save(path)
    missing, leak = inspect(path).problems
    assert "1 file" in missing and str(tmp_path / "gone.bvh") in missing
    assert re.search(rf"(?=.*{audio})(?=.*\btrain\b)(?=.*\btest\b)(?=.*\b2.50* s)", leak)
    for start, split, n in ((3.0, "test", 0), (2.9, "test", 1), (1.0, "train", 0)):
        items[0] = replace(items[0], audio_start=start, split=split, motion=None)
        Manifest(items[:2]).save(path)
        assert len(inspect(path).problems) == n, (start, split)


def test_a_folder_of_recordings(write_pair, write_speech, gesture, tmp_path):
    write_pair(tmp_path, "a")
    write_speech(tmp_path / "more" / "b.wav", 3.0)
    gesture(2.0).save(tmp_path / "more" / "c.bvh")
    (tmp_path / "more" / "c.mp4").write_bytes(b"video of c")
    (tmp_path / "broken.bvh").write_text("Dear diary,\n")
    summary = inspect(tmp_path)
    for label, seconds in (("paired", 4), ("speech alone", 3), ("motion alone", 2)):
        assert re.search(rf"(?=.*1 recording)(?=.*\b{seconds}(\.0)? s)", row(summary, label))
    assert sum("broken.bvh:1" in problem for problem in summary.problems) == 1
    assert "c.mp4" in row(summary, "videos")
    facts = plain(summary)
    assert (facts["items"], facts["seconds"], facts["joints"]) == (3, 9.0, "19 (2)")
    assert (facts["frame rates"], facts["sample rates"]) == ("30 fps (2)", "16000 Hz (2)")
    assert "1.2 m" in row(inspect(tmp_path, read={"height": 1.2}), "body heights")
    assert "1.2 m" not in row(summary, "body heights")
    named = inspect(tmp_path, parts={"left_elbow": "Elbow"})
    assert any("'Elbow'" in problem for problem in named.problems)


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
    rows = dict(inspect(run).rows)
    again = f"gesturekit train --resume {run}"
    for label, fact in {
        "state": again,
        "step": "20",
        "losses": "0.25",
        "checkpoints": "20",
        "settings": "fps 25.0",
        "command": "gesturekit train hell_für_mich.yaml",
    }.items():
        assert fact in rows[label]
    for path in run.rglob("*"):
        os.utime(path, (1e9, 1e9))
    old = inspect(run)
    assert again in row(old, "state") and old.facts["state"] == "stopped"
    (run / "model").mkdir()
    (run / "model" / "config.yaml").write_text("kind: multires\n")
    line = '{"step": 20, "held_out/likeness": 0.5, "held_out/likeness_recording": 0.75, '
    line += '"held_out/jerk": 31.0, "kind": "held_out", "verdict": "Half of the reach."}'
    (run / "metrics.jsonl").write_text('{"step": 20, "rec": 0.25}\n' + line)
    done = inspect(run)
    assert plain(done)["state"] == "finished" and plain(done)["metrics"]["held_out/jerk"] == 31
    assert row(done, "verdict") == "Half of the reach." and "0.25" in row(done, "losses")
    assert re.search(r"(?=.*likeness)(?=.*\b0\.5\b)(?=.*0\.75)", row(done, "metrics"))


def test_unknown_files_are_reported_in_one_line(gesture, tmp_path):
    (tmp_path / "empty").mkdir()
    gesture(0.5).save(tmp_path / "a.bvh")
    shutil.copy(tmp_path / "a.bvh", tmp_path / "a.txt")
    (tmp_path / "b.xyz").write_bytes(b"\x00\x01")
    os.mkfifo(tmp_path / "pipe")
    for name in ("empty", "none", "b.xyz", "pipe"):
        with pytest.raises(FormatError, match=re.escape(str(tmp_path / name))) as told:
            inspect(tmp_path / name)
        assert "\n" not in str(told.value)
    for options in ({"parts": {"head": "Head"}}, {"read": {"up": "z"}}):
        with pytest.raises(ConfigError, match="parts"):
            inspect("demo", **options)
    run = make_run(tmp_path / "run")
    assert str(run) in inspect(run / "config.yaml").title
    (run / "config.yaml").write_text("- a\n")
    with pytest.raises(GestureKitError, match=r"config\.yaml"):
        inspect(run)
    assert str(run) in inspect(run / "metrics.jsonl").title


def test_other_kinds_of_files_are_recognised(gesture, tmp_path):
    template = Path(gesturekit.viewer.__file__).parent / "player" / "template.html"
    shutil.copy(template, tmp_path / "page.html")
    gesture(0.2).save(tmp_path / "still.png")
    gesture(0.2).save(tmp_path / "motion.bvh")
    (tmp_path / "motion.bvh").rename(tmp_path / "b.txt")
    np.savez(tmp_path / "foreign.npz", clips=np.zeros(3), rate=np.zeros(1))
    run = make_run(tmp_path / "run")
    for name, text in {
        "report.json": '{"reference": "a", "models": [], "definitions": {}}',
        "settings.json": '{"colour": "red"}',
        "words.obj": "Dear diary,\n",
        "light.yaml": "system: multires\n",
        "raters.yaml": "systems:\n  ours: clips\n",
        "recipe/config.yaml": "system: multires\n",
        "recipe/README.md": "Mine\n",
        "features/feature_model.safetensors": "{}",
        "run/data/data.json": "{}",
        "talk.m4a": "\0\1",
        "take.pkl": "\0\1",
    }.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    for path, says in (
        ("words.obj", "words.obj"),
        ("foreign.npz", "'poses' & clips & rate"),
        ("settings.json", "colour"),
        ("talk.m4a", "m4a & wav"),
        ("take.pkl", "pkl & pickle"),
    ):
        with pytest.raises(FormatError) as caught:
            inspect(tmp_path / path)
        assert all(re.search(fact, str(caught.value)) for fact in says.split(" & "))
    for path, says in (
        ("report.json", "gesturekit evaluate"),
        ("run/data/data.json", f"run & {run}"),
        ("features", "fit-features"),
        ("page.html", "page"),
        ("still.png", "PNG"),
        ("light.yaml", "gesturekit train & light.yaml"),
        ("b.txt", "BVH"),
        ("raters.yaml", "gesturekit study build"),
        ("recipe", "gesturekit train & recipe"),
        (run / "checkpoints/step_00000020.pt", f"run & {run}"),
    ):
        summary = inspect(tmp_path / path)
        assert summary.kind == "other", path
        assert all(re.search(fact, summary.title) for fact in says.split(" & ")), path


def test_what_cannot_be_inspected_is_listed_and_the_others_are_shown(gesturekit, gesture, tmp_path):
    gesture(1.0).save(tmp_path / "a.bvh")
    (tmp_path / "bad.bvh").write_text("Dear diary,\n")
    done = gesturekit("inspect", tmp_path / "bad.bvh", tmp_path / "a.bvh").fails(1, "bad.bvh:1")
    assert "a.bvh" in done.out and "30 frames" in done.out
    lines = gesturekit("inspect", *[tmp_path / "a.bvh"] * 2, "--json").ok().out.splitlines()
    assert [json.loads(line)["kind"] for line in lines] == ["motion", "motion"]
