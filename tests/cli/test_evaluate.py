"""gesturekit evaluate, as it is typed."""

import contextlib
import csv
import html
import json
import os
import re
import shutil
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import soundfile
import torch
from small_models import small_diffusion

from gesturekit.corpus import Item, Manifest, prepare
from gesturekit.jobs.records import STATE, write_items
from gesturekit.motion import Motion
from gesturekit.training.origin import TrainedSegment, save_sources


@pytest.fixture(scope="module")
def folders(tmp_path_factory, write_pair, gesture) -> Path:
    """Two recordings with sound, two folders of generated motion."""
    root = tmp_path_factory.mktemp("evaluate")
    for i in range(2):
        write_pair(root / "recordings", f"clip{i}", 2.0, fps=25.0, seed=i)
        for k, model in enumerate(("ours", "baseline"), start=1):
            gesture(2.0, 25.0, seed=10 * k + i).save(root / model / f"clip{i}.npz")
    return root


@pytest.fixture
def evaluate(gesturekit, folders):
    """evaluate(*options): the command, of the folder "ours" against the recordings."""
    own = ("evaluate", folders / "ours", folders / "recordings", "--workers", 1)
    return lambda *more: gesturekit(*own, *more)


def test_it_prints_a_table_and_writes_report_and_json(evaluate, folders, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["/bin/gesturekit", "evaluate", "my clips"])
    tmp_path /= "new/folder"
    files = ("--out", tmp_path / "r.html", "--json", tmp_path / "r.json")
    given = ("--audio", folders / "recordings", "--compare", folders / "baseline")
    said = evaluate(*given, *files, "--baseline", "mean_pose").ok().out
    labels = ["ours", "baseline", "mean_pose"]
    assert any({*labels, "recording"} <= set(line.split()) for line in said.splitlines())
    assert "Reach" in said and "Sync" in said
    found = json.loads((tmp_path / "r.json").read_text())
    assert [model["label"] for model in found["models"]] == labels
    page = html.unescape((tmp_path / "r.html").read_text())
    assert "gesturekit evaluate 'my clips'" in page, "the command that made it"
    for model in found["models"]:
        assert model["verdict"] in said and model["verdict"] in page
    assert str(tmp_path / "r.json") in said and str(tmp_path / "r.html") in said
    assert "6 clips" in said


def test_ratings_of_a_study_are_compared_with_the_metrics(evaluate, folders, tmp_path):
    levels = {"ours": 60, "baseline": 30, "recording": 70, "mean_pose": 4, "other_lab": 50}
    lines = [
        f"p{r},{name},c{c},human-like,{level + r + c % 2}"
        for r in range(5)
        for c in range(4)
        for name, level in levels.items()
    ]
    ratings = tmp_path / "ratings.csv"
    ratings.write_text("\n".join(["participant,condition,stimulus,question,rating", *lines]))
    given = ("--compare", folders / "baseline", "--baseline", "mean_pose", "--study", ratings)
    done = evaluate(*given, "--json", tmp_path / "r.json").ok()
    assert "other_lab" in done.err and "raters left out" not in done.out + done.err
    for fact in ("5 raters", "4 clips", "80 ratings", "on human-like", "4 systems", "too few"):
        assert fact in done.out
    (question,) = json.loads((tmp_path / "r.json").read_text())["agreement"]["questions"]
    # The mean of 60, 30, 70 and 4 is 41.
    scores = {"recording": 29, "ours": 19, "baseline": -11, "mean_pose": -37}
    assert (question["question"], question["scores"]) == ("human-like", pytest.approx(scores))
    for rest, *says in (
        ("p,ours,c,1\np,baseline,c,good\n", "ratings.csv", "3", "'good'"),
        ("p,ours,c,1\np,baseline,c,3\n", "2", "ours", "baseline"),
    ):
        ratings.write_text(f"rater,system,clip,value\n{rest}")
        evaluate(*given).fails(2, *says)


