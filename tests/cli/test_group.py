"""The command line as a whole: its exit codes, and that it never shows a traceback."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import numpy as np
import pytest
from pages import data_of

import audio_features as af
import gesturekit as gk
from gesturekit import systems
from gesturekit.cli import VERBS, cli
from gesturekit.jobs.run import EXISTING
from gesturekit.viewer.human.body import is_baked


def test_help_and_version(gesturekit):
    assert gesturekit("--version").out.strip().endswith(gk.__version__)
    for arguments in (["--help"], ["-h"], *([verb, "--help"] for verb in VERBS)):
        done = gesturekit(*arguments)
        assert done.status == 0 and done.out.startswith("Usage: gesturekit") and done.err == ""


def commands(group: click.Group, *above: str) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    """Yield the arguments of each command, and the command."""
    for name in group.list_commands(click.Context(group)):
        command = group.get_command(click.Context(group), name)
        if isinstance(command, click.Group):
            yield from commands(command, *above, name)
        else:
            yield (*above, name), command


def test_help_shows_20_options_and_all_on_request(gesturekit):
    """And -o stands for --out everywhere."""
    for words, command in commands(cli):
        options = {opt for param in command.params for opt in param.opts} & {"-o", "--out"}
        assert options in (set(), {"-o", "--out"}), words
        every = {param.opts[0] for param in command.params if isinstance(param, click.Option)}
        every |= {"-h"}  # or --help, where another test read the command alone
        asked = {len(every): "--help"} if len(every) <= 20 else {20: "--help", -1: "--help-all"}
        for most, flag in asked.items():
            text = re.split(r"^\S.*:\n", gesturekit(*words, flag).ok().out, flags=re.MULTILINE)
            shown = re.findall(r"^  (-[\w-]+)[ ,\n]", "\n".join(text[1:]), re.MULTILINE)
            assert set(shown) <= {*every, "--help"} and len(shown) == (
                len(every) if most < 0 else most
            ), words
            assert {"-o"} & every <= set(shown)


def test_a_missing_model_is_answered_by_those_that_there_are(gesturekit, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for age, run in enumerate("dcba"):
        (config := tmp_path / "runs" / run / "model" / "config.yaml").parent.mkdir(parents=True)
        config.touch()
        os.utime(config, (0, age))
    newest = (f"--model {Path('runs', run, 'model')}" for run in "abc")
    done = gesturekit("render", "a.wav", "-o", "out").fails(2, ", ".join(["--model demo", *newest]))
    assert str(Path("runs", "d")) not in done.err
    (tmp_path / "result.bvh").touch()
    for name in ("result.bvh", "other.bvh"):
        wrong = ("render", "a.wav", "--model", "demo", "-o", name)
        gesturekit(*wrong).fails(2, f"--out {name[:-4]} --format bvh")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["rendr"], "did you mean render?"),
        (["Prepair", "x"], "did you mean prepare?"),
        (["xyz"], "it is one of demo, features, prepare"),
        (["--nonsense"], "--nonsense"),
        (["render"], "Missing"),
        (["train"], "gesturekit train own_corpus corpus=CORPUS.jsonl"),
        ([], "Usage: gesturekit"),
    ],
)
def test_bad_usage(gesturekit, arguments, says):
    gesturekit(*arguments).fails(2, "Usage: gesturekit", says)


def test_features_that_cannot_be_written_or_made(gesturekit, write_speech, tmp_path):
    wav = write_speech(tmp_path / "speech.wav", 1.0)
    done = gesturekit("features", wav, "--out", tmp_path / "speech.wav" / "out").fails(2)
    target = tmp_path / "speech.wav" / "out"
    assert done.err == f"Error: {target}: cannot be created (Not a directory)\n"
    for fps in ("0", "1e9", "fast"):
        gesturekit("features", wav, "--out", tmp_path / "out", "--fps", fps).fails(2, "--fps")
    assert not (tmp_path / "out").exists()


def test_a_reader_that_closes_the_pipe_early_is_not_an_error(model, write_speech, tmp_path):
    """gesturekit render ... | head -1"""
    for i in range(3):
        write_speech(tmp_path / "in" / f"{i}.wav", 0.5)
    command = [sys.executable, "-u", "-m", "gesturekit", "render", tmp_path / "in"]
    command += ["--model", model, "--out", tmp_path / "out"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    running = subprocess.Popen(command, **pipes, text=True)
    assert running.stdout.readline().strip() == str(tmp_path / "out" / "0.bvh")
    running.stdout.close()
    told = running.stderr.read()
    running.stderr.close()
    running.wait(timeout=60)
    assert "Traceback" not in told and "Exception" not in told


def test_control_characters_in_names_are_shown_as_escapes(gesturekit, gesture, tmp_path):
    """Names that would reverse the text or clear the screen; joiners of letters are text."""
    gesture(0.2).save(tmp_path / "a\u202ehvb\u200d.bvh")
    (tmp_path / "c\x07.bvh").write_text("HIERARCHY\n")
    done = gesturekit("convert", tmp_path, tmp_path / "out", "--format", "npz")
    assert "a\\u202ehvb\u200d.bvh" in done.out and "c\\x07.bvh" in done.err
    assert not re.search("[\u202e\x07]", done.out + done.err)


def test_every_verb_that_writes_takes_one_option_for_what_exists():
    for verb in ("render", "convert", "features", "demo", "view", "evaluate", "prepare"):
        command = cli.get_command(click.Context(cli), verb)
        (option,) = (param for param in command.params if param.name == "existing")
        assert set(option.type.choices) == set(EXISTING), verb


def test_a_manifest_and_a_feature_model_may_be_kept(gesturekit, corpus, write_pair, tmp_path):
    write_pair(tmp_path / "in", "a", 2.0)
    manifest = tmp_path / "corpus.jsonl"
    prepare = ("prepare", tmp_path / "in", "--out", manifest, "--holdout", 0)
    assert gesturekit(*prepare).status == 0 and gesturekit(*prepare).status == 0
    manifest.write_text("mine")
    assert gesturekit(*prepare, "--existing", "refuse").status == 2
    done = gesturekit(*prepare, "--existing", "skip")
    assert done.status == 0 and manifest.read_text() == "mine"
    (tmp_path / "feature_model.json").write_text("{}")
    fit = ("fit-features", tmp_path / "in", "--out", tmp_path)
    gesturekit(*fit).fails(2, "feature_model.json exists already")
    assert gesturekit(*fit, "--existing", "skip").status == 0


def test_the_demo_leaves_every_format_and_its_sound(gesturekit, tmp_path):
    done = gesturekit("demo", "--out", tmp_path).ok()
    names = ["speech.bvh", "speech.html", "speech.npz", "speech.png", "speech.wav"]
    assert sorted(path.name for path in tmp_path.glob("speech.*")) == names
    assert (tmp_path / "speech.wav").read_bytes() == systems.bundled_speech().read_bytes()
    assert all(f"{tmp_path / name}\n" in done.out for name in names)
    page = data_of(tmp_path / "speech.html")
    assert 0.4 < page["below"] / page["height"] < 0.5  # from the waist up
    if is_baked():
        assert page["figures"][0]["n_joints"] > 52  # the human body, with fingers
    assert "Blender: File > Import" in done.out
    with np.load(tmp_path / "speech.npz", allow_pickle=False) as arrays:
        assert arrays["rotations"].shape[0] == arrays["translation"].shape[0]
    assert done.err.startswith("Loading the demo model ...")
    again = gesturekit("demo", "--out", tmp_path)
    assert again.status == 0 and sorted(again.out.split()) == sorted(done.out.split())
    (tmp_path / "speech.wav").write_text("mine")
    gesturekit("demo", "--out", tmp_path, "--seed", 1).fails(2, "speech.wav exists already")
    first = (tmp_path / "speech.bvh").read_bytes()
    kept = gesturekit("demo", "--out", tmp_path, "--seed", 1, "--existing", "skip").ok()
    assert "speech.wav: skipped" in kept.err and (tmp_path / "speech.wav").read_text() == "mine"
    assert (tmp_path / "speech.bvh").read_bytes() == first


def test_the_demo_takes_a_seed_and_reports_a_failure(
    gesturekit, write_speech, tmp_path, monkeypatch
):
    speech = write_speech(tmp_path / "speech.wav", 0.5)
    monkeypatch.setattr(systems, "bundled_speech", lambda: speech)
    for seed in (0, 1):
        gesturekit("demo", "--out", tmp_path / f"{seed}", "--seed", seed).ok()
    one, two = ((tmp_path / name / "speech.bvh").read_bytes() for name in "01")
    assert one != two
    speech.write_bytes(b"no sound")
    gesturekit("demo", "--out", tmp_path / "2").fails(1, "Failed: ", "speech.wav")


@pytest.mark.parametrize("options", [("convert", "--format", "npz"), ("features",)])
def test_ctrl_c_prints_how_to_continue(gesturekit, write_pair, tmp_path, monkeypatch, options):
    verb, *options = options
    source, out = write_pair(tmp_path / "in", "a", 1.0)[verb == "convert"], tmp_path / "out"

    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(gk.Motion if verb == "convert" else af.FeatureTrack, "save", stop)
    where = (source, out) if verb == "convert" else (source, "--out", out)
    done = gesturekit(verb, *where, *options).fails(130)
    last = done.err.splitlines()[-1]
    assert last.startswith("Interrupted. 0 done") and "the same command" in last


def test_a_seed_below_0_is_refused_at_once_everywhere(gesturekit, model, corpus, tmp_path):
    """Before files are read: none of these inputs exists."""
    for verb in ("render", "demo", "genea", "evaluate", "prepare", "fit-features", "study"):
        command = [verb, "analyse"] if verb == "study" else [verb]
        gesturekit(*command, "x", "y", "--seed", -1).fails(2, "Invalid value for '--seed': -1")
    loaded = gk.load(model)
    for call in (
        lambda: loaded.generate(seconds=1.0, seed=-1),
        lambda: loaded.check_controls(seed=-1),
        lambda: gk.evaluate(tmp_path, tmp_path, seed=-1),
        lambda: gk.prepare([tmp_path], tmp_path / "c.jsonl", seed=-1),
        lambda: gk.train("multires_speech/light", corpus=corpus, out=tmp_path / "run", seed=-1),
    ):
        with pytest.raises(gk.GestureKitError, match=r"seed.*-1"):
            call()
    assert list(tmp_path.iterdir()) == []


def test_extractors_are_listed_with_their_settings(gesturekit, write_speech, tmp_path):
    wav = write_speech(tmp_path / "a.wav", 0.5)
    specs = {}
    for listed in ("logmel:8", " mfcc:6 ,, prosody:pyin", "effort:0.5,onset"):
        out = tmp_path / listed.strip()[:3]
        done = gesturekit("features", wav, "--extractor", listed, "--cache", "off", "--out", out)
        spec = af.FeatureTrack.load(out / "a.npz").spec
        specs[listed] = spec if spec["kind"] != "stack" else spec["parts"]
        width = af.FeatureTrack.load(out / "a.npz").values.shape[1]
        assert done.ok().out == f"{out / 'a.npz'}: 50 frames × {width}\n"
    assert (specs["logmel:8"]["kind"], specs["logmel:8"]["n_mels"]) == ("logmel", 8)
    mfcc, prosody = specs[" mfcc:6 ,, prosody:pyin"]
    assert 6 in mfcc.values() and "pyin" in prosody.values()
    effort, onset = specs["effort:0.5,onset"]
    assert effort == {"kind": "effort", "seconds": 0.5} and onset["kind"] == "onset"


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ("--extractor mel", "--extractor 'mel': one or more of logmel, mfcc"),
        ("--extractor onset:3", "--extractor 'onset:3': one or more of"),
        ("--extractor mfcc --layer 6", "--layer requires --extractor wavlm or hf"),
        ("--extractor mfcc --weights w", "--weights requires --extractor wavlm or hf or files"),
        ("--extractor wavlm --rate 50", "--rate requires --extractor files"),
        ("--extractor hf --preset dsg", "--preset requires --extractor wavlm"),
        ("--extractor mfcc --full-context 3", "--full-context requires --extractor wavlm or hf"),
        ("--extractor wavlm --layer 6:1,9", "--layer '6:1,9': 6, 6,9, last, mean or 6:1,9:3"),
        ("--extractor wavlm --layer x:1", "--layer 'x:1': 6, 6,9"),
        ("--extractor mfcc --align mean", "--align requires --fps"),
    ],
)
def test_options_of_networks_need_one(gesturekit, write_speech, tmp_path, options, says):
    wav = write_speech(tmp_path / "a.wav", 0.5)
    done = gesturekit("features", wav, *options.split(), "--out", tmp_path / "out")
    done.fails(2, says)
    assert not (tmp_path / "out").exists()
