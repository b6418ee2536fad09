"""gesturekit train: what a user can get wrong, told in one line."""

import html
import json
import logging
import multiprocessing
import re
import shutil
import socket
import time
from pathlib import Path
from typing import Any

import pytest

from gesturekit import systems
from gesturekit.corpus import Manifest
from gesturekit.errors import ConfigError
from gesturekit.inspection import inspect
from gesturekit.multires.training.trainer import Stage
from gesturekit.systems import resolved_settings
from gesturekit.training.run_folder import Run


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


def test_wrong_settings(train, tmp_path):
    for number, (override, says) in enumerate(
        (
            ("netwrk.levels=3", "netwrk & network"),
            ("training.batch=0", "batch"),
            ("levels", "key=value"),
            ("fps=[25", "fps=.25 & YAML"),
            ("steps=9", "longer & training.first_stage"),
            ("corpus=typo.jsonl", "typo.jsonl"),
            ("system=diffusion", "'diffusion' & recipes"),
            ("device=abacus", "device & 'abacus'"),
            ("losses.arm_speed=3 & joints=[Hips, Spine, Head]", "losses.arm_speed=0 "),
            ("features.extractors=[{kind: mell}]", "'mell' & logmel"),
        )
    ):
        done = train(f"out={tmp_path / str(number)}", *override.split(" & ")).fails(2)
        error = error_line(done)
        assert all(re.search(fact, error) for fact in says.split(" & ")) and done.out == ""


