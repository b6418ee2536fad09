"""Data augmentation: mirroring and time stretching.

As in section 4.1 and appendix A.1 of the paper: left-right mirroring, except for styles that
distinguish the sides, and time stretching of a share of the training windows.

Motion is augmented in its own units, so that a stretched walk covers the same distance in more
frames. Normalised conditions are augmented with an offset for their mean.
"""

from __future__ import annotations

import math
import re
from typing import Protocol

import numpy as np
import torch

from gesturekit.diffusion.conditions import Conditions
from gesturekit.errors import ConfigError

_WORDS = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|[^A-Za-z]+|[A-Z]")
_NO_COLUMNS = slice(0, 0)
_OTHER_SIDE = {"left": "right", "right": "left", "l": "r", "r": "l"}


class Rows(Protocol):
    """Frames (T, D) of a recording: an array, or a file of which `[start:stop]` reads some."""

    def __len__(self) -> int: ...

    def __getitem__(self, frames: slice, /) -> np.ndarray: ...


def other_side(name: str) -> str:
    """Swap the words left and right (and l and r) in a name: "kickLeft" to "kickRight"."""

    def swap(match: re.Match[str]) -> str:
        word = match[0]
        other = _OTHER_SIDE.get(word.lower(), word)
        if other == word:
            return word
        return other.upper() if word.isupper() else other.title() if word[0].isupper() else other

    return _WORDS.sub(swap, name)


def mirror_condition(condition: np.ndarray, layout: Conditions) -> np.ndarray:
    """Mirror a condition: negate turn and lateral displacement, and swap left and right events.

    Args:
        condition: (T, C); other columns are kept.
        layout: its columns and the scale of its path.

    Returns:
        (T, C), a copy.

    Raises:
        ConfigError: an event of one side without one of the other side, see `other_side`.
    """
    mirrored, names = condition.copy(), layout.events
    path, events = layout.columns["path"], layout.columns["events"]
    if layout.path:
        sign, offset = np.array([-1.0, 1.0, -1.0]), layout.path_mean / layout.path_scale
        mirrored[:, path] = sign * (condition[:, path] + offset) - offset
    for name, column in zip(names, range(events.start, events.stop), strict=True):
        other = other_side(name)
        if other not in names:
            raise ConfigError(
                f"event {name!r}: mirrored it would be {other!r}, which is not an event of the "
                "corpus; rename it, or train without mirror"
            )
        mirrored[:, column] = condition[:, events.start + names.index(other)]
    return mirrored


def stretch_factor(rng: torch.Generator, share: float, spread: float) -> float:
    """Draw a time-stretching factor: 1 + U[-spread, spread] for a share of windows, else 1.

    Two numbers are drawn in either case.
    """
    chance, place = torch.rand(2, generator=rng, dtype=torch.float64).tolist()
    return 1.0 + spread * (2 * place - 1) if chance < share else 1.0


def source_frames(n_frames: int, factor: float) -> int:
    """Return the number of source frames for `n_frames` stretched by `factor`."""
    return math.ceil(round((n_frames - 1) / factor, 9)) + 1


def stretch(
    values: Rows,
    start: float,
    n_frames: int,
    factor: float,
    *,
    maps: slice = _NO_COLUMNS,
    steps: slice = _NO_COLUMNS,
    steps_offset: np.ndarray | float = 0.0,
    flags: slice = _NO_COLUMNS,
) -> np.ndarray:
    """Cut out a window of motion vectors or conditions, slowed down by `factor`.

    Frame k is the recording at frame `start + k / factor`, linearly interpolated.

    Args:
        values: (T, D) of a recording, of which only the frames around the window are read.
        start: first frame of the window, possibly fractional.
        n_frames: N, of the result; see `source_frames`.
        factor: above 1 is slower.
        maps: columns of exponential maps, three per joint. Neighbouring maps more than pi apart are
            not interpolated: the nearer one is taken.
        steps: columns of displacement per frame (turn, forward, lateral). Their sum over a part of
            the recording is preserved.
        steps_offset: mean over scale of these columns, if they are normalised.
        flags: binary columns, taken from the nearest frame. Flags of single frames are never lost.

    Returns:
        (N, D) of the same type.

    Raises:
        ValueError: the window exceeds the recording.
    """
    at = start + np.arange(n_frames) / factor
    last = len(values) - 1
    if start < 0 or at[-1] > last + 1e-6:
        raise ValueError(f"frames {at[0]:g} to {at[-1]:g} of a recording of {len(values)}")
    if factor == 1.0 and float(start).is_integer():
        return values[int(start) : int(start) + n_frames].copy()
    at = np.minimum(at, last)
    low = np.floor(at).astype(np.int64)
    high = np.minimum(low + 1, last)
    weight = (at - low)[:, None]
    # Displacements before the window are read too, see `_scaled_steps`.
    begin = max(int(low[0]) - math.ceil(1 / factor), 0)
    source = values[begin : int(high[-1]) + 1]
    below, above = source[low - begin], source[high - begin]
    result = below + weight * (above - below)
    if maps.stop > maps.start:
        pairs = (above[:, maps] - below[:, maps]).reshape(n_frames, -1, 3)
        apart = np.repeat(np.linalg.norm(pairs, axis=-1) > np.pi, 3, axis=-1)
        nearest = np.where(weight < 0.5, below[:, maps], above[:, maps])
        result[:, maps] = np.where(apart, nearest, result[:, maps])
    if steps.stop > steps.start:
        offset = np.asarray(steps_offset, dtype=np.float64)
        result[:, steps] = _scaled_steps(source[:, steps], begin, at, 1 / factor, offset)
    if flags.stop > flags.start:
        result[:, flags] = _kept_flags(source[:, flags], begin, at, 1 / factor)
    return result.astype(source.dtype)


def _scaled_steps(
    steps: np.ndarray, begin: int, at: np.ndarray, rate: float, offset: np.ndarray
) -> np.ndarray:
    """Return displacements (N, S) between times `at`, which are `rate` frames apart.

    `steps` are those of frames from `begin`.
    """
    counted = steps.astype(np.float64) + offset
    # Row k is from frame k - 1 to frame k; before the first frame, extrapolate.
    before = np.tile(counted[:1], (math.ceil(rate), 1))
    way = np.concatenate([before, counted]).cumsum(axis=0)
    frames = np.arange(len(way)) + begin - len(before)
    ends = np.concatenate([[at[0] - rate], at])
    sums = np.stack([np.interp(ends, frames, column) for column in way.T], axis=-1)
    return np.diff(sums, axis=0) - offset


def _kept_flags(flags: np.ndarray, begin: int, at: np.ndarray, rate: float) -> np.ndarray:
    """Return flags (N, E) at the nearest frames; flags of skipped frames move to kept ones.

    `flags` are those of frames from `begin`.
    """
    kept = flags[np.floor(at + 0.5).astype(np.int64) - begin].copy()
    first, stop = int(np.ceil(at[0])), int(np.floor(at[-1])) + 1
    number, column = np.nonzero(flags[first - begin : stop - begin])
    near = np.ceil((number + first - at[0]) / rate - 0.5).astype(np.int64)
    kept[near, column] = 1.0
    return kept
