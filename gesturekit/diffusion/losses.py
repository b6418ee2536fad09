"""Losses of the diffusion system: pure functions that return one value per clip."""

from __future__ import annotations

from torch import Tensor

from gesturekit.motion.contacts import CONTACT_SPEED

SLIDING = 0.1
"""m/s on the reference body, the unit of `foot_sliding`."""


def denoising_error(predicted: Tensor, target: Tensor) -> Tensor:
    """Return the squared error of the network's prediction, eq. 4 of Alexanderson et al. 2023.

    Args:
        predicted: (B, T, X) noise, velocity or clean motion, as predicted by the network.
        target: (B, T, X), its target.

    Returns:
        (B,), the mean over frames and features of each clip.
    """
    return (predicted - target).square().mean(dim=(1, 2))


def change_error(predicted: Tensor, target: Tensor, spread: Tensor) -> Tensor:
    """Return the squared error of frame-to-frame changes; not in the paper.

    Args:
        predicted: (B, T, X) clean motion, as predicted by the network.
        target: (B, T, X) clean motion.
        spread: (X,) standard deviation of the recordings' changes, the unit of the error.

    Returns:
        (B,), the mean over changes and features of each clip.
    """
    return ((predicted - target).diff(dim=1) / spread).square().mean(dim=(1, 2))


def foot_sliding(predicted: Tensor, recorded: Tensor) -> Tensor:
    """Return the sliding speed of feet that are planted in the recording; not in the paper.

    The foot contact loss of Tevet et al. 2023 (MDM), with bounded gradients: a speed s, in units of
    `SLIDING`, gives the loss 2 (sqrt(1 + s^2) - 1), which is about s^2 for small s and 2 s for
    large s.

    Args:
        predicted: (B, T, F, 3) velocity of F foot points, m/s on the reference body.
        recorded: (B, T, F, 3), of the recorded motion. A point slower than `CONTACT_SPEED` is
            planted.

    Returns:
        (B,), the mean over frames and points of each clip; points that are not planted count as 0.
    """
    stands = recorded.norm(dim=-1) < CONTACT_SPEED
    squared = (predicted / SLIDING).square().sum(dim=-1)
    return (stands * 2 * ((1 + squared).sqrt() - 1)).mean(dim=(1, 2))
