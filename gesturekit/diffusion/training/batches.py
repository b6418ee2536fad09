"""Batches: random windows of the recordings, stretched in time, with conditions and noise.

Every row of a batch has its own random numbers, keyed by update and row. They depend neither on
earlier draws nor on the distribution of rows over processes.

A share of the windows is stretched in time (section 4.1 and appendix A.1). Motion is stretched in
its own units, so that a stretched walk covers the same distance in more frames; normalised
conditions with an offset for their mean.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gesturekit.diffusion.config import DiffusionConfig
from gesturekit.diffusion.training.data import Rows, TrainingData, TrainingSequence
from gesturekit.training.seeds import rng_for

_NO_COLUMNS = slice(0, 0)
_STEP = 0.8
"""Recordings shorter than a window get windows shortened repeatedly by this factor."""


@dataclass(frozen=True)
class TrainingBatch:
    """The training batch of one update.

    Attributes:
        clean: (B, T, X) normalised motion.
        noise: (B, T, X) standard normal.
        condition: (B, T, C), zero where it is dropped.
        step: (B,) steps of the diffusion, long.
    """

    clean: Tensor
    noise: Tensor
    condition: Tensor
    step: Tensor

    def to(self, device: torch.device) -> TrainingBatch:
        """Return a copy on another device."""
        return TrainingBatch(*(values.to(device) for values in vars(self).values()))


class Batches:
    """Sampler of training windows, uniform over frames of paired and of unpaired recordings."""

    def __init__(self, data: TrainingData, config: DiffusionConfig) -> None:
        self.data, self.config = data, config
        unpaired = config.unpaired.share if config.unpaired is not None else 0.0
        shares = {True: 1 - unpaired, False: unpaired}
        frames = {
            kind: sum(r.n_frames for r in data.recordings if r.is_paired == kind) for kind in shares
        }
        # Recordings by length of their windows: all windows of a batch have the same length.
        self._groups: dict[int, list[TrainingSequence]] = {}
        weights: dict[int, list[float]] = {}
        window = max(2, round(config.training.window * config.fps))
        for recording in data.recordings:
            length, kind = window, recording.is_paired
            while length > recording.n_frames:
                length = int(length * _STEP)
            self._groups.setdefault(length, []).append(recording)
            weight = shares[kind] * recording.n_frames / frames[kind]
            weights.setdefault(length, []).append(weight)
        self._lengths = list(self._groups)
        self._of_length = torch.tensor([sum(w) for w in weights.values()], dtype=torch.float64)
        self._of_recording = {
            length: torch.tensor(w, dtype=torch.float64) for length, w in weights.items()
        }

    def draw(self, update: int, rows: slice) -> TrainingBatch:
        """Draw some rows of the batch of an update."""
        rng = rng_for(self.config.seed, "update", update)
        length = self._lengths[int(torch.multinomial(self._of_length, 1, generator=rng))]
        drawn = [
            self._row(length, rng_for(self.config.seed, "update", update, "row", row))
            for row in range(self.config.training.batch)[rows]
        ]
        return TrainingBatch(*(torch.stack(rows) for rows in zip(*drawn, strict=True)))

    def _row(self, length: int, rng: torch.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Draw clean motion (T, X), noise (T, X), condition (T, C) and step of one row."""
        training = self.config.training
        which = int(torch.multinomial(self._of_recording[length], 1, generator=rng))
        recording = self._groups[length][which]
        motion, condition = self._window(recording, length, rng)
        drop_all, drop_style = torch.rand(2, generator=rng, dtype=torch.float64).tolist()
        if drop_all < training.dropout_condition:
            condition = self.data.conditions.without(condition)
        elif drop_style < training.dropout_style:
            condition = self.data.conditions.without(condition, "styles")
        if training.dropout_state and float(torch.rand((), generator=rng)) < training.dropout_state:
            condition = self.data.conditions.without(condition, "state")
        step = torch.randint(self.config.noise.steps, (), generator=rng)
        noise = torch.randn(motion.shape, generator=rng)
        return self.data.normaliser.forward(motion), noise, condition, step

    def _window(
        self, recording: TrainingSequence, length: int, rng: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Draw motion (T, X) in its own units and condition (T, C), time-stretched at random."""
        settings = self.config.augmentation
        factor = stretch_factor(rng, settings.stretch, settings.stretch_range)
        frames = source_frames(length, factor)
        if frames > recording.n_frames:
            # The recording is too short to be sped up.
            factor, frames = 1.0, length
        start = int(torch.randint(recording.n_frames - frames + 1, (), generator=rng))
        representation, conditions = self.data.representation, self.data.conditions
        maps, displacement = representation.map_columns, representation.root_columns
        window = start, length, factor
        motion = stretch(recording.motion, *window, maps=maps, steps=displacement)
        columns, offset = conditions.columns, conditions.path_mean / conditions.path_scale
        steps, flags = columns["path"], columns["events"]
        condition = stretch(
            recording.condition, *window, steps=steps, steps_offset=offset, flags=flags
        )
        return torch.from_numpy(motion), torch.from_numpy(condition)


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
