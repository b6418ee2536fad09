"""gesturekit evaluate, as it is typed."""

from __future__ import annotations

import contextlib
import csv
import html
import json
import os
import re
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch
from rigs import rig_of
from scipy.spatial.transform import Rotation
from small_models import small_diffusion
from tqdm.utils import disp_len

from gesturekit.corpus import Item, Manifest, prepare
from gesturekit.errors import EvaluationError
from gesturekit.evaluation import Variants
from gesturekit.motion import Motion
from gesturekit.motion.rotations import (
    quaternion_from_rotation_vector,
    rotation_vector_from_quaternion,
)
from gesturekit.training.data.sources import TrainedSegment, save_sources


@pytest.fixture(scope="module")
def folders(tmp_path_factory, write_pair, gesture) -> Path:
    """Three recordings with sound, two folders of generated motion."""
    root = tmp_path_factory.mktemp("evaluate")
    for i in range(3):
        write_pair(root / "recordings", f"clip{i}", 3.0, fps=25.0, seed=i)
        for k, model in enumerate(("ours", "baseline"), start=1):
            gesture(3.0, 25.0, seed=10 * k + i).save(root / model / f"clip{i}.npz")
    return root


@pytest.fixture
def evaluate(gesturekit, folders):
    """evaluate(*options): the command, of the folder "ours" against the recordings."""
    return lambda *more: gesturekit("evaluate", folders / "ours", folders / "recordings", *more)


def test_it_prints_a_table_and_writes_report_and_json(evaluate, folders, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["/bin/gesturekit", "evaluate", "my clips"])
    tmp_path /= "new/folder"
    files = ("--out", tmp_path / "r.html", "--json", tmp_path / "r.json")
    given = ("--audio", folders / "recordings", "--compare", folders / "baseline")
    done = evaluate(*given, *files).ok()
    lines = done.out.splitlines()
    assert lines[0].startswith("ours: ") and lines[1].startswith("baseline: ")
    assert "In time with the speech?" in lines[2] and "Is it new?" in lines[7]
    assert lines[8].split() == ["ours", "baseline", "recording", "chance"]
    assert lines[9] == "Headline:" and "Speech:" in lines
    assert any(re.match(r"  Reach, m  +0\.\d+  .*0\.\d+$", line) for line in lines)
    assert any(re.match(r"  Sync  .*(not informative).*  0\.\d+$", line) for line in lines)
    found = json.loads((tmp_path / "r.json").read_text())
    assert [model["label"] for model in found["models"]] == ["ours", "baseline"]
    page = (tmp_path / "r.html").read_text()
    assert "ours, baseline against recordings" in page
    assert "gesturekit evaluate &#x27;my clips&#x27;" in page, "the command that made it"
    for line, model in zip(lines, found["models"]):
        assert line == f"{model['label']}: {model['verdict']}"
        assert html.escape(line) in page
    assert lines[-3:-1] == [f"written  {tmp_path / name}" for name in ("r.json", "r.html")]


def test_every_option_reaches_the_evaluation(evaluate, folders, monkeypatch):
    asked = {}

    def started(models, recordings, **options):
        asked.update(options)
        raise EvaluationError("that is enough")

    monkeypatch.setattr("gesturekit.evaluation.evaluate", started)
    sound, words = folders / "recordings", folders / "words"
    chosen = ("--audio", sound, "--semantic", words, "--take-pattern", "(.*)", "--seed", 3)
    variants = ("--variant", "paper", "--threshold", 3, "--bas", "bailando", "--workers", 2)
    variants += ("--kinetic", "released")
    evaluate(*chosen, *variants, "--baseline", "mean_pose").fails(2, "that is enough")
    assert (asked["audio"], asked["semantic"], asked["take_pattern"]) == (sound, words, "(.*)")
    assert asked["variants"] == Variants("paper", 3.0, "bailando", "released")
    assert (asked["seed"], asked["workers"], asked["baselines"]) == (3, 2, ["mean_pose"])
    assert (asked["protocol"], asked["features"]) == ("", None)
    evaluate("--protocol", "lda", "--audio", sound).fails(2, "that is enough")
    assert (asked["protocol"], asked["workers"]) == ("lda", os.cpu_count())