def test_the_help_shows_which_definition_is_the_default(gesturekit):
    said = " ".join(gesturekit("evaluate", "--help-all").ok().out.split())
    defaults = {"variant": "ganimator", "bas": "seconds", "kinetic": "corrected"}
    for option, default in defaults.items():
        assert re.search(rf"--{option} \[[^]]*\] [^[]*\[default: {default}\]", said), option


def test_clips_that_are_left_out_make_it_exit_1(gesturekit, folders, tmp_path):
    made = tmp_path / "made"
    made.mkdir()
    (made / "clip0.npz").write_bytes((folders / "ours" / "clip0.npz").read_bytes())
    (made / "clip1.npz").write_bytes(b"no npz")
    done = gesturekit("evaluate", made, folders / "recordings")
    done.fails(1, "clip1.npz")
    assert "Arm speed" in done.out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["absent", "recordings"], "absent"),
        (["ours", "recordings", "baseline"], "--compare baseline"),
        (["a=ours", "recordings", "--compare", "a=baseline"], " a\n"),
        (["ours", "recordings", "--baseline", "retrival"], "retrieval"),
        (["ours", "recordings", "--baseline", "retrieval"], "--corpus"),
        (["ours", "recordings", "--out", "report.pdf"], ".html"),
        (["ours", "recordings", "--kinetic", "both"], "'corrected', 'released'"),
        (["ours", "recordings", "--out", "ours/clip0.npz/report.html"], "clip0.npz/report.html"),
        (["ours", "recordings", "--audio", "ours"], "ours"),
        (["demo", "recordings"], "gesturekit render"),
        (["demo", "recordings", "--protocol", "lda"], "--audio"),
        (["--sanity", "recordings", "ours"], "--sanity"),
        (["--sanity", "recordings", "--body", "human"], "--body"),
    ],
)
def test_usage_errors_are_a_line_and_exit_code_2(gesturekit, folders, monkeypatch, arguments, said):
    monkeypatch.chdir(folders)
    (folders / "empty").mkdir(exist_ok=True)
    done = gesturekit("evaluate", *arguments).fails(2, said)
    assert not done.out


@pytest.mark.parametrize(
    ("protocol", "names", "measure"),
    [
        ("multires", ["clip0_s1", "clip0_s2", "clip1_s1", "clip1_s2"], "coverage"),
        pytest.param(
            *("lda", [f"clip{i}_w000_s{k}" for i in range(2) for k in (1, 2)], "fid_k"),
            marks=pytest.mark.stress,
        ),
    ],
)
def test_protocols_sample_models(gesturekit, model, write_pair, tmp_path, protocol, names, measure):
    recordings, folder = tmp_path / "recordings", ("--samples-dir", tmp_path / "samples")
    for i in range(2):
        write_pair(recordings, f"clip{i}", 12.0 if protocol == "lda" else 3.0, seed=i)
    sample = ("evaluate", model, recordings, "--protocol", protocol, "--audio", recordings, *folder)
    gesturekit(*sample, "--samples", 2, "--json", tmp_path / "r.json").ok()
    written = sorted(path.stem for path in (tmp_path / "samples" / "model").iterdir())
    assert written == names
    (found,) = json.loads((tmp_path / "r.json").read_text())["models"]
    assert measure in found["figures"]
    seconds = {round(clip["seconds"], 2) for clip in found["clips"]}
    assert seconds == ({10.0} if protocol == "lda" else {6.0})
    gesturekit(*sample, "--samples", 1).fails(2, str(folder[1]))


