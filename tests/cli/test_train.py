"""gesturekit train: what a user can get wrong, told in one line."""

from __future__ import annotations

import html
import json
import logging
import re
import shutil
import socket
import subprocess
import sys
from dataclasses import replace

import pytest
import yaml

from audio_features.kinds import KINDS
from gesturekit import systems
from gesturekit.corpus import Manifest
from gesturekit.errors import ConfigError, ModelError
from gesturekit.inspection import inspect
from gesturekit.multires.training.stage import Stage
from gesturekit.systems import resolved_settings
from gesturekit.training.config import read_yaml
from gesturekit.training.run.held_out import HeldOutMetrics


@pytest.fixture
def train(gesturekit, light, corpus, tiny, tmp_path):
    """train("key=value", ...): the light recipe on the tiny corpus, into tmp_path/run."""

    def run(*arguments: object):
        files = (f"corpus={corpus}", f"out={tmp_path / 'run'}")
        return gesturekit("train", light, *files, *tiny, *arguments)

    return run


def error_line(done) -> str:
    """The one line that says what is wrong; a progress bar may come before and be wiped out."""
    (line,) = (line for line in re.split(r"[\r\n]", done.err) if "Error: " in line)
    assert line.startswith("Error: "), "glued to a progress bar"
    return line


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("netwrk.levels=3", "unknown key netwrk; did you mean network?"),
        ("network.level=3", "did you mean network.levels?"),
        ("network.levels=many", "network.levels: 'many' is not of type int"),
        ("network.kernel=4", "kernel: 4 must be odd"),
        ("network=3", "network"),
        ("training.batch=0", "batch"),
        ("seed=-1", "seed: -1 must be at least 0"),
        ("levels", "key=value"),
        ("fps=[25", "not valid YAML"),
        ("training.window=.nan", "window"),
        ("training.discriminator_steps=-1", "discriminator_steps: -1"),
        ("losses.contact=-5", "contact: -5"),
        ("longer=0", "longer: 0.0 must be above 0"),
        ("steps=9", "mean longer or training.first_stage or training.further_stages?"),
        ("training.epochs=9", "unknown key training.epochs; did you mean longer or"),
        ("training.lr=1", "unknown key training.lr; did you mean training.learning_rate?"),
        ("threads=0", "threads: 0"),
        ("network.levels=40", "use fewer levels"),
        ("corpus=", "corpus may not be empty"),
        ("corpus=typo.jsonl", "typo.jsonl: cannot open the manifest"),
        ("corpus=.", "cannot open the manifest"),
        ("system=diffusion", "for 'diffusion' take one of its recipes"),
        ("system=foo", "'foo' is not one of multires, diffusion"),
        ("device=abacus", "device: 'abacus'"),
        ("joints=[Hips, Neckk]", "did you mean Neck"),
        ("joints=[Hips, Spine, Head]", "or set losses.arm_speed=0 losses.arm_acceleration=0"),
        ("network.modulate=[Tail]", "no joint 'Tail'"),
        ("features.extractors=[{kind: mell}]", "'mell' is none of logmel, mfcc, prosody"),
        ("features.extractors=[]", "at least one extractor"),
    ],
)
def test_wrong_settings(train, override, says):
    done = train(override)
    assert done.status == 2 and done.out == ""
    assert says in error_line(done)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("system: multires\nbase: mine.yaml\n", "too many nested base files"),
        ("system: multires\nbase: gone.yaml\n", "gone.yaml: no such configuration file"),
        ("system: multires\n", "corpus is missing"),
        ("corpus: corpus.jsonl\n", "system: None"),
        ("system: [multires\n", "not valid YAML"),
        ("system: [multires]\n", "system: ['multires']"),
        ("system: multires\nfps: 2020-99-99\n", "not valid YAML"),
        ("system: " + "[" * 5000, "not valid YAML"),
        ("- system\n", "holds list"),
        ("", "holds NoneType"),
        ("system: !!python/object/apply:os.system [touch hacked]\n", "not valid YAML"),
    ],
)
def test_wrong_files(gesturekit, tmp_path, monkeypatch, text, says):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.yaml").write_text(text)
    done = gesturekit("train", "mine.yaml").fails(2)
    assert says in error_line(done)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.yaml"]