def test_baselines_are_columns_of_the_table(evaluate):
    done = evaluate("--baseline", "mean_pose, other_utterance").ok()
    lines = done.out.splitlines()
    assert lines[12].split() == ["ours", "mean_pose", "other_utterance", "recording", "chance"]
    assert "9 clips measured, 0 left out" in lines[-1]


def test_ratings_of_a_study_are_compared_with_the_metrics(evaluate, folders, tmp_path):
    lines = [
        f"p{r},{name},c{c},{question},{level + r + c % 2}"
        for r in range(5) for c in range(4) for question in ("human-like", "appropriate")
        for name, level in (("ours", 60), ("baseline", 30), ("recording", 70), ("mean_pose", 5),
                            ("other_lab", 50))
    ]  # fmt: skip
    ratings, files = tmp_path / "ratings.csv", ("--out", tmp_path / "r.html")
    ratings.write_text("\n".join(["participant,condition,stimulus,question,rating", *lines]))
    given = ("--compare", folders / "baseline", "--baseline", "mean_pose", "--study", ratings)
    done = evaluate(*given, *files, "--json", tmp_path / "r.json").ok()
    assert "left out, as they were in the study and not evaluated: other_lab" in done.err
    assert "Agreement with people on human-like: 5 raters, 4 clips, 80 ratings." in done.out
    assert (
        "People's scores: recording +28.8, ours +18.8, baseline -11.2, mean_pose -36.2" in done.out
    )
    assert "too few systems: any order may be chance" in done.out
    found = json.loads((tmp_path / "r.json").read_text())["agreement"]
    assert [one["question"] for one in found["questions"]] == ["human-like", "appropriate"]
    assert {one["n"] for one in found["questions"][0]["metrics"]} == {3, 4}
    page = (tmp_path / "r.html").read_text()
    assert "Agreement with people" in page and "other_lab" in page
    ratings.write_text("rater,system,clip,value\np,ours,c,1\np,baseline,c,good\n")
    evaluate(*given, *files).fails(2, "ratings.csv, line 3: value is 'good'")
    ratings.write_text("rater,system,clip,value\np,ours,c,1\np,baseline,c,3\n")
    evaluate(*given, *files).fails(2, "2 in common, and a correlation needs 3")


def test_clips_that_are_left_out_make_it_exit_1(gesturekit, folders, tmp_path):
    made = tmp_path / "made"
    made.mkdir()
    (made / "clip0.npz").write_bytes((folders / "ours" / "clip0.npz").read_bytes())
    (made / "clip1.npz").write_bytes(b"no npz")
    done = gesturekit("evaluate", made, folders / "recordings")
    done.fails(1, "Left out: made: clip1: clip: ", "clip1.npz")
    assert "Arm speed, rad/s" in done.out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["absent", "recordings"], "absent: no such file or folder"),
        (["ours", "empty"], "empty: no motion files"),
        (["ours", "recordings", "baseline"], "such as --compare baseline"),
        (["ours", "recordings", "--compare", "baseline", "b c"], "--compare 'b c'"),
        (["a=ours", "recordings", "--compare", "a=baseline"], "two models are named a"),
        (["ours", "recordings", "--baseline", "median"], "it is one of mean_pose, other"),
        (["ours", "recordings", "--baseline", "retrival"], "did you mean retrieval?"),
        (["ours", "recordings", "--baseline", "retrieval"], "retrieval needs --corpus"),
        (["ours", "recordings", "--out", "report.pdf"], "name it .html"),
        (["ours", "recordings", "--compare", "ours"], "is given twice"),
        (["ours", "recordings", "--audio", "ours"], "no sound files"),
        (["ours", "recordings", "--features", "ours"], "ours"),
        (["demo", "recordings"], "demo is a model"),
        (["made", "recordings", "--out", "recordings/clip0.bvh/r.html"], "cannot be written"),
        (["ours", "recordings", "--json", "/proc/r.json"], "/proc/r.json cannot be written"),
        (["demo", "recordings", "--protocol", "lda"], "give --audio"),
        (["--sanity", "recordings", "ours"], "only a folder of recordings"),
        (["--sanity", "empty"], "empty: no motion files"),
        (["--sanity", "recordings", "--body", "human"], "does not use --body; leave it out"),
        (["--sanity", "recordings", "--csv", "t.csv"], "does not use --csv; leave it out"),
    ],
)
def test_usage_errors_are_a_line_and_exit_code_2(gesturekit, folders, monkeypatch, arguments, said):
    monkeypatch.chdir(folders)
    (folders / "empty").mkdir(exist_ok=True)
    done = gesturekit("evaluate", *arguments).fails(2, said)
    assert "Traceback" not in done.err and not done.out


