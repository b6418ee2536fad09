"""Losses of the multires system (section 3.4 of Moreno-Villamarin et al. 2024): pure functions.

Equations are those of the paper. `LossConfig` holds the weight of each.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def adversarial(scores: Tensor) -> Tensor:
    """Return the generators' part of eq. 12: minus the mean score of generated motions.

    Args:
        scores: (B,), high where the discriminator takes a motion for recorded.
    """
    return -scores.mean()


def critic_gap(fake_scores: Tensor, real_scores: Tensor) -> Tensor:
    """Return eq. 12, which discriminators descend: mean score of fakes less that of recordings.

    Args:
        fake_scores: (B,).
        real_scores: (B,).
    """
    return fake_scores.mean() - real_scores.mean()


def gradient_penalty(gradient: Tensor, penalty_on: str) -> Tensor:
    """Return eq. 13: the mean of (norm - 1)^2 of a score's gradient (Gulrajani et al. 2017).

    Args:
        gradient: (B, D, T) of each motion's mean score by the motion.
        penalty_on: whose norm, see `LossConfig.penalty_on`.
    """
    if penalty_on == "frame":
        # GANimator differentiates the sum of T scores, not their mean.
        return ((gradient.norm(dim=1) * gradient.shape[-1] - 1) ** 2).mean()
    norm = gradient.flatten(1).norm(dim=1)
    if penalty_on == "window":
        # The score is a mean over T frames, so its gradient shrinks as 1/sqrt(T) with length; long
        # windows would be punished for their length.
        norm = norm * gradient.shape[-1] ** 0.5
    return ((norm - 1) ** 2).mean()


def contact(velocity: Tensor, labels: Tensor, slope: float = 10.0, squared: bool = True) -> Tensor:
    """Return eq. 14: squared foot speed where the contact label says that the foot stands.

    Args:
        velocity: (B, T, F, 3) of the foot points, m/s.
        labels: (B, T, F) as generated, about 0 or 1.
        slope: of the sigmoid, which is 1/2 at a label of 1/2; 12 in GANimator.
        squared: False takes the speed itself, as GANimator does.
    """
    speed = velocity.square().sum(dim=-1)
    if not squared:
        speed = (speed + 1e-12).sqrt()
    return (speed * torch.sigmoid(slope * labels - slope / 2)).mean()


def reconstruction(generated: Tensor, recorded: Tensor) -> Tensor:
    """Return eq. 15: the mean absolute error of normalised motion, both (B, D, T)."""
    return F.l1_loss(generated, recorded)


def smoothness(bend: Tensor) -> Tensor:
    """Return eq. 16: the mean distance of a joint from the mean of three frames, metres.

    Args:
        bend: (B, K, 3, T) of joints, p_(t+1) - 2 p_t + p_(t-1), three times that distance.
    """
    # The small number keeps the gradient of the norm finite where nothing moves.
    return (bend.square().sum(dim=2) + 1e-12).sqrt().mean() / 3


def movement(generated: Tensor, wanted: Tensor) -> Tensor:
    """Return (2,) the mean absolute errors of log arm speed and acceleration; not in the paper.

    Args:
        generated: (B, 2, T).
        wanted: (B, 2, T), what the speech asks for.
    """
    return (generated - wanted).abs().mean(dim=(0, 2))


def coarse(generated: Tensor, given: Tensor) -> Tensor:
    """Return how far a level leaves what it was given, at the coarser rate; not in the paper.

    Args:
        generated: (B, D, T) of the level, brought to the frames of the level below.
        given: (B, D, T), what the level below made.
    """
    return F.l1_loss(generated, given)


def detail(generated: Tensor, recorded: Tensor) -> Tensor:
    """Return the energy distance, up to a constant, of generated and recorded detail.

    Not in the paper. At least two generated motions are needed to be a distribution.

    Args:
        generated: (N, K) log amplitudes of detail at each joint, N >= 2.
        recorded: (M, K).
    """
    n = len(generated)
    apart = (generated[:, None] - recorded).norm(dim=-1).mean()
    # The 1e-6 keeps the norm of a difference of nothing from having no derivative.
    among = ((generated[:, None] - generated).square().sum(dim=-1) + 1e-6).sqrt()
    return apart - 0.5 * (among.sum() / (n * (n - 1)))
