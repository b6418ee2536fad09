"""Losses of the diffusion system: pure functions of standardised motion, a value for each clip."""

from __future__ import annotations

from torch import Tensor


def denoising_error(predicted: Tensor, target: Tensor) -> Tensor:
    """Return the squared error of the network's prediction, eq. 4 of Alexanderson et al. 2023.

    Args:
        predicted: (B, T, X) noise, velocity or clean motion as the network predicts it.
        target: (B, T, X), its target.

    Returns:
        (B,), the mean over frames and features of each clip.
    """
    return (predicted - target).square().mean(dim=(1, 2))


def change_error(predicted: Tensor, target: Tensor, spread: Tensor) -> Tensor:
    """Return the squared error of the change from frame to frame; not in the paper.

    Args:
        predicted: (B, T, X) clean motion as the network predicts it.
        target: (B, T, X) clean motion.
        spread: (X,) standard deviation of the recordings' changes, the unit of the error.

    Returns:
        (B,), the mean over changes and features of each clip.
    """
    return ((predicted - target).diff(dim=1) / spread).square().mean(dim=(1, 2))