@pytest.mark.parametrize(
    ("protocol", "names", "measure"),
    [
        ("multires", ["clip0_s1", "clip0_s2", "clip1_s1", "clip1_s2"], "coverage"),
        ("lda", ["clip0_w000_s1", "clip0_w000_s2", "clip1_w000_s1", "clip1_w000_s2"], "fid_k"),
    ],
)
def test_protocols_sample_models(gesturekit, model, write_pair, tmp_path, protocol, names, measure):
    for i in range(2):
        write_pair(tmp_path / "recordings", f"clip{i}", 12.0 if protocol == "lda" else 3.0, seed=i)
    recordings, folder = tmp_path / "recordings", ("--samples-dir", tmp_path / "samples")
    sample = ("evaluate", model, recordings, "--protocol", protocol, "--audio", recordings, *folder)
    done = gesturekit(*sample, "--samples", 2, "--json", tmp_path / "r.json").ok()
    written = sorted(path.stem for path in (tmp_path / "samples" / "model").iterdir())
    assert written == names
    (found,) = json.loads((tmp_path / "r.json").read_text())["models"]
    assert measure in found["figures"]
    seconds = {round(clip["seconds"], 2) for clip in found["clips"]}
    assert seconds == ({10.0} if protocol == "lda" else {6.0})
    assert "the protocol takes" in done.err
    gesturekit(*sample, "--samples", 1).fails(2, "samples of an earlier run")


def test_a_protocol_samples_the_items_of_a_manifest(gesturekit, model, write_pair, tmp_path):
    items = []
    for name, split in (("talk", "test"), ("walk", "train")):
        audio, motion = write_pair(tmp_path / "recordings", name, 11.0, fps=25.0)
        items.append(Item(id=name, audio=audio, motion=motion, duration=11.0, split=split))
    Manifest(items).save(tmp_path / "corpus.jsonl")
    about = ["--corpus", tmp_path / "corpus.jsonl", "--samples", 1, "--json", tmp_path / "r.json"]
    for protocol, clip, more in (
        ("multires", "walk_s1", []),
        ("lda", "talk_w000_s1", []),
        ("lda", "walk_w000_s1", ["--split", "train", "--bas", "bailando"]),
    ):
        sampling = ("--protocol", protocol, "--samples-dir", tmp_path / f"samples {clip}", *more)
        done = gesturekit("evaluate", model, *about, *sampling).ok()
        found = json.loads((tmp_path / "r.json").read_text())
        assert [c["name"] for m in found["models"] for c in m["clips"]] == [clip]
        assert found["settings"]["variants"]["bas"] == ("bailando" if more else "seconds")
        if protocol == "multires":  # it has no Fréchet distances that could be left out
            assert "Left out" not in done.err


