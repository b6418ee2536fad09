"""The papers' tables: their numbers from answers, models and recordings."""

import importlib
from pathlib import Path

import numpy as np
import pytest
import torch
from small_models import small_diffusion

import gesturekit as gk
from gesturekit.corpus import Item, Manifest

RECIPE = Path(__file__).resolve().parents[2] / "recipes" / "paper_tables"


@pytest.fixture
def run(monkeypatch, capsys, tmp_path):
    """run("lda_table3", argument, ...): the lines that a script prints, as lists of cells."""
    monkeypatch.syspath_prepend(RECIPE)
    monkeypatch.chdir(tmp_path)

    def call(script: str, *arguments: object) -> dict[str, list[str]]:
        importlib.import_module(script).main([str(argument) for argument in arguments])
        lines = capsys.readouterr().out.splitlines()
        rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines if "|" in line]
        return {row[0]: row[1:] for row in rows} | {"text": lines}

    return call


def test_the_designs_are_those_of_the_printed_table(run):
    rows = run("lda_table2")
    assert rows[""] == ["dance", "tsg", "zeroeggs", "zeroeggs_style"]
    assert rows["ordered pairs"] == ["12", "12", "6", "6"]
    assert rows["ordered pairs seen"] == ["3", "3", "6", "6"]
    assert rows["sound"] == ["music", "speech", "speech", "no"]


def test_merit_scores_and_win_rates_of_answers(run, tmp_path):
    """LDA beats SG clearly in three answers of four, and SG beats LDA slightly in one."""
    lines = ["user,input_code,model_a,model_b,winner,is_strong"]
    lines += [f"u{k},clip{k},LDA,SG,model_a,True" for k in range(3)]
    lines += ["u3,clip3,SG,LDA,model_a,False"]
    (tmp_path / "answers.csv").write_text("\n".join(lines))
    rows = run("lda_table3", f"TSG={tmp_path / 'answers.csv'}", "--rounds", 100)
    assert rows["LDA"][0].split()[0] == "1.5" and rows["SG"][0].split()[0] == "0.25"
    assert rows["SG"][1] == "25.0" and rows["LDA"][1] == "–" and rows["GT"] == ["–", "–"]


@pytest.fixture
def spoken(gesture, write_speech, tmp_path) -> Path:
    """A manifest with a recording of a window to test and one to train."""
    items = []
    for seed, (name, split) in enumerate((("a", "test"), ("b", "train"))):
        gesture(10.0, seed=seed).save(tmp_path / f"{name}.bvh")
        wav = write_speech(tmp_path / "wavs" / f"{name}.wav", 10.0)
        files = {"audio": wav, "motion": tmp_path / f"{name}.bvh"}
        items.append(Item(id=name, duration=10.0, split=split, style="happy", **files))
    Manifest(items).save(tmp_path / "corpus.jsonl")
    return tmp_path / "corpus.jsonl"


def test_missing_rows_say_why(run, tmp_path):
    text = " ".join(run("lda_table4", "--block", "dance", "dances.jsonl")["text"])
    assert "LDA-U (not given: train diffusion_speech/dance_unconditional" in text
    assert "BL (not given: sample Bailando" in text and "FGD (give --features)" in text


def test_joint_positions_become_a_motion_that_is_measured_as_the_recording(
    gesture, tmp_path, monkeypatch
):
    """The README's lines, as they are; rotations, of which there are none, are not compared."""
    monkeypatch.chdir(tmp_path)
    for folder in ("recordings", "FOLDER"):
        Path(folder).mkdir()
    text = (RECIPE / "README.md").read_text()
    lines = "\n".join(line.strip() for line in text.splitlines() if line.startswith("      "))
    for seed, name in enumerate("ab"):
        gesture(10.0, 60.0, seed=seed).save(f"recordings/{name}.bvh")
        recorded = gk.Motion.load(f"recordings/{name}.bvh")
        np.save(f"{name}.npy", recorded.positions().reshape(600, -1))
        exec(lines.replace("ID", name), {"gesturekit": gk, "numpy": np})
    found = gk.evaluate("FOLDER", "recordings", protocol="lda").to_json()["models"][0]["figures"]
    for name in ("jerk", "wrist_speed", "fid_k", "div_k"):
        assert found[name]["value"] == pytest.approx(found[name]["recording"], abs=5e-3), name


@pytest.mark.stress  # of seconds: the metrics of whole sets
def test_a_row_is_a_model(run, gesture, spoken, tmp_path):
    model = small_diffusion(gesture, styles=("still", "happy"))
    torch.nn.init.normal_(model.network.leave.weight, generator=torch.Generator().manual_seed(0))
    model.save(tmp_path / "run" / "model")
    (tmp_path / "run" / "config.yaml").write_text("longer: 0.5\ntraining: {updates: 1340}\n")
    labels = (f"{label}={tmp_path / 'run' / 'model'}" for label in ("LDA", "LDA-G"))
    rows = run("lda_table4", "--block", "ZeroEGGS", spoken, *labels, "--samples", 1)
    assert rows["ZeroEGGS"] == ["FGD", "FID_k", "FID_g", "Div_k", "Div_g", "BAS"]
    assert rows["LDA"] != rows["LDA-G"] and float(rows["GT"][5].split()[0]) > 0
    # 0.5 x 1340 of 67,000 updates.
    assert "LDA 1 % of the published schedule" in " ".join(rows["text"])


def test_wrist_speeds_over_gamma(run, gesture, spoken, tmp_path):
    small_diffusion(gesture, styles=("still", "happy")).save(tmp_path / "model")
    given = (tmp_path / "model", tmp_path / "wavs", "still", "happy")
    rows = run("lda_figure9", *given, "--samples", 1, "--seconds", 1)
    assert list(rows)[2:9] == ["-0.25", "0", "0.25", "0.5", "0.75", "1", "1.25"]
    assert all(np.diff([float(cell) for cell in rows["1"]]) > 0)
    assert (tmp_path / "out/figure9/figure9.png").stat().st_size > 1000