def test_a_run_folder_that_cannot_be_made(train, tmp_path):
    (tmp_path / "file").touch()
    done = train(f"out={tmp_path / 'file' / 'run'}").fails(2)
    assert str(tmp_path / "file") in error_line(done)
    assert "Errno" not in error_line(done)


def test_a_finished_run_is_kept(train, tmp_path, caplog):
    caplog.set_level("INFO")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "notes.txt").write_text("mine")
    nothing = train("--resume")
    assert nothing.status == 2 and "no run to resume" in error_line(nothing)
    assert train("corpus=typo.jsonl").status == 2  # does not use up the run folder
    first, model = train(), tmp_path / "run" / "model"
    assert first.status == 0 and f"Model: {model}" in first.out, first.err
    before = (model / "model.safetensors").read_bytes()
    again = train()
    assert again.status == 2 and "finished training" in error_line(again)
    other = train("--resume", "seed=7")
    assert other.status == 2 and "seed: 0" in error_line(other)
    caplog.clear()
    assert "gesturekit render speech.wav" in train("--resume").ok().out
    assert "All metrics on" not in caplog.text  # nothing is measured again
    assert f"{tmp_path / 'run'}: finished; nothing to resume" in caplog.text
    assert f"train {tmp_path / 'run' / 'config.yaml'} longer=" in caplog.text
    shutil.rmtree(model)
    assert train("--resume").status == 0
    assert (model / "model.safetensors").read_bytes() == before
    assert read_yaml(tmp_path / "run" / "config.yaml")["network"]["levels"] == 6


OWNER = """
import sys, time
from pathlib import Path
from gesturekit.training.run.folder import Run
Run(Path(sys.argv[1]), {}, resume=False).hold()
print("held", flush=True)
time.sleep(60)
"""


def test_a_run_folder_has_one_owner_until_it_dies(train, tmp_path):
    out = str(tmp_path / "run")
    with subprocess.Popen([sys.executable, "-c", OWNER, out], stdout=subprocess.PIPE) as owner:
        assert owner.stdout.readline() == b"held\n"
        error = error_line(train())
        assert f"process {owner.pid} on {socket.gethostname()}" in error and out in error
        owner.kill()
    assert train().status == 0


def test_a_checkpoint_of_another_run_is_refused_by_name(gesturekit, train, tmp_path):
    train("seed=1", f"out={tmp_path / 'other'}").ok()
    train().ok()
    (foreign,) = sorted((tmp_path / "other" / "checkpoints").iterdir())[-1:]
    shutil.copy(foreign, tmp_path / "run" / "checkpoints" / foreign.name)
    shutil.rmtree(tmp_path / "run" / "model")
    done = gesturekit("train", "--resume", tmp_path / "run")
    assert done.status == 2 and f"{foreign.name}: a checkpoint of another run" in done.err


@pytest.mark.parametrize("left", [None, ".", "data"])
def test_a_run_that_was_stopped_before_its_folder_begins(train, tmp_path, caplog, left):
    if left is not None:
        (tmp_path / "run" / left).mkdir(parents=True)
    caplog.set_level("INFO")
    train("--resume").ok()
    assert f"{tmp_path / 'run'}: no run to resume yet; starting a new one." in caplog.text
    caplog.clear()
    assert train("--resume").status == 0 and "begins" not in caplog.text


