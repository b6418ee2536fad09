"""The recipe that writes the papers' tables, on tiny motion."""

from __future__ import annotations

import json
import runpy
from pathlib import Path

import pytest

TABLES = Path(__file__).parents[2] / "recipes/paper_tables/tables.py"


@pytest.mark.stress
@pytest.mark.parametrize(
    ("protocol", "seconds", "row"),
    [("multires", 3.0, "| **mean** |"), ("lda", 10.0, "| fid_k |")],
)
def test_a_table_has_our_figures_beside_the_papers(
    gesture, tmp_path, monkeypatch, protocol, seconds, row
):
    for name in ("recordings", "made"):
        (tmp_path / name).mkdir()
    for i in range(2):
        gesture(seconds, 25.0, seed=i).save(tmp_path / "recordings" / f"clip{i}.npz")
        for s in (1, 2):
            made = gesture(seconds * (2 if protocol == "multires" else 1), 25.0, seed=10 * i + s)
            made.save(tmp_path / "made" / f"clip{i}_s{s}.npz")
    monkeypatch.setenv("GESTUREKIT_CACHE", str(tmp_path / "cache"))
    arguments = [protocol, str(tmp_path / "made"), str(tmp_path / "recordings")]
    runpy.run_path(str(TABLES))["main"](
        [*arguments, "--samples", "2", "--out", str(tmp_path / "out")]
    )
    text = (tmp_path / "out" / f"{protocol}.md").read_text(encoding="utf-8")
    assert row in text and "What cannot be compared:" in text
    (model,) = json.loads((tmp_path / "out" / f"{protocol}.json").read_text())["models"]
    key = "coverage" if protocol == "multires" else "fid_k"
    assert f"{model['figures'][key]['value']:.3g}" in next(
        line for line in text.splitlines() if line.startswith(row)
    )
