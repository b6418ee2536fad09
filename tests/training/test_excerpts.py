"""The sample of a long corpus, from which statistics are computed."""

from pathlib import Path

import numpy as np
import pytest

from gesturekit.corpus import Item
from gesturekit.training.recordings import Excerpt, systematic_sample


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


def test_frames_of_an_excerpt():
    excerpt = Excerpt(0, start=2.0, duration=3.0)
    assert excerpt.frames(25.0, 1000) == (50, 125)
    assert excerpt.frames(25.0, 120) == (45, 120)  # sound and motion may end a little early
    assert excerpt.frames(25.0, 60) == (0, 60)
    assert Excerpt(0, 1.0, 0.001).frames(25.0, 60) == (25, 26)
    assert Excerpt(0, 1.03, 0.22).frames(25.0, 60) == (26, 32)  # 25.75 and 5.5 frames