def test_a_protocol_takes_the_controls_of_the_models_that_it_samples(
    gesturekit, gesture, write_pair, tmp_path
):
    model = replace(small_diffusion(gesture), droppable=("all",))
    torch.nn.init.normal_(model.network.leave.weight, std=0.1)  # 0 until it is trained
    model.save(tmp_path / "lda")
    audio, motion = write_pair(tmp_path / "real", "talk", 10.0, fps=30.0)
    about = [tmp_path / "real", "--protocol", "lda", "--audio", tmp_path / "real", "--samples", 1]
    for name, flags, controls in (
        ("raw", [], {"raw": True}),
        ("guided", ["--guidance", 1.5], {"raw": True, "guidance": 1.5}),
        ("usual", ["--no-raw", "--expert", f"{tmp_path / 'lda'}:0.3"], {"experts": [(model, 0.3)]}),
    ):
        out = tmp_path / name
        gesturekit("evaluate", tmp_path / "lda", *about, "--samples-dir", out, *flags).ok()
        made = Motion.load(out / "lda" / "talk_w000_s1.npz")
        wanted = model.generate(audio, item="talk_w000_s1", **controls)
        assert made.positions() == pytest.approx(wanted.positions(), abs=1e-6), name
    for rest in (about, about[:1]):
        done = gesturekit("evaluate", tmp_path / "raw" / "lda", *rest, "--guidance", 1.5)
        done.fails(2, "--guidance", "--protocol", "gesturekit render")
    done = gesturekit("evaluate", "demo", *about, "--guidance", 1.5).fails(
        2, "multires models have"
    )


def test_a_model_with_styles_is_not_sampled_for_recordings_of_unknown_style(
    gesturekit, corpus, write_pair, tiny, tmp_path
):
    styled = [replace(item, style="calm", split="train") for item in Manifest.load(corpus)]
    Manifest(styled).save(tmp_path / "corpus.jsonl")
    files = (f"corpus={tmp_path / 'corpus.jsonl'}", f"out={tmp_path / 'run'}")
    gesturekit("train", "multires_labels", *tiny, "noise_levels=6", *files).ok()
    write_pair(tmp_path / "recordings", "clip", 3.0)
    about = ["--protocol", "multires", "--samples", 1, "--samples-dir", tmp_path / "samples"]
    done = gesturekit("evaluate", tmp_path / "run" / "model", tmp_path / "recordings", *about)
    done.fails(2, "style None of clip: the model has calm", "--corpus")
    assert not (tmp_path / "samples").exists()


@pytest.fixture(scope="module")
def held_out(tmp_path_factory, write_pair, gesture):
    """A manifest of one recording, cut in two, and clips for both items."""
    root = tmp_path_factory.mktemp("held_out")
    write_pair(root / "recordings" / "day", "talk", 20.0, fps=25.0)
    prepare([root / "recordings"], root / "corpus.jsonl")
    items = {item.split: item for item in Manifest.load(root / "corpus.jsonl")}
    for item in items.values():
        gesture(item.duration, 25.0, seed=5).save(root / "rendered" / f"{item.id}.bvh")
    return root, items


def test_held_out_items_are_cut_as_the_manifest_says(gesturekit, held_out, tmp_path):
    root, items = held_out
    test = items["test"]
    files = ("--json", tmp_path / "r.json", "--out", tmp_path / "r.html")
    measured = ("evaluate", root / "rendered", "--corpus", root / "corpus.jsonl")
    done = gesturekit(*measured, *files).ok()
    assert "trained on" not in done.err and "from 1 take: no intervals" in done.err
    assert f"1 clip measured, 0 left out; all of it in {tmp_path / 'r.html'}" in done.out
    beside = "held-out items with neighbours in training, of the same take (talk): 1 of 1."
    assert beside in done.err and beside in (tmp_path / "r.html").read_text(encoding="utf-8")
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
        {k: v for k, v in found["figures"].items() if k not in ("copying", "novelty")}
        for found in (clip, other)
    )
    assert by_hand == pytest.approx(own, rel=1e-4, abs=1e-4)


def test_files_cut_from_a_take_are_one_unit(gesturekit, gesture, tmp_path):
    """Six pieces of two takes give no interval; six takes do."""
    for k in range(6):
        gesture(2.0, 25.0, seed=k).save(tmp_path / "recorded" / f"day{k % 2}_part{k}.npz")
        gesture(2.0, 25.0, seed=9 + k).save(tmp_path / "made" / f"day{k % 2}_part{k}.npz")
    found = {}
    for name, more in {"files": (), "takes": ("--take-pattern", "(.*)_part")}.items():
        done = gesturekit(
            "evaluate", tmp_path / "made", tmp_path / "recorded", *more,
            "--json", tmp_path / f"{name}.json",
        )  # fmt: skip
        assert done.status == 0, done.err
        (model,) = json.loads((tmp_path / f"{name}.json").read_text())["models"]
        found[name] = model["figures"]["wrist_speed"], model["figures"]["likeness"]
    (files, _), (takes, likeness) = found["files"], found["takes"]
    assert files["low"] < files["value"] < files["high"]
    assert takes["low"] is None and takes["value"] is not None
    assert likeness["ceiling"]["n"] == 2, "each take against the other"


