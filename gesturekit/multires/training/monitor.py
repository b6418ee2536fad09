"""What a training run looks at now and then: cheap measures of what it would generate, samples to
look at, and an early word where the samples collapse."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import audio_features as af
from gesturekit.evaluation.quick_metrics import quick_metrics
from gesturekit.motion.motion import Motion
from gesturekit.multires.config import MultiresConfig
from gesturekit.multires.constraints.constraint import plain_values
from gesturekit.multires.network.generator import MultiresGenerator
from gesturekit.multires.network.resampling import resample
from gesturekit.multires.network.skeleton_conv import Convolve, convolve_dense
from gesturekit.multires.sampling.styles import style_levels
from gesturekit.multires.training.data import PairedSequence, TrainingData
from gesturekit.multires.training.window_cache import condition_levels, recall
from gesturekit.training.seeds import rng_for

MOST_CLIPS = 4
MOST_SECONDS = 20.0
"""Of the training recordings so many are spoken again, and so much of each."""
COLLAPSED = 0.4
"""Samples whose patches differ less than this share of what the recordings' do have collapsed."""
_PATCH_SECONDS = 1.0

log = logging.getLogger(__name__)


class Monitor:
    """Measures motion for the training speech (or style), beside its recordings.

    Random numbers are its own, so that a run with it and one without come to the same weights.
    """

    def __init__(
        self, data: TrainingData, config: MultiresConfig, convolve: Convolve = convolve_dense
    ) -> None:
        self.data = data
        self.convolve = convolve
        self.config = config
        self.clips = [
            (sequence, min(sequence.n_frames, round(MOST_SECONDS * config.fps)))
            for sequence in data.paired[:MOST_CLIPS]
        ]
        self.recordings = [self._motion(self._recorded(i)) for i in range(len(self.clips))]
        self.samples: list[Motion] = []
        self.recall = recall(data, config)

    def figures(self, network: MultiresGenerator, levels: int) -> dict[str, float]:
        """Cheap measures (`quick_metrics`) of what the first `levels` levels generate.

        The finest of them is interpolated to the full rate. Noise is the same every time.
        Beside them stands `patch_diversity_ratio`: how much the samples' patches of a second
        differ from one another, as a share of what the recordings' do at the same level.
        """
        made = [self._generated(network, levels, number) for number in range(len(self.clips))]
        self.samples = [self._motion(one) for one in made]
        figures = quick_metrics(self.samples, self.recordings)
        real = [self._at_level(self._recorded(number), levels) for number in range(len(made))]
        spread = self._patch_spread(real)
        if spread > 0:
            figures["patch_diversity_ratio"] = self._patch_spread(made) / spread
        return figures

    def warn_of_collapse(self, figures: Mapping[str, float], step: int) -> bool:
        """Say that the samples are (nearly) one pose or one movement; whether they are."""
        ratio = figures.get("patch_diversity_ratio", 1.0)
        if ratio >= COLLAPSED:
            return False
        log.warning(
            "Step %d: samples collapse: their patches differ %.2f times as much from one another "
            "as the recordings' do. If it stays so, try a lower training.learning_rate, more "
            "training.discriminator_steps, or fewer training.reconstruction_steps.",
            step,
            ratio,
        )
        return True

    def write_sample(self, folder: Path, step: int) -> None:
        """The first sample of the last `figures`, as step_00000300.bvh and .html."""
        folder.mkdir(parents=True, exist_ok=True)
        for suffix in ("bvh", "html"):
            self.samples[0].save(folder / f"step_{step:08d}.{suffix}")

    @torch.no_grad()
    def _generated(self, network: MultiresGenerator, levels: int, number: int) -> Tensor:
        """(D, T) normalised, what is made for a clip."""
        device = next(network.parameters()).device
        sequence, n_frames = self.clips[number]
        lengths = af.level_lengths(n_frames, self.config.network.levels)
        speech = sequence.speech[None, :, :n_frames]
        styles = []
        if self.data.styles:
            same = torch.full((1, len(lengths)), sequence.style)
            styles = style_levels(same, len(self.data.styles), lengths)
        conditions = condition_levels(speech, lengths, self.config.residual, styles)
        noises = self._noises(sequence, lengths[:levels], number)
        made = network(
            [None if noise is None else noise.to(device) for noise in noises],
            [level.to(device) for level in conditions[:levels]],
            lengths=lengths[:levels],
            convolve=self.convolve,
        )[-1]
        return resample(made, n_frames)[0].cpu()

    def _recorded(self, number: int) -> Tensor:
        """(D, T) normalised, the recording of a clip."""
        sequence, n_frames = self.clips[number]
        return sequence.motion[:, :n_frames]

    def _at_level(self, motion: Tensor, levels: int) -> Tensor:
        """(D, T) as the finest of so many levels can show it."""
        n_frames = motion.shape[-1]
        coarse = af.level_lengths(n_frames, self.config.network.levels)[levels - 1]
        return resample(resample(motion, coarse), n_frames)

    def _patch_spread(self, motions: list[Tensor]) -> float:
        """Root mean square distance between two patches of joint rotations, of all motions.

        Without sums over pairs: it is the spread of patches about the mean patch, up to a factor.
        """
        window = max(1, round(_PATCH_SECONDS * self.config.fps))
        joints = 6 * len(self.data.representation.joints)
        patches = [
            motion[:joints].unfold(1, min(window, motion.shape[1]), 1).transpose(0, 1)
            for motion in motions
            if motion.shape[1] >= window
        ]
        if not patches:
            return 0.0
        return float(torch.cat(patches).double().var(dim=0, correction=0).mean().sqrt())

    def _noises(
        self, sequence: PairedSequence, lengths: Sequence[int], number: int
    ) -> list[Tensor | None]:
        """Of each level, as the model will be given it."""
        rng = rng_for(self.config.seed, "monitor", number)
        noises: list[Tensor | None] = [
            torch.randn(1, 1, n, generator=rng) * sigma if i < self.config.noise_levels else None
            for i, (n, sigma) in enumerate(zip(lengths, sequence.sigma, strict=False))
        ]
        if self.recall is not None:
            noises[0] = self.recall([sequence.style] * lengths[0], rng)
        return noises

    def _motion(self, vectors: Tensor) -> Motion:
        values = plain_values(self.data.normaliser, vectors[None])
        return self.data.representation.decode(values, self.config.fps)


def distance_from_recordings(figures: Mapping[str, float]) -> float:
    """How far samples are from the recordings: the least is the best checkpoint.

    The mean of |log| over all ratios to the recordings' own figures (speeds, jerk, diversity ...);
    infinite without any, or with one of nothing.
    """
    ratios = [value for name, value in figures.items() if name.endswith("_ratio")]
    if not ratios or min(ratios) <= 0:
        return math.inf
    return float(np.mean(np.abs(np.log(ratios))))