def test_wrong_files(gesturekit, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for text, says in (
        ("system: multires\nbase: mine.yaml\n", "base"),
        ("system: multires\n", "corpus"),
        ("- system\n", "list"),
        ("system: !!python/object/apply:os.system [touch hacked]\n", "YAML"),
    ):
        (tmp_path / "mine.yaml").write_text(text)
        assert says in error_line(gesturekit("train", "mine.yaml").fails(2))
    assert [path.name for path in tmp_path.iterdir()] == ["mine.yaml"]


@pytest.fixture
def finished(model, tmp_path) -> Path:
    """The folder of a finished run, as train() leaves it."""
    return Path(shutil.copytree(model.parent, tmp_path / "run"))


def test_a_finished_run_is_kept_and_its_folder_is_enough_to_resume(
    gesturekit, train, finished, tmp_path, caplog
):
    caplog.set_level("INFO")
    before = (finished / "model" / "model.safetensors").read_bytes()
    measured = (finished / "metrics.jsonl").read_bytes()
    assert str(finished) in error_line(train())
    assert re.search(
        r"(?=.*network\.embedding)(?=.*\b5\b)", error_line(train("--resume", "network.embedding=5"))
    )
    done = gesturekit("train", "--resume", finished).ok()
    assert str(finished / "model") in done.out and "gesturekit render speech.wav" in done.out
    assert re.search(f"(?=.*{finished})(?=.* finished)", caplog.text)
    assert (finished / "metrics.jsonl").read_bytes() == measured, "nothing is measured again"
    shutil.rmtree(finished / "model")
    (finished / "checkpoints" / "step_00000004.pt").unlink()
    moved = finished.rename(tmp_path / "moved")
    assert "--resume" in error_line(gesturekit("train", moved))
    for folder in (moved, moved / "model"):  # the model's folder stands for the run's
        gesturekit("train", "--resume", folder).ok()
    assert (moved / "model" / "model.safetensors").read_bytes() == before
    assert str(tmp_path) in error_line(gesturekit("train", "--resume", tmp_path))


def hold(folder: Path, held: Any) -> None:
    """Own a run's folder for a minute."""
    Run(folder, {}, resume=False).hold()
    held.set()
    time.sleep(60)


def test_a_run_folder_has_one_owner_until_it_dies(train, tmp_path, caplog, monkeypatch):
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    processes = multiprocessing.get_context("fork")  # nothing to import again
    held = processes.Event()
    owner = processes.Process(target=hold, args=(tmp_path / "run", held), daemon=True)
    owner.start()
    assert held.wait(20)
    error = error_line(train())
    for fact in (owner.pid, socket.gethostname(), tmp_path / "run"):
        assert str(fact) in error
    owner.kill()
    owner.join()
    caplog.set_level("INFO")
    monkeypatch.setattr(Manifest, "load", interrupted)
    train("--resume").fails(130)
    assert str(tmp_path / "run") in caplog.text


def test_an_interrupted_run_says_how_to_go_on(gesturekit, train, tmp_path, monkeypatch):
    iterate, run, during = Stage.iterate, tmp_path / "run", {}
    command = f"gesturekit train --resume {run}"

    def interrupted(self, iteration):
        if self.first == 2:
            during.update(state=inspect(run).facts["state"])
            with pytest.raises(ConfigError, match=re.escape(str(run))):
                systems.train(run, resume=True)
            raise KeyboardInterrupt
        return iterate(self, iteration)

    monkeypatch.setattr(Stage, "iterate", interrupted)
    train().fails(130, command)
    monkeypatch.undo()
    assert during["state"] == "running" and inspect(run).facts["state"] == "stopped"
    for path in (run, run / "model"):
        gesturekit("render", "--seconds", 2, "--out", "o", "--model", path).fails(2, command)
        gesturekit("evaluate", path, tmp_path).fails(2, command)
    gesturekit("inspect", run / "model").fails(1, command)
    assert command in train(f"out={tmp_path / 'next'}", f"start_from={run}").fails(2).err
    gesturekit(*command.split()[1:]).ok()
    assert inspect(run).facts["state"] == "finished" and systems.load(run)


def test_before_the_first_step_it_says_what_it_will_do(train, tmp_path, caplog):
    caplog.set_level(logging.INFO)
    train("--plan", f"out={tmp_path / 'new'}").ok()
    assert not (tmp_path / "new").exists()
    for says in (
        f"{tmp_path / 'new'} & multires & 6 levels",
        "2 recordings & 6 s & 30 fps & 25 fps",
        "19 of 19",
        r"Time & \d s",
    ):
        assert all(re.search(fact, caplog.text) for fact in says.split(" & "))
    assert ".wav" not in caplog.text and ".bvh" not in caplog.text, "no file has changed"


@pytest.mark.parametrize(
    "recipe", ["diffusion", pytest.param("multires", marks=pytest.mark.stress)], indirect=True
)
def test_one_setting_makes_a_training_twice_as_long(gesturekit, recipe, corpus, tmp_path, caplog):
    """Three stages of two iterations, and six updates."""
    caplog.set_level(logging.INFO)
    gesturekit("train", *recipe, f"corpus={corpus}", f"out={tmp_path / 'run'}", "longer=2").ok()
    assert re.search(r"(?=.*\b12\b)(?=.*longer=2)", caplog.text)
    lines = (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()
    assert max(json.loads(line)["step"] for line in lines) == 12


@pytest.fixture
def one_recording(gesturekit, write_pair, tmp_path):
    """A manifest whose only recording is cut: its end is held out."""
    write_pair(tmp_path / "one", "speech", 15.0)
    manifest = tmp_path / "one.jsonl"
    assert gesturekit("prepare", tmp_path / "one", "--out", manifest).status == 0
    return manifest


def test_it_ends_with_a_verdict_on_held_out_speech(
    gesturekit, train, one_recording, tmp_path, caplog
):
    caplog.set_level(logging.INFO)
    run = tmp_path / "run"
    done = train(f"corpus={one_recording}").ok()
    assert re.search("(?=.*1 recording)(?=.*12 s)", caplog.text)
    said = re.search("Measured (.*held-out.*)", done.out)[1]
    assert re.search(r"(?=.*\b1\b)(?=.*\b3 s)", said)
    assert said in (run / "model" / "README.md").read_text()
    assert html.escape(said) in (run / "report.html").read_text()
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    (figures,) = (line for line in lines if line.get("kind") == "held_out")
    assert {"held_out/sync", "held_out/arm_speed"} <= figures.keys()
    assert f"render --corpus {one_recording} --split test" in done.out
    # A corpus that is deleted costs the metrics only.
    shutil.rmtree(run / "model")
    one_recording.rename(tmp_path / "elsewhere.jsonl")
    gesturekit("train", "--resume", run).ok()
    warned = [said.getMessage() for said in caplog.records if said.levelname == "WARNING"]
    assert any(str(one_recording) in text for text in warned)


def test_a_file_that_was_swapped_after_prepare_is_named(
    train, finished, one_recording, write_speech, tmp_path, caplog
):
    swapped = write_speech(tmp_path / "one" / "speech.wav", 15.0, level=0.1)
    train(f"corpus={one_recording}", "--plan").ok()
    assert str(finished) in caplog.text and "1 file" in caplog.text
    assert str(swapped) in caplog.text and "speech.bvh" not in caplog.text


def test_a_new_run_is_planned_and_its_processes_are_a_setting(gesturekit, light):
    for option in ("--plan", "--arrays"):
        done = gesturekit("train", light, "--resume", option)
        done.fails(2, option, "--resume")
    assert "workers=3" in gesturekit("train", light, "--show", "--workers", 3).out
    gesturekit("train", light, "--reume").fails(2, "--resume")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--resume", "runs/none"], "runs/none"),
        (["--resume", "own_corpus", "corpus=none.jsonl", "out=runs/none"], "none.jsonl"),
        (["c.jsonl"], "gesturekit train own_corpus corpus=c.jsonl"),
        ([], "gesturekit train own_corpus corpus=CORPUS.jsonl"),
        (["light.yaml"], "recipes/speech/light.yaml"),
        (["recipes/speech/light.yaml", "corpus=folder"], "gesturekit prepare"),
        (["recipes/speech/light.yaml", "out=c.jsonl"], "c.jsonl"),
        (["recipes/speech/light.yaml", "window=3"], "training.window"),
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


def test_a_setting_written_as_an_option_is_shown_as_a_setting(gesturekit, light):
    done = gesturekit("train", light, "--training.first_stage", "20")
    done.fails(2, "training.first_stage=20")


def test_show_prints_every_setting(gesturekit, tmp_path):
    config = tmp_path / "mine.yaml"
    config.write_text(
        "system: multires\nstyles: {}\nfeatures: null\nnotes: {who: Jürgen}\n", "utf-8"
    )
    lines = gesturekit("train", config, "training.batch=8", "--show").ok().out.splitlines()
    assert {
        "training.batch=8",
        "training.betas=[0.9, 0.999]",
        "notes={who: Jürgen}",
        "corpus=null",
    } <= {line.partition(" (")[0].strip() for line in lines}
    assert any("Manifest" in line for line in lines), "what a setting is"
    shown = {line.partition("=")[0] for line in lines if "=" in line and line[0] != " "}
    assert {"fps", "network.levels", "losses.contact", "styles.mixing"} <= shown


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
        write_pair(tmp_path / "labelled", name, 2.5, seed=seed)
    manifest = tmp_path / "labelled.jsonl"
    pattern = ("--style-pattern", "(?P<speaker>[a-z]+)_(?P<style>[a-z]+)")
    gesturekit("prepare", tmp_path / "labelled", "--out", manifest, "--holdout", 0, *pattern).ok()
    return manifest


def test_unused_styles_and_speakers_are_reported(
    gesturekit, labelled, light, tiny, tmp_path, caplog
):
    styles, speakers = "2 styles", "2 speakers"
    train = ("train", light, *tiny, f"corpus={labelled}", f"out={tmp_path / 'plain'}")
    gesturekit(
        *train,
        "--plan",
        "styles={}",
    ).ok()
    assert styles not in caplog.text and speakers not in caplog.text
    gesturekit(*train, "state=false", "losses.state=0").ok()
    for text in (caplog.text, (tmp_path / "plain" / "model" / "README.md").read_text()):
        assert styles in text and speakers in text and "styles={}" in text
    wav = tmp_path / "labelled" / "ada_calm.wav"
    render = ("render", wav, "--model", tmp_path / "plain", "--out", tmp_path / "out")
    assert gesturekit(*render).err.count(speakers) == 1
    of_items = ("render", "--corpus", labelled, "--split", "train", *render[2:])
    for command in ((*render, "--speaker", "bob"), of_items):
        assert speakers not in gesturekit(*command, "--existing", "replace").ok().err
