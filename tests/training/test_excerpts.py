"""The sample of a long corpus, from which statistics are computed."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gesturekit.corpus import Item
from gesturekit.training.data.excerpts import Excerpt, systematic_sample


def items_of(durations, speakers=None) -> list[Item]:
    speakers = speakers or ["ann"] * len(durations)
    return [
        Item(id=f"t{i:03d}", audio=None, motion=Path(f"/t{i:03d}.bvh"), duration=d, speaker=who)
        for i, (d, who) in enumerate(zip(durations, speakers, strict=True))
    ]


@pytest.mark.parametrize(
    "durations",
    [[3600.0] * 4, [70.0] * 300, [8.0] * 2000, [5.0] * 500 + [900.0] * 10],
    ids=["hours", "minutes", "clips", "mixed"],
)
def test_a_sample_has_the_wanted_length_and_lies_within_its_items(durations):
    items = items_of(durations)
    chosen = systematic_sample(items, 1200.0)
    assert sum(one.duration for one in chosen) == pytest.approx(1200.0, rel=0.12)
    for one in chosen:
        assert 0 <= one.start <= one.start + one.duration <= items[one.index].duration + 1e-6
    assert chosen == systematic_sample(items, 1200.0)
    assert chosen != systematic_sample(items, 1200.0, seed=1)


@pytest.mark.parametrize(
    ("groups", "seconds", "length"),
    [(1, 600.0, 60.0), (20, 600.0, 30.0), (100, 600.0, 10.0), (10, 600.0, 60.0)],
)
def test_excerpts_are_from_ten_seconds_to_a_minute_long(groups, seconds, length):
    """Each speaker and style may have one of the wanted seconds, and begins at equal distances."""
    items = items_of([4000.0 / groups] * groups, [f"s{k:03d}" for k in range(groups)])
    chosen = systematic_sample(items, seconds, every_group=False)
    own = min(length, 4000.0 / groups)
    assert {one.duration for one in chosen} == {own} and len(chosen) == round(seconds / own)
    starts = [one.index * 4000.0 / groups + one.start for one in chosen]
    step = 4000.0 / len(chosen)
    late = np.array(starts) - starts[0] - step * np.arange(len(chosen))
    # One that would end after its recording is moved to its end.
    assert late.max() < own and late.min() > -own
    inside = [k for k, one in enumerate(chosen) if one.start + own < 4000.0 / groups - 1e-6]
    assert np.ptp(late[inside]) < 1e-6


def test_items_are_sampled_by_speaker_style_and_take_whatever_their_names():
    """Ann's two recordings follow one another, so that one of four excerpts is of each of hers."""
    items = items_of([60.0, 60.0, 60.0, 60.0, 60.0], ["bob", "ann", "bob", "ann", "bob"])
    whole = systematic_sample(items, 300.0)
    assert whole == [Excerpt(k, 0.0, 60.0) for k in range(5)]
    few = systematic_sample(items, 120.0)
    assert Counter(items[one.index].speaker for one in few) == {"ann": 1, "bob": 1}
    styled = [replace(item, style=style) for item, style in zip(items, "aabba", strict=True)]
    groups = {(styled[one.index].speaker, styled[one.index].style)
              for one in systematic_sample(styled, 60.0)}  # fmt: skip
    assert groups == {(item.speaker, item.style) for item in styled}


def test_each_part_of_the_corpus_has_its_share_of_the_sample():
    items = items_of([1800.0] * 8, ["ann"] * 6 + ["bob"] * 2)
    chosen = systematic_sample(items, 2400.0, seed=3)
    # 40 excerpts of a minute over eight recordings: five each.
    assert set(Counter(one.index for one in chosen).values()) == {5}


def test_every_second_is_as_likely_to_be_sampled_as_any_other():
    items = items_of([300.0, 100.0, 500.0])
    hits = np.zeros(900)
    begins = (0, 300, 400)
    for seed in range(400):
        for one in systematic_sample(items, 180.0, seed=seed):
            first = begins[one.index] + round(one.start)
            hits[first : first + round(one.duration)] += 1
    # Three of fifteen minutes: every second in a fifth of the samples, but near ends of recordings.
    assert hits[60:240].mean() / 400 == pytest.approx(0.2, abs=0.02)
    assert hits[460:840].mean() / 400 == pytest.approx(0.2, abs=0.02)


def test_a_speaker_of_a_few_seconds_is_in_the_sample():
    items = items_of([3600.0, 12.0, 3600.0], ["ann", "bob", "cid"])
    assert {one.index for one in systematic_sample(items, 600.0, seed=0)} == {0, 1, 2}
    few = systematic_sample(items, 600.0, seed=0, every_group=False)
    assert {one.index for one in few} == {0, 2}


def test_an_excerpt_is_an_interval_of_its_item():
    (one, *_), items = systematic_sample(items_of([600.0]), 60.0, seed=0), items_of([600.0])
    part = one.of(items)
    assert (part.motion_start, part.audio_start) == (one.start, one.start)
    assert part.duration == 60.0 and part.id == "t000"


def test_frames_of_an_excerpt():
    excerpt = Excerpt(0, start=2.0, duration=3.0)
    assert excerpt.frames(25.0, 1000) == (50, 125)
    assert excerpt.frames(25.0, 120) == (45, 120)  # sound and motion may end a little early
    assert excerpt.frames(25.0, 60) == (0, 60)
    assert Excerpt(0, 1.0, 0.001).frames(25.0, 60) == (25, 26)
    assert Excerpt(0, 1.03, 0.22).frames(25.0, 60) == (26, 32)  # 25.75 and 5.5 frames