def test_retrieval_and_speech_blind_are_compared(gesturekit, held_out, tmp_path):
    root, items = held_out
    about = ["--corpus", root / "corpus.jsonl"]
    gesturekit("render", *about, "--split", "test", "--model", "demo", "--out", tmp_path / "m").ok()
    baselines = ("--baseline", "speech_blind,mean_pose,retrieval", "--json", tmp_path / "r.json")
    gesturekit("evaluate", tmp_path / "m", *about, *baselines).ok()
    found = {m["label"]: m for m in json.loads((tmp_path / "r.json").read_text())["models"]}
    assert [*found] == ["m", "retrieval", "speech_blind", "mean_pose"]
    (own,), (blind,), (pieces,) = (found[m]["clips"] for m in ("m", "speech_blind", "retrieval"))
    assert own["recording"] == blind["recording"] == pieces["recording"] == items["test"].id
    # The same model, another motion; pieces come from the training split, as their rig does.
    assert blind["figures"]["wrist_speed"] != own["figures"]["wrist_speed"]
    assert pieces["figures"]["wrist_speed"] > 0


def test_speech_blind_needs_a_folder_written_by_render(gesturekit, held_out):
    root, _ = held_out
    about = ("--corpus", root / "corpus.jsonl", "--baseline", "speech_blind")
    done = gesturekit("evaluate", root / "rendered", *about)
    assert done.status == 2 and "only known for folders written by gesturekit render" in done.err


def test_evaluating_on_training_recordings_is_warned_about(gesturekit, held_out, tmp_path):
    root, items = held_out
    train = ("evaluate", root / "rendered", "--corpus", root / "corpus.jsonl", "--split", "train")
    assert "trained on" not in gesturekit(*train).ok().err  # the manifest's split is no evidence
    # A folder of whole recordings, rendered by a model that says what it was trained on.
    model, rendered = tmp_path / "model", tmp_path / "rendered"
    model.mkdir()
    save_sources(model, [TrainedSegment.of(items["train"], items["train"].load_motion().fps)])
    rendered.mkdir()
    whole = (root / "recordings" / "day" / "talk.bvh").read_bytes()
    (rendered / "talk.bvh").write_bytes(whole)
    journal = rendered / ".gesturekit" / "journal" / "00001-of-00001.jsonl"
    journal.parent.mkdir(parents=True)
    run = {"run": "a", "settings": {}, "format": 1, "time": 1.0, "model_folder": str(model)}
    journal.write_text(json.dumps(run) + "\n")
    done = gesturekit("evaluate", rendered, root / "recordings")
    assert "trained on 1 of 1 recording, or on a part of each (day/talk)" in done.err
    assert "rendered (trained on these)" in done.out
    journal.unlink()
    assert "trained on" not in gesturekit("evaluate", rendered, root / "recordings").err


def test_an_item_without_a_clip_is_left_out(gesturekit, held_out, tmp_path):
    root, items = held_out
    corpus = ("--corpus", root / "corpus.jsonl")
    done = gesturekit("evaluate", root / "rendered" / "day", *corpus, "--split", "valid")
    assert done.status == 2 and "no item is in split valid (1 in test, 1 in train)" in done.err
    made = tmp_path / "made"
    made.mkdir()
    (made / "other.npz").write_bytes(b"")
    gesturekit("evaluate", made, *corpus).fails(2, "of 1 clip (other) none has a recording")
    gesturekit("evaluate", made, root / "recordings", *corpus).fails(2, "with its own --compare")
    folders = (root / "rendered" / "day", root / "recordings")
    gesturekit("evaluate", *folders).fails(2, "items of a manifest: --corpus")


