"""The four ways through the code, as docs/architecture.md lists them, are the ways it takes."""

from __future__ import annotations

import re
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

import gesturekit as gk
from gesturekit.evaluation import write_report

ROOT = Path(__file__).resolve().parents[1]
LONGEST = 15
TITLES = [
    "From a wav to motion",
    "From files to files",
    "From a corpus to a model",
    "From outputs to a report",
]
TINY = [  # a training of two iterations a stage
    *("threads=1", "network.levels=4", "network.channels=[2,2]", "network.embedding=4"),
    *("training.first_stage=2", "training.further_stages=2", "training.batch=2"),
    *("training.window=2", "training.window_cache=2", "recall.level=2"),
]


def listed(title: str) -> list[tuple[str, str]]:
    """Return (file, function) of each line of a numbered list in docs/architecture.md."""
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    section = text.partition(f"## {title}\n")[2].partition("\n## ")[0]
    lines = re.findall(r"^\d+\. .*$", section, re.MULTILINE)
    calls = [re.match(r"\d+\. `([\w.]+)` in `([\w/.]+\.py)`: ", line) for line in lines]
    assert lines and all(calls), f"{title}: a line is not of the form: 1. `function` in `file.py`:"
    return [(call[2], call[1]) for call in calls]


def called(work: Callable[[], object]) -> list[tuple[str, str]]:
    """Return (file, function) of what a piece of work calls, in the order of the first calls."""
    order: dict[tuple[str, str], None] = {}
    prefix = f"{ROOT}/"

    def profile(frame, event, _):
        if event == "call" and frame.f_code.co_filename.startswith(prefix):
            name = frame.f_code.co_filename.removeprefix(prefix)
            order.setdefault((name, frame.f_code.co_qualname))

    threading.setprofile(profile)
    sys.setprofile(profile)
    try:
        work()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return list(order)


@pytest.fixture
def ways(tmp_path, corpus, gesture, write_pair) -> dict[str, Callable[[], object]]:
    """Return the work that each list describes."""
    wav, bvh = write_pair(tmp_path / "speech", "one", 3.0)

    def from_wav_to_motion():
        gk.load("demo").generate(wav).save(tmp_path / "one.bvh")

    def from_files_to_files():
        gk.render("demo", tmp_path / "speech", tmp_path / "rendered")

    def from_corpus_to_model():
        gk.train("multires_speech/light", TINY, corpus=corpus, out=tmp_path / "run")

    def from_outputs_to_report():
        write_report(gk.evaluate(bvh.parent, bvh.parent), tmp_path / "report.html")

    return {
        "From a wav to motion": from_wav_to_motion,
        "From files to files": from_files_to_files,
        "From a corpus to a model": from_corpus_to_model,
        "From outputs to a report": from_outputs_to_report,
    }


@pytest.mark.parametrize("title", TITLES)
def test_each_list_names_functions_in_the_order_in_which_they_are_called(title, ways):
    expected = listed(title)
    assert len(expected) <= LONGEST
    order = called(ways[title])
    missing = [call for call in expected if call not in order]
    assert not missing, f"{title}: never called: {missing}"
    found = sorted(expected, key=order.index)
    assert found == expected, f"{title}: called in the order {[name for _, name in found]}"