def test_a_protocol_samples_the_items_of_a_manifest(gesturekit, model, write_pair, tmp_path):
    items = []
    for name, split, seconds in (("talk", "test", 10.5), ("walk", "train", 3.0)):
        audio, motion = write_pair(tmp_path / "recordings", name, seconds, fps=25.0)
        items.append(Item(id=name, audio=audio, motion=motion, duration=seconds, split=split))
    Manifest(items).save(tmp_path / "corpus.jsonl")
    about = ["--corpus", tmp_path / "corpus.jsonl", "--samples", 1, "--json", tmp_path / "r.json"]
    for protocol, clip in (("multires", "walk_s1"), ("lda", "talk_w000_s1")):
        sampling = ("--protocol", protocol, "--samples-dir", tmp_path / protocol)
        gesturekit("evaluate", model, *about, *sampling).ok()
        (found,) = json.loads((tmp_path / "r.json").read_text())["models"]
        assert [clip["name"] for clip in found["clips"]] == [clip]


def test_a_protocol_takes_the_controls_of_the_models_that_it_samples(
    gesturekit, gesture, write_pair, tmp_path
):
    model = replace(small_diffusion(gesture), droppable=("all",))
    torch.nn.init.normal_(model.network.leave.weight, std=0.1)  # 0 until it is trained
    model.save(tmp_path / "lda")
    audio, _ = write_pair(tmp_path / "real", "talk", 10.0, fps=30.0)
    about = [tmp_path / "real", "--protocol", "lda", "--audio", tmp_path / "real", "--samples", 1]
    flags = ("--no-raw", "--expert", f"{tmp_path / 'lda'}:0.3", "--guidance", 1.5)
    out = tmp_path / "out"
    gesturekit("evaluate", tmp_path / "lda", *about, "--samples-dir", out, *flags).ok()
    made = Motion.load(out / "lda" / "talk_w000_s1.npz")
    controls = {"experts": [(model, 0.3)], "guidance": 1.5}
    wanted = model.generate(audio, item="talk_w000_s1", **controls)
    assert made.positions() == pytest.approx(wanted.positions(), abs=1e-6)
    gesturekit("evaluate", out / "lda", *about, "--guidance", 1.5).fails(2, "--guidance")
    gesturekit("evaluate", "demo", *about, "--guidance", 1.5).fails(2, "guidance", "multires")


@pytest.fixture(scope="module")
def held_out(tmp_path_factory, write_pair, gesture):
    """A manifest of one recording, cut in two, and clips for both items."""
    root = tmp_path_factory.mktemp("held_out")
    write_pair(root / "recordings" / "day", "talk", 10.0, fps=25.0)
    prepare([root / "recordings"], root / "corpus.jsonl")
    items = {item.split: item for item in Manifest.load(root / "corpus.jsonl")}
    for item in items.values():
        gesture(item.duration, 25.0, seed=5).save(root / "rendered" / f"{item.id}.bvh")
    return root, items


def test_held_out_items_are_cut_as_the_manifest_says(gesturekit, held_out, tmp_path):
    root, items = held_out
    test = items["test"]
    measured = ("evaluate", root / "rendered", "--corpus", root / "corpus.jsonl")
    done = gesturekit(*measured, "--json", tmp_path / "r.json").ok()
    assert re.search(r"(?=.*\btalk\b)(?=.*1 of 1)", done.err), "the take that is trained on too"
    found = json.loads((tmp_path / "r.json").read_text())
    assert found["settings"]["split"] == "test"
    ((clip,),) = (model["clips"] for model in found["models"])
    assert clip["recording"] == test.id and "sync" in clip["figures"]
    # The same figures as with the stretch cut out by hand.
    test.load_motion().save(tmp_path / "cut" / "talk.npz")
    wave = test.load_wave()
    soundfile.write(tmp_path / "cut" / "talk.wav", wave.samples, wave.sample_rate, "FLOAT")
    cut = (root / "rendered" / f"{test.id}.bvh", tmp_path / "cut" / "talk.npz")
    files = ("--audio", tmp_path / "cut", "--json", tmp_path / "hand.json")
    gesturekit("evaluate", *cut, *files).ok()
    ((other,),) = (m["clips"] for m in json.loads((tmp_path / "hand.json").read_text())["models"])
    # Those that compare with the training split, which a folder has not, differ.
    own, by_hand = (
        {k: v for k, v in found["figures"].items() if "copying" not in k and k != "novelty"}
        for found in (clip, other)
    )
    assert by_hand == pytest.approx(own, rel=1e-4, abs=1e-4)


