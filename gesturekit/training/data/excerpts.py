"""Excerpts of a long corpus: a sample spread over its takes, from which statistics are computed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from gesturekit.corpus.item import Item
from gesturekit.training.seeds import rng_for

_LONGEST, _SHORTEST = 60.0, 10.0
"""Seconds of an excerpt: many short ones cover more takes, long ones show how movement changes
within a take."""


@dataclass(frozen=True)
class Excerpt:
    """Part of an item.

    Attributes:
        index: of the item among those of the corpus.
        start: seconds from the item's start.
        duration: seconds.
    """

    index: int
    start: float
    duration: float

    def of(self, items: Sequence[Item]) -> Item:
        """Return the excerpt as an item of its own."""
        item = items[self.index]
        return replace(
            item,
            motion_start=item.motion_start + self.start,
            audio_start=item.audio_start + self.start,
            duration=self.duration,
        )

    def frames(self, fps: float, n_frames: int) -> tuple[int, int]:
        """Return first frame and end of the excerpt of an item that has `n_frames`."""
        length = min(n_frames, max(1, math.floor(self.duration * fps + 0.5)))
        start = min(round(self.start * fps), n_frames - length)
        return start, start + length


def systematic_sample(
    items: Sequence[Item], seconds: float, *, seed: int = 0, every_group: bool = True
) -> list[Excerpt]:
    """Return excerpts of about `seconds` in total, spread over speakers, styles and takes.

    All recordings are laid end to end, in the order of speaker, style and take, and excerpts begin
    at equal distances from a random first place (a systematic sample). So each second is as likely
    as any other to be in the sample, and each part of the corpus has its share of it.

    Args:
        items: of the corpus.
        seconds: total length of the sample; a shorter corpus is returned whole.
        seed: of the first place; the same in all runs, so that they share arrays.
        every_group: add one excerpt of each speaker and style that would be missed.
    """
    total = sum(item.duration for item in items)
    if total <= seconds:
        return [Excerpt(i, 0.0, item.duration) for i, item in enumerate(items)]
    order = sorted(range(len(items)), key=lambda i: (*_group(items[i]), items[i].take, items[i].id))
    groups = {_group(item) for item in items}
    length = min(_LONGEST, max(_SHORTEST, seconds / len(groups)))
    # Items shorter than an excerpt are taken whole, so that more excerpts fit.
    usual = sum(item.duration * min(length, item.duration) for item in items) / total
    step = total / max(1, round(seconds / usual))
    first = step * float(torch.rand((), generator=rng_for(seed, "sample of the corpus")))
    chosen, begin, count = [], 0.0, 0
    for i in order:
        duration = items[i].duration
        while first + count * step < begin + duration:
            place, own = first + count * step - begin, min(length, duration)
            chosen.append(Excerpt(i, min(place, duration - own), own))
            count += 1
        begin += duration
    missed = groups - {_group(items[one.index]) for one in chosen} if every_group else set()
    for i in order:
        if _group(items[i]) in missed:
            missed.discard(_group(items[i]))
            chosen.append(Excerpt(i, 0.0, min(length, items[i].duration)))
    return sorted(set(chosen), key=lambda one: (one.index, one.start))


def _group(item: Item) -> tuple[str, str]:
    return item.speaker or "", item.style or ""
