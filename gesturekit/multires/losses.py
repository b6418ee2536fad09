"""Losses of the multires system (section 3.4 of Moreno-Villamarin et al. 2024): pure functions.

Equation numbers are those of the paper. `losses` weights the generators' losses by `LossConfig`;
each loss has the same name as a function, as a setting and in the log.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from gesturekit.multires.config import LossConfig


@dataclass(frozen=True)
class LossInputs:
    """Tensors of one level that `losses` compares; a loss whose tensors are None is left out.

    Attributes:
        scores: (B,) discriminator scores of the generated motions.
        foot_velocity: (B, T - 1, F, 3) of the generated foot points, m/s or as
            `LossConfig.contact_time` says.
        contact_labels: (B, T - 1, F) as generated, about 0 or 1.
        bend: (B, K, 3, T - 2) second differences of the generated joint positions, metres.
        arms: (B, 2, T) log arm speed and acceleration, as generated.
        arm_target: (B, 2, T) the same, predicted from speech.
        downsampled: (B, D, T') generated motion, resampled to the frames of the next coarser level.
        coarser: (B, D, T') motion of the next coarser level.
        detail: () energy distance between generated and recorded detail, see `DetailTarget`.
        state: () distance from the state of movement that was given, see `StateTarget`.
        generated: (B, D, T) normalised motion of a reconstruction step.
        recorded: (B, D, T) the recording that it should reproduce.
    """

    scores: Tensor | None = None
    foot_velocity: Tensor | None = None
    contact_labels: Tensor | None = None
    bend: Tensor | None = None
    arms: Tensor | None = None
    arm_target: Tensor | None = None
    downsampled: Tensor | None = None
    coarser: Tensor | None = None
    detail: Tensor | None = None
    state: Tensor | None = None
    generated: Tensor | None = None
    recorded: Tensor | None = None


def losses(inputs: LossInputs, weights: LossConfig) -> dict[str, Tensor]:
    """Return the weighted losses of one level by name; the generators minimise their sum (eq. 11).

    Args:
        inputs: generated tensors, and the tensors with which they are compared.
        weights: one for each loss.
    """
    values: dict[str, Tensor] = {}
    if inputs.scores is not None:
        values["adversarial"] = adversarial(inputs.scores)
    if inputs.foot_velocity is not None and inputs.contact_labels is not None:
        values["contact"] = contact(
            inputs.foot_velocity,
            inputs.contact_labels,
            weights.contact_slope,
            squared=weights.contact_speed == "squared",
        )
    if inputs.bend is not None:
        values["smoothness"] = smoothness(inputs.bend)
    if inputs.coarser is not None and inputs.downsampled is not None:
        values["coarse"] = coarse(inputs.downsampled, inputs.coarser)
    if inputs.detail is not None:
        values["detail"] = inputs.detail
    if inputs.state is not None:
        values["state"] = inputs.state
    if inputs.arms is not None and inputs.arm_target is not None:
        speed, acceleration = movement(inputs.arms, inputs.arm_target)
        if weights.arm_speed:
            values["arm_speed"] = speed
        if weights.arm_acceleration:
            values["arm_acceleration"] = acceleration
    if inputs.generated is not None and inputs.recorded is not None:
        values["reconstruction"] = reconstruction(inputs.generated, inputs.recorded)
    return {name: getattr(weights, name) * value for name, value in values.items()}


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
