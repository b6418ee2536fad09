"""More motion from the same recordings: mirrored, stretched in time, and every frame of them.

As section 4.1 and appendix A.1 of the paper have it: mirroring left for right, except for styles
that tell the two apart; time stretching of a share of the training windows; and, where a recording
has a multiple of the model's frame rate, each of the sequences that it can be thinned out to.

All of it works in the units of the data (or on standardised conditions, whose means are told), so
that steps of the root over the ground are scaled as steps: a walk that is stretched covers the
same distance in more frames.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from gesturekit.errors import ConfigError
from gesturekit.motion.motion import Motion

_WORDS = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|[^A-Za-z]+|[A-Z]")
_OTHER_SIDE = {"left": "right", "right": "left", "l": "r", "r": "l"}


@dataclass(frozen=True, eq=False)
class Phase:
    """One of the sequences that a recording is thinned out to.

    Attributes:
        motion: at the model's frame rate.
        start: seconds into the recording of its first frame.
    """

    motion: Motion
    start: float


def phases(motion: Motion, fps: float) -> tuple[Phase, ...]:
    """A motion at `fps`; where its own rate is n times that, all n ways to take every n-th frame.

    The first is `motion.resample(fps)`. What goes with the motion begins later for the others, by
    `Phase.start`.
    """
    ratio = motion.fps / fps
    n = round(ratio) if abs(ratio - round(ratio)) < 1e-6 * ratio else 1
    return (
        Phase(motion.resample(fps), 0.0),
        *(
            Phase(motion.slice(k, motion.n_frames).resample(fps), k / motion.fps)
            for k in range(1, min(n, motion.n_frames))
        ),
    )


def other_side(name: str) -> str:
    """A name with its words left and right (l and r, too) exchanged: "kickLeft" to "kickRight"."""

    def swap(match: re.Match[str]) -> str:
        word = match[0]
        other = _OTHER_SIDE.get(word.lower(), word)
        if other == word:
            return word
        return other.upper() if word.isupper() else other.title() if word[0].isupper() else other

    return _WORDS.sub(swap, name)


def mirror_condition(
    condition: np.ndarray,
    *,
    path: slice = slice(0, 0),
    path_offset: np.ndarray | float = 0.0,
    events: slice = slice(0, 0),
    event_names: Sequence[str] = (),
) -> np.ndarray:
    """What a mirrored motion is told: turn and lateral change sign, left and right events swap.

    Args:
        condition: (T, C) rows, of which everything else stays as it is.
        path: columns of turn, forward and lateral.
        path_offset: (3,) mean over scale of these columns, where they are standardised.
        events: columns of the events.
        event_names: their names; see `other_side`.

    Returns:
        (T, C), a copy.

    Raises:
        ConfigError: an event of the left without one of the right, or the other way round.
    """
    mirrored = condition.copy()
    if path.stop > path.start:
        sign = np.array([-1.0, 1.0, -1.0])
        offset = np.broadcast_to(np.asarray(path_offset, dtype=np.float64), 3)
        mirrored[:, path] = sign * (condition[:, path] + offset) - offset
    others = [other_side(name) for name in event_names]
    for name, other in zip(event_names, others, strict=True):
        if other not in event_names:
            raise ConfigError(
                f"event {name!r}: mirrored it would be {other!r}, which is no event of the corpus; "
                "rename it, or train without mirror"
            )
    if others:
        order = [events.start + list(event_names).index(other) for other in others]
        mirrored[:, events] = condition[:, order]
    return mirrored


def stretch_factor(rng: torch.Generator, share: float, spread: float = 0.1) -> float:
    """How much longer a training window is made: 1 + U[-spread, spread] for a share of all, else 1.

    Two numbers are drawn whatever comes out.
    """
    chance, place = torch.rand(2, generator=rng, dtype=torch.float64).tolist()
    return 1.0 + spread * (2 * place - 1) if chance < share else 1.0


def source_frames(n_frames: int, factor: float) -> int:
    """How many frames a recording needs for `n_frames` stretched by `factor`."""
    return math.ceil(round((n_frames - 1) / factor, 9)) + 1


def stretch(
    values: np.ndarray,
    start: float,
    n_frames: int,
    factor: float,
    *,
    maps: slice = slice(0, 0),
    steps: slice = slice(0, 0),
    steps_offset: np.ndarray | float = 0.0,
    flags: slice = slice(0, 0),
) -> np.ndarray:
    """A window of motion vectors or conditions, `factor` times as long as it was.

    Frame k is the recording at frame `start + k / factor`, between two frames a straight line.

    Args:
        values: (T, D) rows of a recording.
        start: frame at which the window begins; it may lie between two frames.
        n_frames: N, of the result; see `source_frames` for what it takes.
        factor: above 1 is slower.
        maps: columns of exponential maps, three a joint. Between two that are farther apart than a
            half turn nobody knows the way: the nearer one is taken.
        steps: columns that count per frame (turn, forward, lateral): what they sum up to over a
            stretch of the recording stays the same.
        steps_offset: mean over scale of these columns, where they are standardised.
        flags: columns that are on or off: each frame takes its nearest, and what is on for a
            shorter time than a frame is kept.

    Returns:
        (N, D) of the same type.

    Raises:
        ValueError: the window leaves the recording.
    """
    at = start + np.arange(n_frames) / factor
    last = len(values) - 1
    if start < 0 or at[-1] > last + 1e-6:
        raise ValueError(f"frames {at[0]:g} to {at[-1]:g} of a recording of {len(values)}")
    if factor == 1.0 and float(start).is_integer():
        return values[int(start) : int(start) + n_frames].copy()
    at = np.clip(at, 0, last)
    low = np.minimum(np.floor(at).astype(np.int64), max(last - 1, 0))
    high = np.minimum(low + 1, last)
    weight = (at - low)[:, None]
    nearest = np.where(weight[:, 0] < 0.5, low, high)
    result = values[low] + weight * (values[high] - values[low])
    if maps.stop > maps.start:
        pairs = (values[high, maps] - values[low, maps]).reshape(n_frames, -1, 3)
        apart = np.repeat(np.linalg.norm(pairs, axis=-1) > np.pi, 3, axis=-1)
        result[:, maps] = np.where(apart, values[nearest, maps], result[:, maps])
    if steps.stop > steps.start:
        offset = np.asarray(steps_offset, dtype=np.float64)
        result[:, steps] = _scaled_steps(values[:, steps], at, 1 / factor, offset)
    if flags.stop > flags.start:
        result[:, flags] = _kept_flags(values[:, flags], at, 1 / factor)
    return result.astype(values.dtype)


def _scaled_steps(steps: np.ndarray, at: np.ndarray, rate: float, offset: np.ndarray) -> np.ndarray:
    """(N, S) what steps sum up to between times that lie `rate` frames apart."""
    first = max(int(np.floor(at[0])) - math.ceil(rate), 0)
    stop = min(int(np.ceil(at[-1])) + 1, len(steps))
    counted = steps[first:stop].astype(np.float64) + offset
    # Row k leads from frame k - 1 to frame k; before the first, the body goes on as it began.
    before = np.tile(counted[:1], (math.ceil(rate) + 1, 1))
    way = np.concatenate([before, counted]).cumsum(axis=0)
    frames = np.arange(len(way)) + first - len(before)
    ends = np.concatenate([[at[0] - rate], at])
    sums = np.stack([np.interp(ends, frames, column) for column in way.T], axis=-1)
    return np.diff(sums, axis=0) - offset


def _kept_flags(flags: np.ndarray, at: np.ndarray, rate: float) -> np.ndarray:
    """(N, E) flags at the nearest frames; one that is on in a frame that falls out is moved."""
    last = len(flags) - 1
    kept = flags[np.minimum(np.floor(at + 0.5).astype(np.int64), last)].copy()
    if rate <= 1:  # every frame of the recording is the nearest of some frame
        return kept
    first, stop = int(np.ceil(at[0])), int(np.floor(at[-1])) + 1
    for frame, column in np.argwhere(flags[first:stop] > 0):
        nearest = min(max(math.floor((frame + first - at[0]) / rate + 0.5), 0), len(at) - 1)
        kept[nearest, column] = max(kept[nearest, column], flags[frame + first, column])
    return kept
