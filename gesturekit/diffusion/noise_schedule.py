"""The noise schedule: shares of signal and noise at each step of the diffusion.

Steps count from 0 (least noise) to N - 1; the paper's n is one more. At step n, a noisy motion is
sqrt(abar_n) clean + sqrt(1 - abar_n) noise. All values are in double precision: the published
schedule ends at abar = 6e-26.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gesturekit.diffusion.config import NoiseConfig
from gesturekit.errors import ModelError

Step = int | Tensor
"""A step of the diffusion, or steps (B,), one for each clip of a batch."""


@dataclass(frozen=True)
class NoiseSchedule:
    """A variance-preserving schedule.

    Attributes:
        betas: (N,) float64 variance of the noise that each step adds.
        alphas_bar: (N,) float64 remaining share of the clean motion's variance.
        predicts: prediction target of the network: "noise", "velocity" or "clean".
    """

    betas: Tensor
    alphas_bar: Tensor
    predicts: str

    @classmethod
    def of(cls, config: NoiseConfig) -> NoiseSchedule:
        """Return the linear schedule of the paper."""
        betas = torch.linspace(
            config.first_beta, config.last_beta, config.steps, dtype=torch.float64
        )
        return cls(betas, torch.cumprod(1 - betas, 0), config.predict)

    @property
    def steps(self) -> int:
        """N, the number of steps."""
        return len(self.betas)

    def log_snr(self) -> Tensor:
        """Return the log signal-to-noise ratio log(abar / (1 - abar)), (N,) float64, decreasing."""
        return torch.log(self.alphas_bar) - torch.log1p(-self.alphas_bar)

    def scales(self, step: Step, like: Tensor) -> tuple[Tensor, Tensor]:
        """Return the factors (signal, noise) of clean motion and noise, which broadcast to `like`.

        Raises:
            ModelError: the schedule has no such step.
        """
        index = torch.as_tensor(step, dtype=torch.long, device="cpu")
        if index.numel() and not 0 <= int(index.min()) <= int(index.max()) < self.steps:
            raise ModelError(
                f"step: {index.tolist()} is not within the noise schedule, which has steps 0 to "
                f"{self.steps - 1}"
            )
        kept = self.alphas_bar[index]
        shape = (-1, *(1,) * (like.ndim - 1)) if index.ndim else ()
        signal, noise = kept.sqrt().reshape(shape), (1 - kept).sqrt().reshape(shape)
        # 0-dimensional factors stay on the CPU, where they combine with tensors of any device.
        device = like.device if index.ndim else None
        return signal.to(device, like.dtype), noise.to(device, like.dtype)

    def add_noise(self, clean: Tensor, noise: Tensor, step: Step) -> Tensor:
        """Sample q(x_n | x_0), (B, T, X), from clean motion and standard normal noise."""
        signal, spread = self.scales(step, clean)
        return signal * clean + spread * noise

    def velocity(self, clean: Tensor, noise: Tensor, step: Step) -> Tensor:
        """Return the velocity, signal * noise - spread * clean (Salimans and Ho 2022)."""
        signal, spread = self.scales(step, clean)
        return signal * noise - spread * clean

    def target(self, clean: Tensor, noise: Tensor, step: Step) -> Tensor:
        """Return the prediction target (B, T, X) for `add_noise(clean, noise, step)`."""
        if self.predicts == "velocity":
            return self.velocity(clean, noise, step)
        return noise if self.predicts == "noise" else clean

    def noise_of(self, prediction: Tensor, noisy: Tensor, step: Step) -> Tensor:
        """Convert a network's prediction (B, T, X) to noise."""
        if self.predicts == "noise":
            return prediction
        signal, spread = self.scales(step, noisy)
        if self.predicts == "velocity":
            return spread * noisy + signal * prediction
        return (noisy - signal * prediction) / spread

    def loss_weight(self, step: Tensor, gamma: float | None) -> Tensor:
        """Return the min-SNR weight (Hang et al. 2023) of each clip's squared error.

        With s = abar / (1 - abar), the weight is min(s, gamma) / s for noise, min(s, gamma) /
        (s + 1) for velocity, and min(s, gamma) for clean motion. Each is equivalent to a weight of
        min(s, gamma) on the error of the clean motion. `gamma=None` gives 1, as in the paper.

        Returns:
            (B,) float32 on the device of `step`.
        """
        if gamma is None:
            return torch.ones(len(step), device=step.device)
        snr = self.log_snr().exp()
        own = {"noise": snr, "velocity": snr + 1, "clean": torch.ones_like(snr)}[self.predicts]
        weights = snr.clamp(max=gamma) / own
        return weights[step.cpu()].to(step.device, torch.float32)