def test_files_cut_from_a_take_are_one_unit(gesturekit, gesture, tmp_path):
    for k in range(4):
        for seed, folder in ((k, "recorded"), (9 + k, "made")):
            gesture(2.0, 25.0, seed=seed).save(tmp_path / folder / f"day{k % 2}_part{k}.npz")
    folders = (tmp_path / "made", tmp_path / "recorded")
    measured = ("evaluate", *folders, "--json", tmp_path / "r.json", "--workers", 1)
    gesturekit(*measured, "--take-pattern", "(.*)_part").ok()
    (model,) = json.loads((tmp_path / "r.json").read_text())["models"]
    speed = model["figures"]["wrist_speed"]
    assert speed["value"] is not None and speed["low"] is None, "two takes give no interval"
    assert model["figures"]["likeness"]["ceiling"]["pieces"], "two takes are no disjoint sets"


@pytest.mark.stress
def test_retrieval_and_speech_blind_are_compared(gesturekit, model, held_out, tmp_path):
    root, items = held_out
    about = ["--corpus", root / "corpus.jsonl"]
    gesturekit("render", *about, "--split", "test", "--model", model, "--out", tmp_path / "m").ok()
    baselines = ("--baseline", "speech_blind,mean_pose,retrieval", "--json", tmp_path / "r.json")
    baselines += ("--workers", 1)
    gesturekit("evaluate", tmp_path / "m", *about, *baselines).ok()
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["settings"]["baselines"] == ["speech_blind", "mean_pose", "retrieval"]
    found = {m["label"]: m for m in report["models"]}
    assert found.keys() == {"m", "retrieval", "speech_blind", "mean_pose"}
    (own,), (blind,), (pieces,) = (found[m]["clips"] for m in ("m", "speech_blind", "retrieval"))
    assert own["recording"] == blind["recording"] == pieces["recording"] == items["test"].id
    # The same model, another motion; pieces come from the training split, as their rig does.
    assert blind["figures"]["wrist_speed"] != own["figures"]["wrist_speed"]
    assert pieces["figures"]["wrist_speed"] > 0


def test_evaluating_on_training_recordings_is_warned_about(gesturekit, held_out, tmp_path):
    root, items = held_out
    model, rendered = tmp_path / "model", tmp_path / "rendered"
    model.mkdir()
    save_sources(model, [TrainedSegment.of(items["train"], items["train"].load_motion().fps)])
    rendered.mkdir()
    shutil.copy(root / "recordings" / "day" / "talk.bvh", rendered)
    write_items(rendered / STATE, ["talk"], 1, {"model_folder": str(model)})
    done = gesturekit("evaluate", rendered, root / "recordings")
    assert re.search("(?=.*1 of 1)(?=.*day/talk)", done.err)
    assert re.search("(?=.*rendered)(?=.*trained)", done.out)
    shutil.rmtree(rendered / STATE)
    assert "day/talk" not in gesturekit("evaluate", rendered, root / "recordings").err


def test_an_item_without_a_clip_is_left_out(gesturekit, held_out, tmp_path):
    root, _ = held_out
    corpus = ("--corpus", root / "corpus.jsonl")
    done = gesturekit("evaluate", root / "rendered" / "day", *corpus, "--split", "valid")
    assert re.search(r"(?=.*\bvalid\b)(?=.*\btest\b)(?=.*\btrain\b)", done.fails(2).err)
    (tmp_path / "other.npz").write_bytes(b"")
    gesturekit("evaluate", tmp_path, *corpus).fails(2, "other")
    blind = ("--baseline", "speech_blind")
    done = gesturekit("evaluate", root / "rendered", *corpus, *blind)
    done.fails(2, "gesturekit render")