def test_the_run_folder_is_enough_to_resume(gesturekit, train, tmp_path):
    run = tmp_path / "run"
    assert train("seed=7").status == 0
    before = (run / "model" / "model.safetensors").read_bytes()
    shutil.rmtree(run / "model")
    (run / "checkpoints" / "step_00000004.pt").unlink()
    moved = run.rename(tmp_path / "moved")
    forgotten = gesturekit("train", moved)
    assert forgotten.status == 2 and "add --resume" in error_line(forgotten)
    # The model's folder stands for the run's.
    for folder in (moved, moved / "model"):
        assert gesturekit("train", "--resume", folder).status == 0
    assert (moved / "model" / "model.safetensors").read_bytes() == before
    nothing = gesturekit("train", "--resume", tmp_path)
    assert nothing.status == 2 and "no run to resume" in error_line(nothing)


def test_an_interrupted_run_says_how_to_go_on(gesturekit, train, tmp_path, monkeypatch, caplog):
    iterate, run, during = Stage.iterate, tmp_path / "run", {}
    command = f"gesturekit train --resume {run}"

    def interrupted(self, iteration):
        if self.first == 2:
            during.update(state=inspect(run).facts["state"], model=opened(run))
            with pytest.raises(ConfigError, match="it is in use, by process"):
                systems.train(run, resume=True)
            raise KeyboardInterrupt
        return iterate(self, iteration)

    def opened(path):
        with pytest.raises(ModelError) as caught:
            systems.load(path)
        return str(caught.value)

    monkeypatch.setattr(Stage, "iterate", interrupted)
    assert train().fails(130).err.splitlines()[-1] == f"Interrupted. Continue with: {command}"
    assert "Continue" not in caplog.text
    monkeypatch.undo()
    assert during["state"] == "running" and "still running" in during["model"]
    assert inspect(run).facts["state"] == "stopped" and command in dict(inspect(run).rows)["state"]
    for path in (run, run / "model"):
        assert opened(path).endswith(f"{run}: this training is not finished; {command}")
        gesturekit("render", "--seconds", 2, "--out", "o", "--model", path).fails(2, command)
        gesturekit("evaluate", path, tmp_path).fails(2, command)
    gesturekit("inspect", run / "model").fails(1, command)
    assert command in train(f"out={tmp_path / 'next'}", f"start_from={run}").fails(2).err
    assert gesturekit(*command.split()[1:]).status == 0
    assert inspect(run).facts["state"] == "finished" and systems.load(run)


def test_before_the_first_step_it_says_what_it_will_do(train, tmp_path, caplog):
    caplog.set_level(logging.INFO)
    train("--plan").ok()
    assert not (tmp_path / "run").exists()
    says = f"Run folder {tmp_path / 'run'}: multires, speech mode, 6 levels, 6 iterations"
    assert says in caplog.text
    assert "2 recordings, 8 s at 30 fps, trained at 25 fps" in caplog.text
    assert "19 of 19 joints modelled" in caplog.text
    assert re.search(r"Time: about \d+ ", caplog.text)
    assert train().status == 0
    train("--plan").ok()
    assert "holds a finished training already; a new one goes to another folder" in caplog.text


