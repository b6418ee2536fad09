"""Training monitor: cheap metrics of generated motion, computed at intervals."""

from __future__ import annotations

from collections.abc import Iterator

import torch

from gesturekit.diffusion.config import DiffusionConfig
from gesturekit.diffusion.network.denoiser import Denoiser
from gesturekit.diffusion.noise_schedule import NoiseSchedule
from gesturekit.diffusion.sampling.experts import Expert
from gesturekit.diffusion.sampling.solvers import sample
from gesturekit.diffusion.training.data import TrainingData
from gesturekit.errors import MotionError
from gesturekit.evaluation.measuring.clip_metrics import quick_metrics
from gesturekit.motion.motion import Motion
from gesturekit.training.seeds import rng_for

MOST_CLIPS = 4
MOST_SECONDS = 20.0
"""Number of training recordings whose conditions are used, and length of each."""
STEPS = 10
"""Number of denoising steps."""


class Monitor:
    """Metrics of motion generated from the training recordings' conditions.

    It draws from its own random generator, so that training gives the same weights with and without
    it.
    """

    def __init__(self, data: TrainingData, config: DiffusionConfig) -> None:
        self.data = data
        self.config = config
        self.schedule = NoiseSchedule.of(config.noise)
        most = round(MOST_SECONDS * config.fps)
        paired = [recording for recording in data.recordings if recording.is_paired]
        self.clips = [
            (recording.motion[:most], recording.condition[:most])
            for recording in paired[:MOST_CLIPS]
        ]
        self.recordings = [data.decode(*clip, config.fps) for clip in self.clips]

    def figures(self, network: Denoiser) -> dict[str, float]:
        """Return cheap metrics (`quick_metrics`) of motion generated from the same noise each time.

        Return nothing while the network does not generate valid motion.
        """
        try:
            return quick_metrics(list(self._generated(network)), self.recordings)
        except MotionError:
            return {}

    @torch.no_grad()
    def _generated(self, network: Denoiser) -> Iterator[Motion]:
        device = next(network.parameters()).device
        count = min(STEPS, self.schedule.steps)
        for number, (motion, condition) in enumerate(self.clips):
            expert = Expert(network, self.schedule, torch.from_numpy(condition)[None].to(device))
            rng = rng_for(self.config.seed, "monitor", number)
            noise = torch.randn((1, *motion.shape), generator=rng).to(device)
            made = sample(
                expert.predict, lambda k, n=noise: n, self.schedule, solver="dpm", steps=count
            )
            values = self.data.normaliser.inverse(made[0].cpu()).double().numpy()
            yield self.data.decode(values, condition, self.config.fps)
