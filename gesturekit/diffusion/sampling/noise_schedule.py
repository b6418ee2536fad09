"""How much of a motion and how much noise there is at each step of the diffusion.

Steps count from 0, where hardly any noise has been added, to N - 1; the paper's n is one more.
At step n a noisy motion is sqrt(abar_n) clean + sqrt(1 - abar_n) noise. Everything is kept in
double precision: the published schedule ends at abar = 6e-26.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gesturekit.diffusion.config import NoiseConfig
from gesturekit.errors import ModelError

Step = int | Tensor
"""A step of the diffusion, or (B,) of them, one for each clip of a batch."""


@dataclass(frozen=True)
class NoiseSchedule:
    """A variance-preserving schedule.

    Attributes:
        betas: (N,) float64, the variance of the noise that each step adds.
        alphas_bar: (N,) float64, the share of the clean motion's variance that is left.
        predicts: what networks on this schedule predict: "noise", "velocity" or "clean".
    """

    betas: Tensor
    alphas_bar: Tensor
    predicts: str

    @classmethod
    def of(cls, config: NoiseConfig) -> NoiseSchedule:
        """The linear schedule of the paper."""
        betas = torch.linspace(
            config.first_beta, config.last_beta, config.steps, dtype=torch.float64
        )
        return cls(betas, torch.cumprod(1 - betas, 0), config.predict)

    @property
    def steps(self) -> int:
        """N."""
        return len(self.betas)

    def log_snr(self) -> Tensor:
        """(N,) float64: log of abar / (1 - abar), falling."""
        return torch.log(self.alphas_bar) - torch.log1p(-self.alphas_bar)

    def scales(self, step: Step, like: Tensor) -> tuple[Tensor, Tensor]:
        """(signal, noise): the factors of clean motion and noise, to multiply (B, T, X) by.

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
        """What q(x_n | x_0) makes of a clean motion and standard normal noise, both (B, T, X)."""
        signal, spread = self.scales(step, clean)
        return signal * clean + spread * noise

    def velocity(self, clean: Tensor, noise: Tensor, step: Step) -> Tensor:
        """signal * noise - spread * clean: what a velocity network learns (Salimans and Ho)."""
        signal, spread = self.scales(step, clean)
        return signal * noise - spread * clean

    def target(self, clean: Tensor, noise: Tensor, step: Step) -> Tensor:
        """What a network on this schedule should predict for `add_noise(clean, noise, step)`."""
        if self.predicts == "velocity":
            return self.velocity(clean, noise, step)
        return noise if self.predicts == "noise" else clean

    def noise_of(self, prediction: Tensor, noisy: Tensor, step: Step) -> Tensor:
        """The noise, from what a network on this schedule predicts."""
        if self.predicts == "noise":
            return prediction
        signal, spread = self.scales(step, noisy)
        if self.predicts == "velocity":
            return spread * noisy + signal * prediction
        return (noisy - signal * prediction) / spread

    def clean_of(self, noise: Tensor, noisy: Tensor, step: Step) -> Tensor:
        """The clean motion, from a noisy one and its noise.

        Where next to nothing of the motion is left, rounding errors of the noise are blown up by
        1 / signal; samplers do not ask for it there.
        """
        signal, spread = self.scales(step, noisy)
        return (noisy - spread * noise) / signal

    def loss_weight(self, step: Tensor, gamma: float | None) -> Tensor:
        """Min-SNR weights (Hang et al. 2023) of the squared error of each clip's prediction.

        With s = abar / (1 - abar): min(s, gamma) / s for noise, min(s, gamma) / (s + 1) for
        velocity, min(s, gamma) for the clean motion; all weigh the error of the clean motion by
        min(s, gamma). `gamma=None` weighs all steps alike, as the paper does.

        Returns:
            (B,) float32 on the device of `step`.
        """
        if gamma is None:
            return torch.ones(len(step), device=step.device)
        snr = self.log_snr().exp()
        own = {"noise": snr, "velocity": snr + 1, "clean": torch.ones_like(snr)}[self.predicts]
        weights = snr.clamp(max=gamma) / own
        return weights[step.cpu()].to(step.device, torch.float32)
