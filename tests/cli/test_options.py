"""Options of the command line: which go together, how they are parsed, what names denote."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import click
import pytest

from gesturekit import systems
from gesturekit.cli.evaluate_inputs import folders_of, recordings_of, rendered_baselines
from gesturekit.cli.options import (
    RECORDING_OPTIONS,
    Body,
    comma_separated,
    existing_option,
    parse_expert,
    parse_level_files,
    parse_placed_files,
    parse_weights,
)
from gesturekit.cli.render import control_options
from gesturekit.corpus import Item
from gesturekit.evaluation import Items
from gesturekit.rendering import samples


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ("", "Give audio files, --corpus, or --seconds"),
        ("a.wav --seconds 2", "--seconds is for motion without audio"),
        ("a.wav --split test", "--split requires --corpus."),
        ("a.wav --corpus c.jsonl", "--corpus sets the sounds"),
        ("--corpus c.jsonl --seconds 2", "--corpus sets the sounds"),
        ("--corpus c.jsonl --channel 1", "--corpus sets the sounds"),
        ("--keyframes k.bvh --like l.bvh", "--keyframes and --like cannot be combined: give one."),
        ("a.wav --path p.csv --keep k.bvh", "--path and --keep cannot be combined: give one."),
        ("a.wav --keyframe-level 2", "--keyframe-level requires --keyframes or --like."),
        ("--path p.csv --keyframe-level 2", "--keyframe-level requires --keyframes or --like."),
        ("a.wav --change 0.5", "--change requires --like."),
        ("a.wav --rig-part head=Head", "--rig-part requires --rig."),
        ("a.wav --weights x --weights y", "with several encoders, give KIND=PATH for each."),
        ("a.wav --weights hf=x --weights hf=y", "--weights: hf is given twice."),
        ("a.wav --shard 1/2 --launcher slurm", "give --jobs, not --shard"),
        # What goes together: the first thing that is missing is the model or the manifest.
        ("--seconds 2", "none: neither a model folder nor a bundled model"),
        ("a.wav", "none: neither a model folder nor a bundled model"),
        ("--like l.bvh --keyframe-level 2", "none: neither a model folder nor a bundled model"),
        ("--keyframes k.bvh --keyframe-level 2", "none: neither a model folder nor a bundled"),
        ("--like l.bvh --change 0.5", "none: neither a model folder nor a bundled model"),
        ("--keep k.bvh --seconds 2", "none: neither a model folder nor a bundled model"),
        ("--path p.csv --channel 1", "none: neither a model folder nor a bundled model"),
        ("--corpus c.jsonl --split valid", "c.jsonl"),
    ],
)
def test_options_of_render_that_go_together(gesturekit, tmp_path, monkeypatch, arguments, says):
    monkeypatch.chdir(tmp_path)
    done = gesturekit("render", *arguments.split(), "--model", "none", "--out", "out")
    done.fails(2, says)
    assert not (tmp_path / "out").exists()


def test_weights_name_their_encoders(tmp_path):
    (tmp_path / "a=b").mkdir()
    parse = lambda *values: parse_weights(None, None, values)  # noqa: E731
    assert parse() is None and parse("folder") == Path("folder")
    assert parse(str(tmp_path / "a=b")) == tmp_path / "a=b", "a folder that exists is no KIND"
    both = {"wavlm": Path("x"), "files": Path("y=z")}
    assert parse("wavlm=x", "files=y=z") == both


def test_experts_have_a_weight_and_a_style():
    parse = lambda text: parse_expert(text, str.upper)  # noqa: E731
    assert parse("runs/a") == ("RUNS/A", None, None)
    assert parse("a:0.25") == ("A", 0.25, None)
    assert parse("a:0.25:old") == ("A", 0.25, "old")
    assert parse("a::old") == ("A", None, "old")
    assert parse("a:0@0,1@10") == ("A", "0@0,1@10", None)
    with pytest.raises(click.UsageError, match="'half' is not a weight"):
        parse("a:half")


def test_files_have_times_or_levels():
    assert comma_separated(" a, b ,,") == ["a", "b"] and comma_separated(None) == []
    placed = {0.0: Path("a.bvh"), 6.5: Path("b@c.bvh")}
    assert parse_placed_files("a.bvh, b@c.bvh@6.5") == placed
    with pytest.raises(click.UsageError, match=r"a.bvh and b.bvh both begin at 0 s"):
        parse_placed_files("a.bvh,b.bvh@0")
    assert parse_level_files("1-4=a.wav,7=b=c.wav") == {"1-4": Path("a.wav"), "7": Path("b=c.wav")}
    with pytest.raises(click.UsageError, match="'7-10' names no file"):
        parse_level_files("1=a.wav,7-10")


RECORDED = {"corpus": None, "split": None, "audio": None, "protocol": None}
RECORDED |= dict.fromkeys(RECORDING_OPTIONS)


def test_recordings_are_a_folder_or_a_manifest(corpus, tmp_path):
    assert recordings_of(tmp_path, RECORDED) == tmp_path
    for arguments, says in (
        ((tmp_path, {"split": "test"}), "--split requires --corpus"),
        ((None, {}), "name the recordings"),
        ((None, {"corpus": corpus, "audio": tmp_path}), "leave out --audio"),
        ((None, {"corpus": corpus, "in_up": "z"}), "leave out --audio"),
    ):
        with pytest.raises(click.UsageError, match=says):
            recordings_of(arguments[0], RECORDED | arguments[1])
    # All items of this manifest are of its training split.
    for options in ({"split": "train"}, {"protocol": "multires"}):
        items = recordings_of(None, RECORDED | {"corpus": corpus} | options)
        assert isinstance(items, Items) and {item.split for item in items.items} == {"train"}


def test_models_are_labelled_by_as_much_of_their_path_as_tells_them_apart(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = ["ours", "b/ours", "c/b/ours", "best=c/ours", "c/one.bvh", "x=y"]
    for name in (*names[:3], "c/ours", "x=y"):
        (tmp_path / name).mkdir(parents=True, exist_ok=True)
    (tmp_path / "c" / "one.bvh").write_text("")
    folders = folders_of([*names, "absent"], tmp_path, {"protocol": None})
    assert folders == {
        "ours": Path("ours"),
        "b/ours": Path("b/ours"),
        str(tmp_path / "c/b/ours"): Path("c/b/ours"),
        "best": Path("c/ours"),
        "one": Path("c/one.bvh"),
        "x=y": Path("x=y"),
        "absent": Path("absent"),
    }
    for names, says in (
        (["ours", "other=./ours"], "ours is given twice"),
        (["a=ours", "a=b/ours"], "two models are named a"),
    ):
        with pytest.raises(click.UsageError, match=says):
            folders_of(names, tmp_path, {"protocol": None})
    (tmp_path / "ours" / "config.yaml").write_text("kind: multires\n")
    for name in ("ours", "demo"):
        with pytest.raises(click.UsageError, match=f"{name} is a model, not motion"):
            folders_of([name], tmp_path, {"protocol": None})


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"baseline": "median"}, "it is one of mean_pose"),
        ({"baseline": "speech_blnd"}, "did you mean speech_blind"),
        ({"baseline": "mean_pose,speech_blind"}, "speech_blind needs --corpus"),
        ({"baseline": "retrieval", "corpus": "c.jsonl"}, "has the name of a model"),
        ({"baseline": "speech_blind", "corpus": "c.jsonl"}, "only known for folders written by"),
    ],
)
def test_baselines_that_cannot_be_rendered(tmp_path, options, says):
    options = {"corpus": None, "split": None, "seed": 0, "weights": None} | options
    with pytest.raises(click.UsageError, match=says):
        rendered_baselines(tmp_path, {"retrieval": tmp_path}, tmp_path / "new", options)
    usual = options | {"baseline": "mean_pose", "corpus": None}
    assert rendered_baselines(tmp_path, {}, tmp_path / "new", usual) == {}


def test_skip_existing_is_the_same_as_existing_skip_wherever_it_stands(gesturekit, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "motion.bvh").write_text("mine")
    render = ("render", "--seconds", 0.2, "--model", "demo", "--out", tmp_path / "out")
    gesturekit(*render).fails(2, "motion.bvh exists already")
    for options in (["--skip-existing"], ["--existing", "replace", "--skip-existing"]):
        done = gesturekit(*render, *options).ok()
        assert "1 kept" in done.err and (tmp_path / "out" / "motion.bvh").read_text() == "mine"
    gesturekit("demo", "--skip-existing").fails(2, "--skip-existing")


@pytest.mark.parametrize(
    ("arguments", "existing"),
    [
        ([], "replace"),
        (["--skip-existing"], "skip"),
        (["--existing", "refuse", "--skip-existing"], "skip"),
        (["--skip-existing", "--existing", "refuse"], "skip"),
        (["--existing", "refuse"], "refuse"),
    ],
)
def test_what_happens_to_existing_files_is_one_value(arguments, existing):
    option = existing_option("replace", alias=True)
    command = click.command()(option(lambda **options: options))
    assert command.main(arguments, standalone_mode=False) == {"existing": existing}
    with pytest.raises(click.BadParameter):
        command.main(["--existing", "keep"], standalone_mode=False)
    plain = click.command()(existing_option("replace")(lambda **options: options))
    with pytest.raises(click.NoSuchOption):
        plain.main(["--skip-existing"], standalone_mode=False)


@pytest.mark.parametrize(
    ("body", "is_known"),
    [("human", True), ("ME.VRM", True), ("me.glb", True), ("robot", False), ("me.vrm.txt", False)],
)
def test_a_body_is_a_name_or_the_file_of_an_avatar(body, is_known):
    if is_known:
        assert Body()(body) == body
    else:
        with pytest.raises(click.BadParameter, match=f"'{body}' is none of mannequin, human"):
            Body()(body)


@pytest.fixture
def sampled(monkeypatch, tmp_path):
    """sampled(protocol, **options): what each model is sampled for, into which folder, and how."""
    for name in ("a", "b/a"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "config.yaml").write_text("kind: multires\n")
    monkeypatch.chdir(tmp_path)
    asked = []

    def of(protocol: str):
        def sample(model, items, folder, settings):
            asked.append((protocol, model, items, folder.name, settings))
            return [folder / "x.npz"]

        return sample

    for protocol in ("lda", "multires"):
        monkeypatch.setattr(samples, f"sample_{protocol}", of(protocol))
    monkeypatch.setattr(samples, "sounds_of", lambda audio: ("sounds", audio))
    monkeypatch.setattr(samples, "sequences_of", lambda *place: ("sequences", *place))
    monkeypatch.setattr(systems, "load", lambda name, weights: (name, weights))
    usual = {option.name: None for option in control_options()}
    usual |= {"experts": (), "samples": None, "seed": 0, "existing": "replace"}
    usual |= {"weights": None, "samples_dir": tmp_path / "samples", "audio": Path("sound")}

    def sample(protocol: str, recordings=None, names=("a",), **options):
        asked.clear()
        options = RECORDED | usual | {"protocol": protocol} | options
        folders = folders_of(names, recordings or tmp_path / "real", options)
        assert set(folders.values()) == {tmp_path / "samples" / call[3] for call in asked}
        return list(asked)

    return sample


def test_models_are_sampled_by_the_protocol_into_folders_of_their_own(sampled, tmp_path):
    one, two = sampled("lda", names=("a", "b/a"), samples=7, seed=3, guidance=1.5, weights="w")
    assert one[:4] == ("lda", ("a", "w"), ("sounds", Path("sound")), "a")
    assert two[1] == ("b/a", "w") and two[3] == "b_a"
    assert one[4] == samples.SamplingOptions(samples=7, seed=3, controls={"guidance": 1.5})
    (one,) = sampled("multires", in_up="z")
    real = ("sequences", tmp_path / "real", Path("sound"), {"up": "z"})
    assert (one[0], one[2]) == ("multires", real)
    assert one[4] == samples.SamplingOptions(samples=None, seed=0, skip=False, controls={})
    with pytest.raises(click.UsageError, match="--protocol lda samples models for .* give --audio"):
        sampled("lda", audio=None)


def test_of_a_manifest_the_items_with_motion_are_sampled(sampled, tmp_path):
    moving = Item(id="a", audio=None, motion=tmp_path / "a.bvh", duration=1.0)
    speech = Item(id="b", audio=tmp_path / "b.wav", motion=None, duration=1.0)
    items = SimpleNamespace(items=[moving, speech])
    for protocol in ("lda", "multires"):
        (one,) = sampled(protocol, items, corpus="c.jsonl")
        assert one[:3] == (protocol, ("a", None), [moving])


def test_samples_of_an_earlier_run_are_not_measured_by_accident(sampled, tmp_path):
    folder = tmp_path / "samples" / "a"
    folder.mkdir(parents=True)
    assert len(sampled("lda")) == 1, "an empty folder"
    (folder / "x.npz").touch()
    with pytest.raises(click.UsageError, match="holds samples of an earlier run"):
        sampled("lda")
    ((*_, settings),) = sampled("lda", existing="skip")
    assert settings.skip
