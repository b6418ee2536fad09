"""What a training run looks at now and then: cheap measures of what it would generate."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

import audio_features as af
from gesturekit.evaluation.quick import quick_figures
from gesturekit.motion.motion import Motion
from gesturekit.multires.bank import condition_levels
from gesturekit.multires.config import MultiresConfig
from gesturekit.multires.data import PairedSequence, TrainingData
from gesturekit.multires.interpolation import resample
from gesturekit.multires.networks import MultiresGenerator
from gesturekit.multires.styles import style_levels
from gesturekit.training.seeds import generator

MOST_CLIPS = 4
MOST_SECONDS = 20.0
"""Of the training recordings so many are spoken again, and so much of each."""


class Monitor:
    """Measures motion for the training speech (or style), beside its recordings.

    Random numbers are its own, so that a run with it and one without come to the same weights.
    """

    def __init__(self, data: TrainingData, config: MultiresConfig) -> None:
        self.data = data
        self.config = config
        self.clips = [
            (sequence, min(sequence.n_frames, round(MOST_SECONDS * config.fps)))
            for sequence in data.paired[:MOST_CLIPS]
        ]
        self.recordings = [
            self._motion(sequence.motion[:, :n_frames]) for sequence, n_frames in self.clips
        ]

    def figures(self, network: MultiresGenerator, levels: int) -> dict[str, float]:
        """Cheap measures (`quick_figures`) of what the first `levels` levels generate.

        The finest of them is interpolated to the full rate. Noise is the same every time.
        """
        return quick_figures(list(self._generated(network, levels)), self.recordings)

    @torch.no_grad()
    def _generated(self, network: MultiresGenerator, levels: int) -> Iterator[Motion]:
        device = next(network.parameters()).device
        for number, (sequence, n_frames) in enumerate(self.clips):
            lengths = af.level_lengths(n_frames, self.config.network.levels)
            speech = sequence.speech[None, :, :n_frames]
            styles = []
            if self.data.styles:
                same = torch.full((1, len(lengths)), sequence.style)
                styles = style_levels(same, len(self.data.styles), lengths)
            conditions = condition_levels(speech, lengths, self.config.residual, styles)
            noise = self._noise(sequence, lengths[0], number).to(device)
            made = network(
                [noise, *[None] * (levels - 1)],
                [level.to(device) for level in conditions[:levels]],
                lengths=lengths[:levels],
            )[-1]
            yield self._motion(resample(made, n_frames)[0].cpu())

    def _noise(self, sequence: PairedSequence, n_frames: int, number: int) -> Tensor:
        rng = generator(self.config.seed, "monitor", number)
        return torch.randn(1, 1, n_frames, generator=rng) * sequence.sigma[0]

    def _motion(self, normalised: Tensor) -> Motion:
        values = self.data.normaliser.inverse(normalised[None])[0].T
        return self.data.representation.decode(values.double().numpy(), self.config.fps)
