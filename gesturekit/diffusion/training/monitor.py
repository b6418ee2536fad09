"""What a training run looks at now and then: cheap measures of what it would generate."""

from __future__ import annotations

from collections.abc import Iterator

import torch

from gesturekit.diffusion.config import DiffusionConfig
from gesturekit.diffusion.network.denoiser import Denoiser
from gesturekit.diffusion.sampling.noise_schedule import NoiseSchedule
from gesturekit.diffusion.sampling.solvers import chosen_steps, sample
from gesturekit.diffusion.training.data import TrainingData
from gesturekit.errors import MotionError
from gesturekit.evaluation.quick_metrics import quick_metrics
from gesturekit.motion.motion import Motion
from gesturekit.training.seeds import rng_for

MOST_CLIPS = 4
MOST_SECONDS = 20.0
"""Of the training recordings so many are danced or spoken again, and so much of each ..."""
STEPS = 10
"""... in so few steps."""


class Monitor:
    """Measures motion for what the training recordings are told, beside the recordings.

    Random numbers are its own, so that a run with it and one without come to the same weights.
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
        """Cheap measures (`quick_metrics`) of what a network generates, each time of one noise.

        There are none of a network that does not give motion yet.
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
            predict = network.listening(
                torch.from_numpy(condition)[None].to(device), chosen_steps(self.schedule, count)
            )

            def noise_of(noisy: torch.Tensor, step: int, predict=predict) -> torch.Tensor:
                return self.schedule.noise_of(predict(noisy, step), noisy, step)

            rng = rng_for(self.config.seed, "monitor", number)
            noise = torch.randn((1, *motion.shape), generator=rng).to(device)
            made = sample(noise_of, lambda k, n=noise: n, self.schedule, solver="dpm", steps=count)
            values = self.data.standardiser.inverse(made[0].cpu()).double().numpy()
            yield self.data.decode(values, condition, self.config.fps)