def test_one_setting_makes_a_training_twice_as_long(gesturekit, recipe, corpus, tmp_path, caplog):
    """Three stages of two iterations, and six updates."""
    caplog.set_level(logging.INFO)
    given = (*recipe, f"corpus={corpus}", f"out={tmp_path / 'run'}", "longer=2")
    gesturekit("train", *given, "--plan").ok()
    gesturekit("train", *given).ok()
    assert len(re.findall(r" 12 (?:iterations|updates) \(longer=2\)\.", caplog.text)) == 2
    assert "drawn" not in caplog.text and "draws" not in caplog.text
    lines = (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()
    assert max(json.loads(line)["step"] for line in lines) == 12


@pytest.fixture
def one_recording(gesturekit, write_pair, tmp_path):
    """A manifest whose only recording is cut: its end is held out."""
    write_pair(tmp_path / "one", "speech", 40.0)
    manifest = tmp_path / "one.jsonl"
    assert gesturekit("prepare", tmp_path / "one", "--out", manifest).status == 0
    return manifest


def test_it_ends_with_a_verdict_on_held_out_speech(train, one_recording, tmp_path, caplog):
    caplog.set_level(logging.INFO)
    done = train(f"corpus={one_recording}").ok()
    assert "Training on 1 recording, 32 s at 30 fps" in caplog.text
    said = re.search(r"Measured (on 1 held-out recording \(8 s\): [A-Z].*\.)\n\Z", done.out)[1]
    assert "Warning: held-out items with neighbours in training, of the same take" in said
    assert said in (tmp_path / "run" / "model" / "README.md").read_text()
    assert said not in caplog.text  # a terminal shows both
    assert html.escape(f"Measured {said}") in (tmp_path / "run" / "report.html").read_text()
    lines = [json.loads(x) for x in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    (figures,) = (line for line in lines if line.get("kind") == "held_out")
    assert {"held_out/sync", "held_out/sync_chance", "held_out/arm_speed"} <= figures.keys()
    assert "metrics.jsonl" in done.out and "tensorboard --logdir" in done.out
    assert f"render --corpus {one_recording} --split test" in done.out


def test_a_plan_warns_of_held_out_neighbours_once(train, one_recording, caplog):
    train(f"corpus={one_recording}", "--plan").ok()
    assert caplog.text.count("held-out items with neighbours in training") == 1


def test_a_file_that_was_swapped_after_prepare_is_named(
    train, one_recording, write_speech, tmp_path, caplog
):
    train(f"corpus={one_recording}", "--plan").ok()
    assert "changed since" not in caplog.text
    swapped = write_speech(tmp_path / "one" / "speech.wav", 40.0, level=0.1)
    train(f"corpus={one_recording}", "--plan").ok()
    assert "1 file changed since gesturekit prepare" in caplog.text
    assert str(swapped) in caplog.text and "speech.bvh" not in caplog.text


def test_frequent_evaluation_does_not_change_weights(train, one_recording, tmp_path, monkeypatch):
    corpus = f"corpus={one_recording}"
    assert train(corpus).status == 0
    due = iter([False, True, True])
    monkeypatch.setattr(HeldOutMetrics, "is_due", lambda self: next(due, False))
    assert train(corpus, f"out={tmp_path / 'other'}").status == 0
    assert '"kind": "held_out"' in (tmp_path / "other" / "metrics.jsonl").read_text()
    weights = [tmp_path / run / "model" / "model.safetensors" for run in ("run", "other")]
    assert weights[0].read_bytes() == weights[1].read_bytes()


def test_a_corpus_deleted_during_training_only_costs_the_metrics(
    gesturekit, train, one_recording, tmp_path, caplog
):
    assert train(f"corpus={one_recording}").status == 0
    shutil.rmtree(tmp_path / "run" / "model")
    one_recording.rename(tmp_path / "elsewhere.jsonl")
    gesturekit("train", "--resume", tmp_path / "run").ok()
    assert "No metrics on held-out recordings" in caplog.text


def test_a_model_without_speech_is_rendered_for_seconds(gesturekit, corpus, light, tiny, tmp_path):
    recipe = light.parents[1] / "ganimator" / "config.yaml"
    done = gesturekit("train", recipe, f"corpus={corpus}", f"out={tmp_path / 'run'}", *tiny).ok()
    assert "gesturekit render --seconds 20 --model" in done.out and ".wav" not in done.out
    lines = (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()
    assert json.loads(lines[-1])["recorded/jerk"] > 0


WAVLM = {"kind": "wavlm"}


@pytest.mark.parametrize(
    ("model", "features", "given"),
    [
        ({}, None, "--seconds 20 --model {m} --out rendered"),
        ({"path": True}, None, "--model {m} --path way.csv --out rendered"),
        ({"styles": ["old", "sad"]}, None, "--seconds 20 --model {m} --style old --out rendered"),
        ({}, [{"kind": "logmel"}], "speech.wav --model {m} --out rendered"),
        ({}, [WAVLM], "speech.wav --model {m} --weights w.pt --out rendered"),
        (
            {"path": True},
            [WAVLM, {"kind": "words", "encoder": "bert"}],
            "speech.wav --model {m} --weights wavlm=w.pt --weights words=bert --path way.csv "
            "--out rendered",
        ),
    ],
)
def test_it_ends_with_the_command_that_renders(
    gesturekit, light, corpus, tmp_path, monkeypatch, model, features, given
):
    folder = tmp_path / "run" / "model"
    folder.mkdir(parents=True)
    (folder.parent / "events").mkdir()
    speech = {"spec": {"kind": "stack", "parts": features}} if features else None
    (folder / "config.yaml").write_text(yaml.safe_dump({**model, "features": speech}))
    run = {"corpus": str(corpus), "features": {"extractors": features, "weights": "w.pt"}}
    (folder.parent / "config.yaml").write_text(yaml.safe_dump(run))
    monkeypatch.setattr(systems, "train", lambda *_, **__: folder)
    lines = gesturekit("train", light).ok().out.splitlines()
    render = given.format(m=folder)
    needed = [line for line in lines if line.startswith("It needs ")]
    encoders = [one for one in features or () if one["kind"] != "logmel"]
    assert len(needed) == len(encoders) + any(one["kind"] == "words" for one in encoders)
    assert [line for line in lines if line not in needed] == [
        f"Report: {folder.parent / 'report.html'}",
        f"Losses and metrics: {folder.parent / 'metrics.jsonl'}",
        f"Curves: tensorboard --logdir {folder.parent / 'events'}",
        f"Model: {folder}",
        f"Render with: gesturekit render {render}",
    ]


def test_it_ends_with_held_out_speech_while_the_manifest_is_there(
    gesturekit, light, corpus, tmp_path, monkeypatch
):
    folder = tmp_path / "run" / "model"
    folder.mkdir(parents=True)
    features = [{"kind": "logmel"}]
    (folder / "config.yaml").write_text(yaml.safe_dump({"features": {"spec": features[0]}}))
    items = Manifest.load(corpus).paired()
    Manifest([replace(items[0], split="test")]).save(manifest := tmp_path / "c.jsonl")
    run = {"corpus": str(manifest), "features": {"extractors": features}}
    (folder.parent / "config.yaml").write_text(yaml.safe_dump(run))
    monkeypatch.setattr(systems, "train", lambda *_, **__: folder)
    held_out = f"--corpus {manifest} --split test"
    assert gesturekit("train", light).ok().out.splitlines()[-2:] == [
        f"Held-out speech: gesturekit render {held_out} --model {folder} --out rendered",
        f"Evaluate with: gesturekit evaluate rendered {held_out}",
    ]
    manifest.unlink()
    assert "Held-out" not in gesturekit("train", light).ok().out


def test_a_new_run_is_planned_and_its_processes_are_a_setting(gesturekit, light):
    for option in ("--plan", "--arrays"):
        done = gesturekit("train", light, "--resume", option)
        done.fails(2, f"{option} is for a new run; leave out --resume")
    assert "workers=3  (default: 1)" in gesturekit("train", light, "--show", "--workers", 3).out
    done = gesturekit("train", light, "--reume")
    done.fails(2, "Did you mean", "--resume")


def test_a_mistyped_configuration_suggests_the_nearest(gesturekit, light, monkeypatch):
    monkeypatch.chdir(light.parents[2])
    done = gesturekit("train", "recipes/multires_speach/lite.yaml")
    assert "did you mean recipes/multires_speech/light.yaml?" in error_line(done)
    done = gesturekit("train", "nothing_like_it")
    assert done.status == 2 and "nothing_like_it" in error_line(done)
    assert "recipes/ganimator/config.yaml" in error_line(done)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--resume", "runs/none"], "runs/none: no such run"),
        (
            ["c.jsonl"],
            "c.jsonl: a manifest, not a configuration; gesturekit train own_corpus corpus=c.jsonl",
        ),
        ([], "gesturekit train own_corpus corpus=CORPUS.jsonl"),
        (["corpus=c.jsonl", "seed=1"], "gesturekit train own_corpus corpus=c.jsonl seed=1"),
        (["a.bvh"], "prepare on its folder, then gesturekit train own_corpus"),
        (["light.yaml"], "did you mean recipes/speech/light.yaml?"),
        (["folder"], "run gesturekit prepare on it"),
        (["recipes/speech/light.yaml", "corpus=folder"], "it is a folder; run gesturekit prepare"),
        (["recipes/speech/light.yaml", "out=c.jsonl"], "c.jsonl: a file, not a run folder"),
        (["recipes/speech/light.yaml", "out=c.jsonl", "--plan"], "c.jsonl: a file, not a run"),
        (["recipes/speech/light.yaml", "losses.window=3"], "did you mean training.window?"),
        (["recipes/speech/light.yaml", "window=3"], "did you mean training.window?"),
        (["recipes/speech/light.yaml", "window=3", "--show"], "did you mean training.window?"),
        (["recipes/speech/light.yaml", "--resum"], "--resume"),
        (["runs/none", "--resume", "--plan"], "--plan is for a new run; leave out --resume"),
        (["runs/none", "--resume", "--arrays"], "--arrays is for a new run; leave out --resume"),
    ],
)
def test_common_mistakes_in_naming_a_run_a_recipe_or_a_setting(
    gesturekit, corpus, tmp_path, monkeypatch, arguments, says
):
    monkeypatch.chdir(tmp_path)
    light = tmp_path / "recipes" / "speech" / "light.yaml"
    light.parent.mkdir(parents=True)
    light.write_text(f"system: multires\ncorpus: {corpus}\nfps: 25\n")
    (tmp_path / "folder").mkdir()
    for name in ("c.jsonl", "a.bvh"):
        (tmp_path / name).touch()
    done = gesturekit("train", *arguments).fails(2)
    assert says in error_line(done)


@pytest.mark.parametrize(
    ("given", "setting"),
    [
        (["--training.first_stage", "20"], "training.first_stage=20"),
        (["--corpus", "x.jsonl"], "corpus=x.jsonl"),
        (["--corpus=x.jsonl"], "corpus=x.jsonl"),
        (["--out", "seed=3"], "out=VALUE"),
        (["--out"], "out=VALUE"),
    ],
)
def test_a_setting_written_as_an_option_is_shown_as_a_setting(gesturekit, light, given, setting):
    for arguments in ([light, *given], [*given, light])[: 2 - (given == ["--out"])]:
        done = gesturekit("train", *arguments)
        assert done.status == 2 and done.out == ""
        says = f"No such option: {given[0]}; settings are written without --: {setting}\n"
        assert says in done.err


def test_show_prints_every_setting(gesturekit, monkeypatch, tmp_path):
    monkeypatch.setenv("COLUMNS", "60")
    config = tmp_path / "mine.yaml"
    notes = f"notes={{who: Jürgen, about: {'a long story ' * 9}again}}"
    config.write_text(
        f"system: multires\nstyles: {{}}\nfeatures: null\n{notes.replace('=', ': ')}\n", "utf-8"
    )
    done = gesturekit("train", config, "training.batch=8", "--show")
    assert not done.status, done.err
    lines = done.out.splitlines()
    assert all(len(line) <= 60 for line in lines if line[:4] == "    ")
    assert "training.batch=8  (default: 4)" in lines
    assert "training.betas=[0.9, 0.999]" in lines
    assert f"{notes}  (default: {{}})" in lines
    assert "corpus=null  (required)" in lines
    assert lines[lines.index("corpus=null  (required)") + 1].startswith("    Manifest")
    assert "[training]" in lines
    assert "[styles]  (default: null)" in lines
    assert any(line.startswith("features=null  (default: {extractors:") for line in lines)
    shown = {line.partition("=")[0] for line in lines if "=" in line and line[0] != " "}
    assert {"fps", "network.levels", "losses.contact", "styles.mixing"} <= shown


def test_show_lists_the_kinds_of_extractors(gesturekit):
    said = gesturekit("train", "own_corpus", "--show").ok().out
    kinds = said.partition("features.extractors=")[2].partition("Kinds:")[2].partition("(")[0]
    assert [kind.strip() for kind in kinds.split(",")] == list(KINDS)


def test_show_of_a_run_has_its_corpus(gesturekit, tmp_path):
    (tmp_path / "config.yaml").write_text("system: diffusion\ncorpus: gone.jsonl\n")
    done = gesturekit("train", tmp_path, "--show")
    assert not done.status, done.err
    assert f"corpus={tmp_path / 'gone.jsonl'}  (required)" in done.out.splitlines()
    assert f"out={tmp_path}" in done.out


@pytest.mark.parametrize("name", ["multires", "diffusion"])
def test_every_setting_has_a_docstring(name, tmp_path):
    config = tmp_path / "config.yaml"
    config.write_text(f"system: {name}\nstyles: {{}}\n")
    overrides = ["unpaired={}"] if name == "diffusion" else []
    assert not [s.name for s in resolved_settings(config, overrides) if not s.doc]


@pytest.fixture
def labelled(gesturekit, write_pair, tmp_path):
    """A manifest of two speakers, each in a style of their own."""
    for seed, name in enumerate(("ada_calm", "bob_wild")):
        write_pair(tmp_path / "labelled", name, 4.0, seed=seed)
    manifest = tmp_path / "labelled.jsonl"
    pattern = ("--style-pattern", "(?P<speaker>[a-z]+)_(?P<style>[a-z]+)")
    gesturekit("prepare", tmp_path / "labelled", "--out", manifest, "--holdout", 0, *pattern).ok()
    return manifest


def test_unused_styles_and_speakers_are_reported(gesturekit, labelled, recipe, tmp_path, caplog):
    """Before and after training, and when a model of several speakers is rendered without one."""
    styles = "2 styles in the corpus, none used; styles={} trains with them"
    speakers = "2 speakers in the corpus, none used: gestures are those of all of them, and "
    recall = ["recall=null"] if recipe[0].parent.name == "multires_speech" else []
    for name, settings, said in (
        ("plain", recall, (True, True)),
        ("styled", ["styles={}", *recall], (False, True)),
    ):
        caplog.clear()
        given = (*recipe, f"corpus={labelled}", f"out={tmp_path / name}", *settings)
        assert gesturekit("train", *given).status == 0
        card = (tmp_path / name / "model" / "README.md").read_text()
        for text in (caplog.text, card):
            assert (styles in text, speakers in text) == said, name
        assert "- **Not used**: " in card
    wav = tmp_path / "labelled" / "ada_calm.wav"
    render = ("render", wav, "--model", tmp_path / "plain", "--out", tmp_path / "out")
    warning = "the model has 2 speakers and none is chosen: gestures are those of all of them"
    assert gesturekit(*render).err.count(warning) == 1
    of_items = ("render", "--corpus", labelled, "--split", "train", *render[2:])
    for command in ((*render, "--speaker", "bob"), of_items):
        assert warning not in gesturekit(*command, "--existing", "replace").ok().err


def test_a_speaker_whose_recordings_are_recalled_counts_as_used(
    gesturekit, labelled, light, tiny, tmp_path, caplog
):
    given = (light, *tiny, f"corpus={labelled}", f"out={tmp_path / 'run'}", "recall.level=2")
    assert gesturekit("train", *given).status == 0
    assert "styles in the corpus, none used" in caplog.text
    assert "speakers in the corpus" not in caplog.text
