"""Options of the command line: which go together, how they are parsed, what names denote."""

import re
from pathlib import Path

import click
import pytest

from gesturekit.cli.options import (
    comma_separated,
    parse_expert,
    parse_level_files,
    parse_placed_files,
    parse_weights,
)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ("", "--corpus & --seconds"),
        ("a.wav --seconds 2", "--seconds"),
        ("a.wav --split test", "--split & --corpus"),
        ("a.wav --corpus c.jsonl", "--corpus"),
        ("--corpus c.jsonl --channel 1", "--corpus & --channel"),
        ("--keyframes k.bvh --like l.bvh", "--keyframes & --like"),
        ("a.wav --path p.csv --keep k.bvh", "--path & --keep"),
        ("a.wav --keyframe-level 2", "--keyframe-level & --keyframes & --like"),
        ("a.wav --change 0.5", "--change & --like"),
        ("a.wav --rig-part head=Head", "--rig-part & --rig\\W"),
        ("a.wav --weights x --weights y", "KIND=PATH"),
        ("a.wav --shard 1/2 --launcher slurm", "--jobs & --shard"),
        # What goes together: the first thing that is missing is the model or the manifest.
        ("--like l.bvh --keyframe-level 2", "none: "),
        ("--path p.csv --channel 1", "none: "),
    ],
)
def test_options_of_render_that_go_together(gesturekit, tmp_path, monkeypatch, arguments, says):
    monkeypatch.chdir(tmp_path)
    done = gesturekit("render", *arguments.split(), "--model", "none", "--out", "out")
    error = done.fails(2).err
    assert all(re.search(fact, error) for fact in says.split(" & "))
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
    with pytest.raises(click.UsageError, match="'half'"):
        parse("a:half")


def test_files_have_times_or_levels():
    assert comma_separated(" a, b ,,") == ["a", "b"] and comma_separated(None) == []
    placed = {0.0: Path("a.bvh"), 6.5: Path("b@c.bvh")}
    assert parse_placed_files("a.bvh, b@c.bvh@6.5") == placed
    with pytest.raises(click.UsageError, match=r"(?=.*a.bvh)(?=.*b.bvh)(?=.*\b0 s)"):
        parse_placed_files("a.bvh,b.bvh@0")
    assert parse_level_files("1-4=a.wav,7=b=c.wav") == {"1-4": Path("a.wav"), "7": Path("b=c.wav")}
    with pytest.raises(click.UsageError, match="'7-10'"):
        parse_level_files("1=a.wav,7-10")
