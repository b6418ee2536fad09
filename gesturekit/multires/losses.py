"""Losses of the multires system (section 3.4 of Moreno-Villamarin et al. 2024).

Equation numbers are those of the paper. `random_losses` says which loss acts at which level on
random steps; reconstruction steps have `reconstruction` alone. Each loss has the same name as a
function, as a setting and in the log.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from gesturekit.multires.config import LossConfig
from gesturekit.multires.kinematics import VectorKinematics
from gesturekit.multires.resampling import resample


@dataclass(frozen=True)
class LevelMotion:
    """Motion that a level generated on a random step, and what it is compared with.

    Attributes:
        values: (B, D, T) motion vectors in their own units, without margins.
        stride: full-rate frames between two of their frames.
        score: returns the discriminator's scores (B,).
        output: (B, D, T') normalised output of the level, with margins.
        coarser: (B, D, T'') that of the next coarser level; None at the first level.
        arms: (B, 2, T) log arm speed and acceleration, predicted from speech; None without.
        detail: returns the distance of the detail in joint positions (B, K, 3, T) from that of
            recordings, see `DetailTarget`; None without.
        state: returns the distance of the state that they show from the one that was given, see
            `StateTarget`; None without.
    """

    values: Tensor
    stride: float
    score: Callable[[], Tensor]
    output: Tensor
    coarser: Tensor | None
    arms: Tensor | None
    detail: Callable[[Tensor], Tensor] | None
    state: Callable[[Tensor], Tensor] | None


def random_losses(
    level: LevelMotion, kinematics: VectorKinematics, weights: LossConfig
) -> dict[str, Tensor]:
    """Return the weighted losses of one level on a random step, by name.

    The generators minimise their sum (eq. 11).
    """
    values, stride, n_frames = level.values, level.stride, level.values.shape[-1]
    # One frame, the coarsest level of a very short recording, has no speed.
    moves = n_frames > 1
    # Rounding makes strides of two levels straddle 2; half the full rate is meant.
    is_fine = weights.smooth_levels == "all" or stride < 2.05
    is_smooth = weights.smoothness and is_fine and n_frames > 2
    terms: dict[str, Tensor] = {}
    if weights.adversarial:
        terms["adversarial"] = adversarial(level.score())
    if weights.contact and moves:  # 0 on a rig without feet
        velocity = kinematics.foot_velocity(values, stride, weights.contact_time)
        squared = weights.contact_speed == "squared"
        labels = kinematics.contact_labels(values)
        terms["contact"] = contact(velocity, labels, weights.contact_slope, squared)
    if is_smooth or level.detail or level.state:
        places = kinematics.places(values)
        if is_smooth:
            terms["smoothness"] = smoothness(kinematics.bend(values, places, stride))
    if weights.coarse and level.coarser is not None:
        terms["coarse"] = coarse(resample(level.output, level.coarser.shape[-1]), level.coarser)
    if level.detail:
        terms["detail"] = level.detail(places)
    if level.state:
        terms["state"] = level.state(places)
    if level.arms is not None and moves:
        speed, acceleration = movement(kinematics.arm_movement(values, stride), level.arms)
        terms |= {"arm_speed": speed} if weights.arm_speed else {}
        terms |= {"arm_acceleration": acceleration} if weights.arm_acceleration else {}
    return {name: getattr(weights, name) * value for name, value in terms.items()}


def adversarial(scores: Tensor) -> Tensor:
    """Return the generator's part of eq. 12: minus the mean score of generated motions.

    Args:
        scores: (B,); a high score means that the discriminator classifies the motion as recorded.
    """
    return -scores.mean()


def discriminator_gap(fake_scores: Tensor, real_scores: Tensor) -> Tensor:
    """Return eq. 12, which discriminators minimise: mean score of fakes minus that of recordings.

    Args:
        fake_scores: (B,).
        real_scores: (B,).
    """
    return fake_scores.mean() - real_scores.mean()


def gradient_penalty(
    score: Callable[[Tensor], Tensor], real: Tensor, fake: Tensor, mix: Tensor, penalty_on: str
) -> Tensor:
    """Return eq. 13: the mean of (||grad D|| - 1)^2 between real and fake (Gulrajani et al. 2017).

    Args:
        score: discriminator; (B, D, T) to the (B,) mean scores of a motion's patches.
        real: (B, D, T).
        fake: (B, D, T).
        mix: (B, 1, 1) uniform in [0, 1], interpolation weights.
        penalty_on: gradient whose norm is penalised, see `LossConfig.penalty_on`.

    On a CPU, `backend: auto` computes it by hand-derived gradients (`multires/cpu/engine.py`),
    which a test compares with this definition: a change here is a change there.
    """
    between = (mix * fake + (1 - mix) * real).requires_grad_(True)
    (gradient,) = torch.autograd.grad(score(between).sum(), between, create_graph=True)
    if penalty_on == "frame":
        # GANimator differentiates the sum of T scores, not their mean.
        return ((gradient.norm(dim=1) * gradient.shape[-1] - 1) ** 2).mean()
    norm = gradient.flatten(1).norm(dim=1)
    if penalty_on == "window":
        # The score is a mean over T frames, so that the norm of its gradient falls as 1/sqrt(T).
        # Without this factor the penalty would depend on the length of the window.
        norm = norm * gradient.shape[-1] ** 0.5
    return ((norm - 1) ** 2).mean()


def contact(velocity: Tensor, labels: Tensor, slope: float = 10.0, squared: bool = True) -> Tensor:
    """Return eq. 14: the mean squared speed of feet, weighted by their contact labels.

    Args:
        velocity: (B, T, F, 3) of the foot points.
        labels: (B, T, F) as generated, about 0 or 1.
        slope: of the sigmoid on labels, which is 1/2 at a label of 1/2; 12 in GANimator.
        squared: whether to square the speed; GANimator does not.
    """
    speed = velocity.square().sum(dim=-1)
    if not squared:
        speed = (speed + 1e-12).sqrt()
    return (speed * torch.sigmoid(slope * labels - slope / 2)).mean()


def reconstruction(generated: Tensor, recorded: Tensor) -> Tensor:
    """Return eq. 15: the mean absolute error of normalised motion, both (B, D, T)."""
    return F.l1_loss(generated, recorded)


def smoothness(bend: Tensor) -> Tensor:
    """Return eq. 16: the mean distance of a joint from its mean over three frames, metres.

    Args:
        bend: (B, K, 3, T) second differences p_(t+1) - 2 p_t + p_(t-1), three times that distance.
    """
    # The small number keeps the gradient of the norm finite where nothing moves.
    return (bend.square().sum(dim=2) + 1e-12).sqrt().mean() / 3


def movement(generated: Tensor, wanted: Tensor) -> Tensor:
    """Return the mean absolute errors of log arm speed and acceleration, (2,); not in the paper.

    Args:
        generated: (B, 2, T).
        wanted: (B, 2, T), predicted from the speech.
    """
    return (generated - wanted).abs().mean(dim=(0, 2))


def coarse(generated: Tensor, given: Tensor) -> Tensor:
    """Return how much a level changes the coarser motion (mean absolute change); not in the paper.

    Args:
        generated: (B, D, T) motion of the level, resampled to the rate of the coarser one.
        given: (B, D, T) motion of the coarser level.
    """
    return F.l1_loss(generated, given)


def detail(generated: Tensor, recorded: Tensor) -> Tensor:
    """Return the energy distance of generated and recorded detail, up to a constant.

    Not in the paper.

    Args:
        generated: (N, K) log amplitudes of detail at each joint, N >= 2.
        recorded: (M, K).
    """
    n = len(generated)
    apart = (generated[:, None] - recorded).norm(dim=-1).mean()
    # The 1e-6 keeps the gradient of the norm finite on the diagonal, where differences are zero.
    among = ((generated[:, None] - generated).square().sum(dim=-1) + 1e-6).sqrt()
    return apart - 0.5 * (among.sum() / (n * (n - 1)))


def state(shown: Tensor, given: Tensor, weight: Tensor) -> Tensor:
    """Return the distance () of the state of movement that is shown from the one that was given.

    Not in the paper.

    Args:
        shown: (B, C, T) channels, measured from generated motion.
        given: (B, C, T) channels that this level should show.
        weight: (C, 1).
    """
    return (weight * (shown - given)).abs().mean()
