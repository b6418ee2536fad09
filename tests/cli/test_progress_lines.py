"""Lines of progress and warnings of the commands, as they are in the log file of a job."""

from __future__ import annotations

import logging
from types import SimpleNamespace

import pytest

from gesturekit import progress, systems
from gesturekit.cli import render as render_command
from gesturekit.progress import Progress


@pytest.fixture
def log_file(monkeypatch):
    """Each step of a progress is a line, as it is if it takes ten seconds."""
    start = Progress.__init__
    monkeypatch.setattr(progress, "SECONDS_BETWEEN_LINES", -1.0)
    monkeypatch.setattr(
        Progress,
        "__init__",
        lambda self, *items, **options: start(self, *items, mininterval=0, **options),
    )


@pytest.mark.parametrize(
    ("command", "line"),
    [
        ("features in --out {out}", "Features: 100%, 2 of 2 files"),
        ("convert in {out} --format npz", "Converting: 100%, 2 of 2 files"),
        ("prepare in --out {out}/c.jsonl", "checking: 100%, 2 of 2 files"),
        ("fit-features in --out {out} --steps 3 --frames 20", "Fitting: 100%, 3 of 3 steps"),
        ("evaluate in in --workers 1", "measuring: 100%, 4 of 4 recordings"),
    ],
)
def test_progress_has_a_total_and_a_unit(
    gesturekit, log_file, write_pair, tmp_path, monkeypatch, command, line
):
    monkeypatch.chdir(tmp_path)
    for seed, name in enumerate("ab"):
        write_pair(tmp_path / "in", name, 2.0, seed=seed)
    done = gesturekit(*command.format(out=tmp_path / "out").split())
    lines = [text.partition(", 0")[0].replace("  ", " ") for text in done.err.splitlines()]
    assert any(text.endswith(line) for text in lines), done.err


def test_rendering_says_how_fast_it_is(gesturekit, log_file, write_speech, tmp_path, monkeypatch):
    """Each of two sounds of 18.5 s is made in 5 s: 3.7 times as fast as they last."""
    for name in "ab":
        write_speech(tmp_path / "in" / f"{name}.wav", 18.5)
    add = render_command._Summary.add
    clock = SimpleNamespace(now=100.0)
    clock.monotonic = lambda: clock.now

    def timed(*arguments, **options):
        clock.now += 5.0
        return add(*arguments, **options)

    monkeypatch.setattr(render_command, "time", clock)
    monkeypatch.setattr(render_command._Summary, "add", timed)
    done = gesturekit("render", tmp_path / "in", "--model", "demo", "--out", tmp_path / "out").ok()
    *_, last = lines = done.err.splitlines()
    assert lines[0].startswith("Rendering:   0%, 0 of 2 files, ")
    for shown in ("Rendering:  50%, 1 of 2 files, ", "Rendering: 100%, 2 of 2 files, "):
        (line, *_) = [line for line in lines[::-1] if line.startswith(shown)]
        assert line.endswith(", 0.01 h of sound, 3.7x real time")
    assert last == f"2 rendered in 10 s: {tmp_path / 'out'}"


@pytest.mark.parametrize(
    ("command", "says"),
    [
        ("render --seconds 0.2 --model demo --out out", "Warning: odd"),
        ("features in --out out", "Warning: odd"),
        ("fit-features in --out out --steps 1 --frames 20", "odd"),
        ("train own_corpus --plan", "nothing\nodd"),
    ],
)
def test_warnings_of_the_work_are_plain_lines(
    gesturekit, write_pair, tmp_path, monkeypatch, capsys, command, says
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(logging.root, "handlers", [])
    monkeypatch.setattr(logging.root, "level", logging.WARNING)
    logging.getLogger("gesturekit").setLevel(logging.NOTSET)  # clears what loggers remember
    monkeypatch.setattr(systems, "plan_training", lambda *_: None)
    write_pair(tmp_path / "in", "a", 1.0)
    gesturekit(*command.split()).ok()
    logging.getLogger("gesturekit.somewhere").info("nothing")
    logging.getLogger("gesturekit.somewhere").warning("odd")
    assert capsys.readouterr().err == f"{says}\n"