def test_tables_have_a_line_for_each_metric_and_stable_columns(gesturekit, folders, tmp_path):
    gesturekit(
        *("evaluate", f"a_1={folders / 'ours'}", folders / "recordings", "--workers", 1),
        *("--compare", f"50% <b>={folders / 'baseline'}", "--csv", tmp_path / "t.csv"),
        *("--markdown", tmp_path / "t.md", "--latex", tmp_path / "t.tex"),
        *("--json", tmp_path / "r.json"),
    ).ok()
    found = json.loads((tmp_path / "r.json").read_text())
    with (tmp_path / "t.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {"name", "group", "unit", "better"} <= rows[0].keys()
    for model in found["models"]:
        values = {row["key"]: float(row["value"]) for row in rows if row["model"] == model["label"]}
        assert values == {key: result["value"] for key, result in model["figures"].items()}
    latex = (tmp_path / "t.tex").read_text()
    assert r"a\_1" in latex and r"50\% <b>" in latex and r"\end{tabular}" in latex
    markdown = (tmp_path / "t.md").read_text().splitlines()
    assert r"a\_1" in markdown[0] and r"50% \<b\>" in markdown[0]
    assert len({line.count("|") for line in markdown if line.startswith("| ")}) == 1


def test_clips_that_are_not_meant_to_be_measured_are_noted_and_leave_exit_code_0(
    gesturekit, write_pair, write_speech, gesture, tmp_path
):
    write_speech(tmp_path / "speech.wav", 2.0)
    items = [Item(id="alone", audio=tmp_path / "speech.wav", motion=None, duration=2.0)]
    for name in ("a", "b"):
        audio, motion = write_pair(tmp_path / "recordings", name, 3.0, fps=25.0)
        items.append(Item(id=name, audio=audio, motion=motion, duration=3.0))
    Manifest([replace(item, split="train" if item.id == "b" else "test") for item in items]).save(
        corpus := tmp_path / "corpus.jsonl"
    )
    for name in ("a", "b", "alone"):
        gesture(3.0, 25.0, seed=9).save(tmp_path / "made" / f"{name}.npz")
    done = gesturekit("evaluate", tmp_path / "made", "--corpus", corpus).ok()
    assert re.search(rf"(?=.*1 clip)(?=.*{corpus})(?=.*alone)", done.err)
    assert re.search(rf"(?=.*1 clip)(?=.*train)(?=.*{corpus})(?=.* b\b)", done.err)
    gesture(3.0, 25.0).save(tmp_path / "made" / "nobody.npz")
    gesturekit("evaluate", tmp_path / "made", corpus).fails(1, "nobody")  # as REFERENCE


@pytest.fixture
def closed_pipe(monkeypatch) -> Iterator[None]:
    """Standard output is a pipe whose reader has left: gesturekit ... | head."""
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as out:
        monkeypatch.setattr(sys, "stdout", out)
        yield
        monkeypatch.undo()
        with contextlib.suppress(BrokenPipeError):
            out.close()


def test_results_are_written_whoever_reads_the_output(evaluate, tmp_path, closed_pipe):
    files = [tmp_path / f"e.{kind}" for kind in ("json", "csv")]
    assert "Traceback" not in evaluate("--json", files[0], "--csv", files[1]).err
    assert all(file.stat().st_size > 0 for file in files)


def test_sanity_prints_its_table_and_names_what_it_left_out(gesturekit, write_pair, tmp_path):
    recordings, page = tmp_path / "talks", tmp_path / "report.html"
    for name in ("one", "two", "mute"):
        write_pair(recordings, name, 3.0, fps=25.0)
    (recordings / "mute.wav").write_bytes(b"RIFF")
    done = gesturekit("evaluate", "--sanity", recordings, "--out", page, "--workers", 1)
    done.fails(1, "Left out: mute")
    assert "half reach" in done.out and "half reach" in page.read_text()
    assert "<title>Known-bad motion made from" in page.read_text()
    assert f"written  {page}" in done.out
