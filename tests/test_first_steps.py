"""The notebook of first steps runs as it is, and is committed without outputs."""

import html
import re
from pathlib import Path

import pytest
from pages import bundled

nbformat = pytest.importorskip("nbformat", reason="pip install nbclient ipykernel")
nbclient = pytest.importorskip("nbclient", reason="pip install nbclient ipykernel")
pytest.importorskip("ipykernel", reason="pip install nbclient ipykernel")

NOTEBOOK = Path(__file__).resolve().parents[1] / "docs" / "first_steps.ipynb"


@bundled
@pytest.mark.stress
def test_the_notebook_shows_motion_plots_and_a_verdict(tmp_path, monkeypatch):
    monkeypatch.setenv("JUPYTER_DATA_DIR", str(tmp_path))  # no kernels of the user
    notebook = nbformat.read(NOTEBOOK, 4)
    nbformat.validate(notebook)
    assert not any(cell.get("outputs") for cell in notebook.cells)
    where = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(notebook, timeout=60, resources=where).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    shown = [output.get("data", {}) for output in outputs]
    (player,) = (data["text/html"] for data in shown if "text/html" in data)
    assert "<iframe" in player and re.search(r'"below":\s*0\.7\b', html.unescape(player))
    assert any("image/png" in data for data in shown)
    text = "".join(output.get("text", "") for output in outputs)
    r, chance = map(float, re.search(r"sync r (\S+), .*chance (\S+)", text).groups())
    assert r > 0.4 > chance
    assert "the speaker" in text and "arm speed" in text
