"""Monitoring of a training run: cheap metrics, samples to look at, and a warning of collapse."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gesturekit.evaluation.measuring.clip_metrics import quick_metrics
from gesturekit.motion.motion import Motion
from gesturekit.multires.config import MultiresConfig
from gesturekit.multires.networks import Convolve, MultiresGenerator, convolve_dense
from gesturekit.multires.resampling import resample
from gesturekit.multires.training.data import TrainingData
from gesturekit.multires.training.state import TrainingState
from gesturekit.multires.training.windows import random_noise
from gesturekit.training.seeds import rng_for

MAX_EXCERPTS = 4
MAX_SECONDS = 20.0
"""Number of training recordings whose beginnings are compared, and the length of each."""
COLLAPSED = 0.4
"""Patch diversity, relative to the recordings', below which samples have collapsed."""
_PATCH_SECONDS = 1.0

log = logging.getLogger(__name__)


class Monitor:
    """Compare motion generated for training speech or styles with the recordings.

    Uses a separate random generator, so that a run has the same weights with and without it.
    """

    def __init__(
        self,
        data: TrainingData,
        config: MultiresConfig,
        convolve: Convolve = convolve_dense,
        state: TrainingState | None = None,
    ) -> None:
        self.data, self.config, self.convolve, self.state = data, config, convolve, state
        self.excerpts = [
            (sequence, min(sequence.n_frames, round(MAX_SECONDS * config.fps)))
            for sequence in data.paired[:MAX_EXCERPTS]
        ]
        self.recordings = [self._motion(sequence.motion[:, :n]) for sequence, n in self.excerpts]
        self.samples: list[Motion] = []
        self.noise = random_noise(data, config, config.noise_levels)

    def metrics(self, network: MultiresGenerator, levels: int) -> dict[str, float]:
        """Return cheap metrics (`quick_metrics`) of motion from the first `levels` levels.

        The finest of these levels is interpolated to the full rate. Noise is the same every time.
        `patch_diversity_ratio` is added: the spread of the samples' one-second patches, relative to
        that of the recordings at the same level.
        """
        generated = [self._generated(network, levels, i) for i in range(len(self.excerpts))]
        self.samples = [self._motion(vectors) for vectors in generated]
        metrics = quick_metrics(self.samples, self.recordings)
        real = []
        for sequence, n_frames in self.excerpts:
            coarse = self.config.network.lengths(n_frames)[levels - 1]
            recorded = sequence.motion[:, :n_frames]
            real.append(resample(resample(recorded, coarse), n_frames))
        spread = self._patch_spread(real)
        if spread > 0:
            metrics["patch_diversity_ratio"] = self._patch_spread(generated) / spread
        return metrics

    def warn_of_collapse(self, metrics: Mapping[str, float], step: int) -> bool:
        """Warn if the samples are (nearly) one pose or one movement; return True if so."""
        ratio = metrics.get("patch_diversity_ratio", 1.0)
        if ratio >= COLLAPSED:
            return False
        log.warning(
            "Step %d: mode collapse: patches of the samples differ from one another %.2f times as "
            "much as those of the recordings. If this continues, try a lower "
            "training.learning_rate, more training.discriminator_steps, or fewer "
            "training.reconstruction_steps.",
            *(step, ratio),
        )
        return True

    def write_sample(self, folder: Path, step: int) -> None:
        """Write the first sample of the last `metrics`, as step_00000300.bvh and .html."""
        folder.mkdir(parents=True, exist_ok=True)
        for suffix in ("bvh", "html"):
            self.samples[0].save(folder / f"step_{step:08d}.{suffix}")

    @torch.no_grad()
    def _generated(self, network: MultiresGenerator, levels: int, number: int) -> Tensor:
        """Return the motion generated for an excerpt, (D, T) normalised."""
        device, given = next(network.parameters()).device, self.data.conditions
        sequence, n_frames = self.excerpts[number]
        lengths = self.config.network.lengths(n_frames)
        speech = sequence.speech[:, :n_frames][None]
        rng, state = rng_for(self.config.seed, "monitor", number), None
        noises = self.noise.gaussian(lengths[:levels], lambda _: rng)
        noises[0] = self.noise.shuffled(noises[0], [[sequence.style] * lengths[0]], rng)
        if self.state is not None:
            state = self.state.drawn(speech[0], sequence.style, rng)
            noises = self.noise.clocked(state, given.n_carriers, lengths[:levels])
        styles = torch.full((1, len(lengths)), sequence.style)
        conditions = given.of_batch(speech, lengths, styles, state)
        output = network(
            [None if noise is None else noise.to(device) for noise in noises],
            [level.to(device) for level in conditions[:levels]],
            lengths=lengths[:levels],
            convolve=self.convolve,
        )[-1]
        return resample(output, n_frames)[0].cpu()

    def _patch_spread(self, motions: Sequence[Tensor]) -> float:
        """Return the standard deviation of patches of joint rotations, over all motions (D, T).

        It equals the root mean square distance between two patches up to a constant factor.
        """
        rotations = self.data.representation.layout.rotations
        window = max(1, round(_PATCH_SECONDS * self.config.fps))
        long = [motion[rotations] for motion in motions if motion.shape[1] >= window]
        patches = [motion.unfold(1, window, 1).transpose(0, 1) for motion in long]
        if not patches:
            return 0.0
        return float(torch.cat(patches).double().var(dim=0, correction=0).mean().sqrt())

    def _motion(self, vectors: Tensor) -> Motion:
        """Return the motion of normalised vectors (D, T)."""
        values = self.data.normaliser.to_values(vectors[None])
        return self.data.representation.decode(values, self.config.fps)


def distance_from_recordings(metrics: Mapping[str, float]) -> float:
    """Return the distance of samples from the recordings; the best checkpoint has the smallest.

    It is the mean of |log| over all ratios to the recordings' own metrics (speeds, jerk, diversity
    ...), and infinite without ratios or if one is 0.
    """
    ratios = [value for name, value in metrics.items() if name.endswith("_ratio")]
    if not ratios or min(ratios) <= 0:
        return math.inf
    return float(np.mean(np.abs(np.log(ratios))))
