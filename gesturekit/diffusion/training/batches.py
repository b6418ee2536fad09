"""Batches: random windows of the recordings with their conditions and noise.

Every row of a batch has its own random numbers, keyed by update and row. They depend neither on
earlier draws nor on the distribution of rows over processes.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gesturekit.diffusion.config import DiffusionConfig
from gesturekit.diffusion.training.augmentation import source_frames, stretch, stretch_factor
from gesturekit.diffusion.training.data import TrainingData, TrainingSequence
from gesturekit.training.seeds import rng_for

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
        return TrainingBatch(*(part.to(device) for part in vars(self).values()))


class Batches:
    """Sampler of training windows, uniform over frames of paired and of unpaired recordings."""

    def __init__(self, data: TrainingData, config: DiffusionConfig) -> None:
        self.data = data
        self.config = config
        share = config.unpaired.share if config.unpaired is not None else 0.0
        frames = {
            kind: sum(r.n_frames for r in data.recordings if r.is_paired == kind)
            for kind in (True, False)
        }
        # Recordings by length of their windows: all windows of a batch have the same length.
        self._groups: dict[int, list[TrainingSequence]] = {}
        weights: dict[int, list[float]] = {}
        for recording in data.recordings:
            length = _window_length(recording.n_frames, config.window_frames)
            of_kind = (1 - share) if recording.is_paired else share
            self._groups.setdefault(length, []).append(recording)
            weights.setdefault(length, []).append(
                of_kind * recording.n_frames / frames[recording.is_paired]
            )
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
        return TrainingBatch(*(torch.stack(parts) for parts in zip(*drawn, strict=True)))

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
        motion = stretch(
            recording.motion,
            start,
            length,
            factor,
            maps=representation.map_columns,
            steps=representation.root_columns,
        )
        condition = stretch(
            recording.condition,
            start,
            length,
            factor,
            steps=conditions.columns["path"],
            steps_offset=conditions.path_mean / conditions.path_scale,
            flags=conditions.columns["events"],
        )
        return torch.from_numpy(motion), torch.from_numpy(condition)


def _window_length(n_frames: int, window: int) -> int:
    """Return the window length of a recording, one of a few lengths for all recordings."""
    length = window
    while length > n_frames:
        length = int(length * _STEP)
    return length
