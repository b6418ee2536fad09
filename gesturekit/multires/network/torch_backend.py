"""Plain torch implementation of the operations that a backend can replace."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import TypeVar

import torch
from torch import Tensor

from gesturekit.multires import losses
from gesturekit.multires.config import LossConfig
from gesturekit.multires.network.discriminator import LevelDiscriminator
from gesturekit.multires.network.skeleton_conv import SkeletonConv1d, convolve_dense

T = TypeVar("T")


class TorchBackend:
    """Dense convolutions and autograd: the definition of what every backend computes.

    Args:
        reason: why this backend was chosen, for the log.
    """

    name = "torch"

    def __init__(self, reason: str) -> None:
        self.reason = reason

    def convolve(
        self, layers: Sequence[SkeletonConv1d], x: Tensor, slope: float, last_slope: float
    ) -> Tensor:
        """Return the output of a chain of convolutions; see `convolve_dense`."""
        return convolve_dense(layers, x, slope, last_slope)

    def discriminator_gradients(
        self,
        discriminators: Sequence[LevelDiscriminator],
        reals: Sequence[Tensor],
        fakes: Sequence[Tensor],
        mixes: Sequence[Tensor],
        config: LossConfig,
        styles: Sequence[Tensor | None],
    ) -> Tensor:
        """Set the parameters' `grad` to the gradients of the discriminator loss (eqs. 12 and 13).

        Args:
            discriminators: one per level; all following arguments have one entry per discriminator.
            reals: (B, D, T_i).
            fakes: (B, D, T_i).
            mixes: (B, 1, 1) uniform in [0, 1], interpolation weights of the gradient penalty.
            config: weights of the losses.
            styles: (B, K) one-hot, of each recording and of the fake with the same index; None for
                a discriminator without styles.

        Returns:
            (levels,) values of eq. 12, without weights.
        """
        return torch.stack(
            [
                self._level_gradients(*level, config)
                for level in zip(discriminators, reals, fakes, mixes, styles, strict=True)
            ]
        )

    def _level_gradients(
        self,
        discriminator: LevelDiscriminator,
        real: Tensor,
        fake: Tensor,
        mix: Tensor,
        style: Tensor | None,
        config: LossConfig,
    ) -> Tensor:
        def score(motions: Tensor) -> Tensor:
            repeats = len(motions) // len(real)
            repeated = None if style is None else torch.cat([style] * repeats)
            return discriminator(motions, repeated, self.convolve)

        gap = losses.discriminator_gap(*score(torch.cat([fake, real])).split(len(real)))
        penalty = losses.gradient_penalty(score, real, fake, mix, config.penalty_on)
        loss = config.discriminator_scale * gap + config.gradient_penalty * penalty
        parameters = list(discriminator.parameters())
        for parameter, gradient in zip(
            parameters, torch.autograd.grad(loss, parameters), strict=True
        ):
            parameter.grad = gradient
        return gap.detach()

    def run_tasks(self, *tasks: Callable[[], T]) -> list[T]:
        """Run independent tasks and return their results."""
        return [task() for task in tasks]

    def threads(self) -> AbstractContextManager[None]:
        """Return a context that shares the CPU threads between torch and this backend."""
        return nullcontext()
