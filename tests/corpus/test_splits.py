"""Recordings held out by name, and items made of recordings, without any file."""

import re
from dataclasses import replace
from math import inf
from pathlib import Path

import pytest

from gesturekit.corpus import Item
from gesturekit.corpus.recording import Recording
from gesturekit.corpus.splits import hold_out, split_items
from gesturekit.errors import CorpusError

NAMES = ("day1/a", "day1/b", "day2/a")


def recordings(**about) -> list[Recording]:
    """Three pairs of 8 s, of the speakers ann and bob and of nobody."""
    speakers = ("ann", "bob", None)
    files = {"audio": Path("/in/a.wav"), "motion": Path("/in/a.bvh"), "fps": 30.0, "stop": 8.0}
    return [
        Recording(name, speaker=speaker, take=name, **files | about)
        for name, speaker in zip(NAMES, speakers)
    ]


def test_names_that_fit_nothing_or_everything_are_one_clear_error(tmp_path):
    names = tmp_path / "names.txt"
    for wanted, says in (
        ({"pattern": "xyz"}, r"(?=.*xyz)(?=.*\b3\b).*day1/a"),
        ({"pattern": "day"}, " 3 "),
        ({"pattern": "("}, r"(?=.*pattern \().*expression"),
        ({"speakers": ("carl",)}, "(?=.*'carl')(?=.*ann).*bob"),
        ({"file": "gone\nday1/a\nlost\n"}, r"(?=.*names.txt)(?=.*\b2\b)(?=.*gone).*lost"),
        ({"file": "x" * (16 * 2**20 + 1)}, "names.txt"),
    ):
        text = wanted.get("file")
        if isinstance(text, str | bytes):
            names.write_bytes(text.encode() if isinstance(text, str) else text)
            wanted = {"file": names}
        with pytest.raises(CorpusError, match=says):
            hold_out(recordings(), **wanted)
    unnamed = [replace(one, speaker=None) for one in recordings()]
    with pytest.raises(CorpusError, match="(?=.*'ann').*none"):
        hold_out(unnamed, speakers=("ann",))


def test_an_item_has_all_that_its_recording_had():
    about = {
        **{"style": "calm", "take": "day1", "split": "valid", "channel": 2},
        **{"reading": {"height": 1.7}, "audible": ((1.0, 2.0),)},
        "conditions": {"words": Path("/in/a.ctm")},
    }
    one = replace(recordings()[0], start=1.23456789, stop=3.0, audio_offset=0.25, **about)
    (item,), problems = split_items([one], 0.1, [], 0)
    times = {"audio_start": 1.484568, "motion_start": 1.234568, "duration": 1.765432}
    files = {"audio": Path("/in/a.wav"), "motion": Path("/in/a.bvh")}
    assert problems == []
    assert item == Item(id="day1/a", speaker="ann", **files, **times, **about)
    (speech,), _ = split_items([replace(one, motion=None, start=1.0)], 0.1, [], 0)
    assert (speech.audio_start, speech.motion_start, speech.motion) == (1.25, 0.0, None)
    (moves,), _ = split_items([replace(one, audio=None, start=1.0)], 0.1, [], 0)
    assert (moves.audio_start, moves.motion_start, moves.channel) == (0.0, 1.0, None)


def parts(recording: Recording, *intervals: tuple[float, float], holdout=0.1):
    items, problems = split_items([recording], holdout, list(intervals), 0)
    found = [(i.id, i.split, round(i.motion_start, 3), round(i.duration, 3)) for i in items]
    return found, [(p.severity, p.file, p.message) for p in problems]


def test_seconds_are_held_out_at_frames_and_short_pieces_left_out():
    one = recordings()[1]
    found, ((severity, _, text),) = parts(one, (2.0, 3.51), (7.6, inf))
    assert found == [
        ("day1/b@0.00-2.00", "train", 0.0, 2.0),
        ("day1/b@2.00-3.50", "test", 2.0, 1.5),  # frame 105.3
        ("day1/b@3.50-7.60", "train", 3.5, 4.1),
    ]
    assert severity == "note" and re.search(r"(?=.*\b7.60\b).*8.00 s", text)
    assert parts(one, (0.0, 9.0)) == ([("day1/b", "test", 0.0, 8.0)], [])
    found, ((severity, file, _),) = parts(one, (9.0, 10.0))
    assert found == [("day1/b", "train", 0.0, 8.0)]
    assert (severity, file) == ("warning", one.motion)


def test_of_the_only_pair_the_last_fifth_is_held_out():
    """From 2 s to 8 s: 6.8 s on. Not if it has a split of its own, or none is wanted."""
    one = replace(recordings()[0], start=2.0)
    train, test = ("day1/a@2.00-6.80", "train", 2.0, 4.8), ("day1/a@6.80-8.00", "test", 6.8, 1.2)
    assert parts(one)[0] == [train, test]
    assert parts(one, holdout=0.0)[0] == [("day1/a", "train", 2.0, 6.0)]
    assert parts(replace(one, split="valid"))[0] == [("day1/a", "valid", 2.0, 6.0)]


def test_speech_and_motion_alone_follow_their_take_or_are_held_out_apart():
    pairs = [replace(one, take=f"take{n}") for n, one in enumerate(recordings())]
    alone = [
        Recording(f"s{n}", audio=Path(f"/in/s{n}.wav"), take=one.take, stop=2.0)
        for n, one in enumerate(pairs)
    ]
    items, _ = split_items([*pairs, *alone], 0.3, [], 0)
    assert sorted(i.split for i in items[:3]) == ["test", "train", "train"]
    assert [i.split for i in items[3:]] == [i.split for i in items[:3]]
    # At least one pair is held out, and of speech alone only the share that is asked for.
    lone = [replace(one, take=f"own{n}") for n, one in enumerate(alone)]
    items, _ = split_items([*pairs, *lone], 0.01, [], 0)
    assert sorted(i.split for i in items) == ["test", *["train"] * 5]
    # Of one take, recordings are held out one by one.
    items, _ = split_items([replace(one, take="same") for one in pairs], 0.01, [], 0)
    assert sorted(i.split for i in items) == ["test", "train", "train"]
