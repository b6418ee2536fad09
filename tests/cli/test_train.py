"""gesturekit train: what a user can get wrong, told in one line."""

from __future__ import annotations

import re
import shutil

import pytest

from gesturekit.training.config import read_yaml


@pytest.fixture
def train(gesturekit, light, corpus, tiny, tmp_path):
    """train("key=value", ...): the light recipe on the tiny corpus, into tmp_path/run."""

    def run(*arguments: object):
        return gesturekit(
            "train", light, f"corpus={corpus}", f"out={tmp_path / 'run'}", *tiny, *arguments
        )

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
        ("schedule.batch=0", "batch"),
        ("levels", "key=value"),
        ("fps=[25", "not valid YAML"),
        ("schedule.window=.nan", "window"),
        ("schedule.discriminator_steps=-1", "discriminator_steps: -1"),
        ("losses.contact=-5", "contact: -5"),
        ("threads=0", "threads: 0"),
        ("network.levels=40", "take fewer levels"),
        ("corpus=", "corpus may not be empty"),
        ("corpus=typo.jsonl", "typo.jsonl: cannot open the manifest"),
        ("corpus=.", "cannot open the manifest"),
        ("system=diffusion", "'diffusion'"),
        ("device=abacus", "device: 'abacus'"),
        ("joints=[Hips, Neckk]", "did you mean Neck"),
        ("joints=[Hips, Spine, Head]", "the arms must be modelled"),
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
        ("system: multires\nbase: mine.yaml\n", "base files go on and on"),
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
    done = gesturekit("train", "mine.yaml")
    assert done.status == 2
    assert says in error_line(done)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.yaml"]


def test_no_configuration_at_all(gesturekit, tmp_path):
    for path in (tmp_path / "none.yaml", tmp_path):
        done = gesturekit("train", path)
        assert done.status == 2 and str(path) in error_line(done)


def test_a_run_folder_that_cannot_be_made(train, tmp_path):
    (tmp_path / "file").touch()
    done = train(f"out={tmp_path / 'file' / 'run'}")
    assert done.status == 2
    assert str(tmp_path / "file") in error_line(done)
    assert "Errno" not in error_line(done)


def test_a_very_short_recording_beside_longer_ones(gesturekit, light, tiny, write_pair, tmp_path):
    for stem, seconds in {"long": 4.0, "short": 0.5}.items():
        write_pair(tmp_path / "pairs", stem, seconds)
    manifest = tmp_path / "corpus.jsonl"
    prepared = gesturekit("prepare", tmp_path / "pairs", "--out", manifest, "--holdout", "0")
    assert prepared.status == 0
    settings = (f"corpus={manifest}", f"out={tmp_path / 'run'}", *tiny, "network.levels=10")
    assert gesturekit("train", light, *settings).status == 0


def test_a_mistake_does_not_use_up_the_run_folder(train, tmp_path):
    assert train("corpus=typo.jsonl").status == 2
    done = train()
    assert done.status == 0, error_line(done)
    assert f"Model: {tmp_path / 'run' / 'model'}" in done.out


def test_a_finished_run_is_kept(train, tmp_path):
    nothing = train("--resume")
    assert nothing.status == 2 and "no run to resume" in error_line(nothing)
    assert train().status == 0
    model = tmp_path / "run" / "model"
    before = (model / "model.safetensors").read_bytes()
    again = train()
    assert again.status == 2 and "--resume" in error_line(again)
    other = train("--resume", "seed=7")
    assert other.status == 2 and "seed: 0" in error_line(other)
    shutil.rmtree(model)
    assert train("--resume").status == 0
    assert (model / "model.safetensors").read_bytes() == before
    assert read_yaml(tmp_path / "run" / "config.yaml")["network"]["levels"] == 4