def test_a_rig_without_limbs_gets_one_line_of_what_was_left_out(gesturekit, tmp_path):
    snake = rig_of({f"seg{i}": (f"seg{i - 1}" if i else None, (0, 0, 0.3)) for i in range(6)})
    for folder, seed in (("recordings", 0), ("made", 1)):
        angles = np.random.default_rng(seed).normal(0, 0.02, (150, 6, 3)).cumsum(axis=0)
        rotations = Rotation.from_euler("xyz", angles.reshape(-1, 3)).as_quat()
        motion = Motion(snake, rotations.reshape(150, 6, 4), np.zeros((150, 3)), 25.0)
        motion.save(tmp_path / folder / "clip.npz")
    done = gesturekit("evaluate", tmp_path / "made", tmp_path / "recordings").ok()
    assert "Jerk, m/s³" in done.out
    (line,) = (line for line in done.err.splitlines() if "Arm speed" in line)
    assert "Wrist speed" in line


def test_recordings_are_read_by_the_units_that_are_named(evaluate, tmp_path):
    evaluate("--in-fps", 50, "--json", tmp_path / "r.json").ok()
    clip = json.loads((tmp_path / "r.json").read_text())["models"][0]["clips"][0]
    assert any("longer than its recording" in note for note in clip["notes"])


def test_columns_stay_under_their_headers_beside_wide_characters(gesturekit, folders, tmp_path):
    made = tmp_path / "動作"
    made.mkdir()
    (made / "clip0.npz").write_bytes((folders / "ours" / "clip0.npz").read_bytes())
    done = gesturekit("evaluate", made, folders / "recordings")
    *_, header = (line for line in done.out.splitlines() if line.rstrip().endswith("chance"))
    lines = done.out.splitlines()
    (speed,) = (line for line in lines if line.startswith("  Arm speed, rad/s"))
    end = disp_len(header[: header.index("recording")])
    assert speed[:end].endswith("  ") and speed[end] != " "


def test_an_interrupted_evaluation_goes_on_where_it_was(evaluate, tmp_path, monkeypatch):
    from gesturekit.evaluation.measuring.measurer import Measurer

    monkeypatch.setenv("GESTUREKIT_CACHE", str(tmp_path / "cache"))
    measure, done_clips = Measurer.clip, []

    def counted(self, label, index):
        if len(done_clips) == 2:
            raise KeyboardInterrupt
        done_clips.append(index)
        return measure(self, label, index)

    monkeypatch.setattr(Measurer, "clip", counted)
    evaluate().fails(130, "Finished measurements are cached")
    done_clips[:] = [None]  # room for one more clip
    evaluate().ok()
    assert done_clips == [None, 2]


def test_tables_have_a_line_for_each_metric_and_stable_columns(gesturekit, folders, tmp_path):
    gesturekit(
        "evaluate", "a_1=" + str(folders / "ours"), folders / "recordings",
        "--compare", "50% <b>=" + str(folders / "baseline"), "--csv", tmp_path / "t.csv",
        "--markdown", tmp_path / "t.md", "--latex", tmp_path / "t.tex",
        "--json", tmp_path / "r.json",
    ).ok()  # fmt: skip
    found = json.loads((tmp_path / "r.json").read_text())
    assert [model["label"] for model in found["models"]] == ["a_1", "50% <b>"]
    with (tmp_path / "t.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0])[:7] == ["model", "key", "name", "group", "unit", "better", "value"]
    for model in found["models"]:
        values = {row["key"]: float(row["value"]) for row in rows if row["model"] == model["label"]}
        assert values == {key: result["value"] for key, result in model["figures"].items()}
    (row,) = (row for row in rows if (row["model"], row["key"]) == ("a_1", "arm_speed"))
    result = found["models"][0]["figures"]["arm_speed"]
    assert float(row["recording"]) == result["recording"]
    assert (row["low"], row["high"], result["low"]) == ("", "", None)  # of few takes
    latex = (tmp_path / "t.tex").read_text()
    assert r"a\_1 & 50\% <b> & Recording" in latex and r"\end{tabular}" in latex
    (line,) = (line for line in latex.splitlines() if line.startswith("Arm speed"))
    assert line.count("&") == 5 and "[" not in line and line.endswith(r"\\")
    markdown = (tmp_path / "t.md").read_text().splitlines()
    assert markdown[0] == r"| Metric |  | a\_1 | 50% \<b\> | Recording | Chance |"
    assert {line.count("|") for line in markdown if line.startswith("| ")} == {7}


def test_clips_that_are_not_meant_to_be_measured_are_noted_and_leave_exit_code_0(
    gesturekit, write_pair, write_speech, gesture, tmp_path
):
    for i in range(2):
        write_pair(tmp_path / "recordings", f"clip{i}", 3.0, fps=25.0, seed=i)
    for i in range(10):
        write_speech(tmp_path / "speech" / f"talk{i}.wav", 2.0)
    corpus = tmp_path / "corpus.jsonl"
    prepare(tmp_path / "recordings", corpus, unpaired=tmp_path / "speech")
    alone = [item.id for item in Manifest.load(corpus).unpaired("test")]
    for name in ("clip0", "clip1", *alone):
        gesture(3.0, 25.0, seed=9).save(tmp_path / "made" / f"{name}.npz")
    done = gesturekit("evaluate", tmp_path / "made", "--corpus", corpus).ok()
    assert f"1 clip whose items have no motion in {corpus}, not measured: {alone[0]}" in done.err
    assert f"1 clip of split train in {corpus}, not measured: clip" in done.err
    assert "1 clip measured, 0 left out" in done.out
    gesture(3.0, 25.0).save(tmp_path / "made" / "nobody.npz")
    done = gesturekit("evaluate", tmp_path / "made", "--corpus", corpus)
    assert done.status == 1 and "nobody: clip: no recording of its name" in done.err


def test_sync_of_arms_that_hardly_move_is_not_given(gesturekit, write_pair, tmp_path):
    write_pair(tmp_path / "recordings", "a", 5.0, fps=25.0)
    recording = Motion.load(tmp_path / "recordings" / "a.bvh")
    turns = rotation_vector_from_quaternion(recording.rotations)
    slow = quaternion_from_rotation_vector(turns[:1] + 0.02 * (turns - turns[:1]))
    replace(recording, rotations=slow).save(tmp_path / "made" / "a.npz")
    folders = (tmp_path / "made", tmp_path / "recordings", "--audio", tmp_path / "recordings")
    done = gesturekit("evaluate", *folders).ok()
    assert "less than 5 % of the recording's speed" in done.err
    assert not any(line.startswith("  Sync  ") for line in done.out.splitlines())


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


def test_results_are_written_whoever_reads_the_output(gesturekit, folders, tmp_path, closed_pipe):
    answers = tmp_path / "answers.csv"
    rows = [f"u{user},{clip},a,b,model_a,False" for user in range(6) for clip in "xyz"]
    header = "user,input_code,model_a,model_b,winner,is_strong"
    answers.write_text("\n".join([header, *rows]))
    recordings = folders / "recordings"
    for command, names in {
        ("evaluate", folders / "ours", recordings): ["e.html", "e.json", "e.csv"],
        ("study", "analyse", answers): ["a.html", "a.json"],
    }.items():
        flags = {"html": "--out", "json": "--json", "csv": "--csv"}
        options = [text for name in names for text in (flags[name[2:]], tmp_path / name)]
        gesturekit(*command, *options)
        assert all((tmp_path / name).stat().st_size > 0 for name in names)


def test_sanity_prints_its_table_and_names_what_it_left_out(gesturekit, write_pair, tmp_path):
    recordings, page = tmp_path / "talks", tmp_path / "report.html"
    for i in range(2):
        write_pair(recordings, f"clip{i}", 3.0, fps=25.0, seed=i)
    done = gesturekit("evaluate", "--sanity", recordings, "--out", page).ok()
    assert "In time with the speech?" in done.out and "half reach" in done.out
    assert f"written  {page}" in done.out
    assert "<title>Known-bad motion made from talks" in page.read_text()
    write_pair(recordings, "mute", 3.0, fps=25.0)
    (recordings / "mute.wav").write_bytes(b"RIFF")
    done = gesturekit("evaluate", "--sanity", recordings).fails(1, "Left out: mute: ")
    assert "In time with the speech?" in done.out
