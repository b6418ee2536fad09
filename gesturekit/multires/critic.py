"""One discriminator step by hand: the loss and its gradients without recording anything.

The gradient penalty wants the derivative of a gradient, which autograd finds by going through the
networks six times, two of them with zeros: leaky rectifiers bend only at a point, so that the
network is linear around every input. Here one pass forward and one back over fakes, recordings and
the points between them serve both the score and the penalty; the penalty's own derivative is one
more pass forward, of the direction in which the gradient should grow; and all gradients of weights
are one product.
"""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from gesturekit.multires.config import LossConfig
from gesturekit.multires.interpolation import reflect
from gesturekit.multires.live_conv import Rows
from gesturekit.multires.networks import SLOPE, LevelDiscriminator, gradient_penalty
from gesturekit.multires.skeleton_conv import rectified


def critic_gradients(
    critic: LevelDiscriminator,
    real: Tensor,
    fake: Tensor,
    mix: Tensor,
    losses: LossConfig,
    told: Tensor | None = None,
) -> Tensor:
    """Give the critic's parameters the gradients of its loss on these motions.

    The loss is `critic_scale` times the gap, score of fakes less score of recordings, plus the
    gradient penalty (eqs. 12 and 13). By hand where `live_conv` runs, else by autograd.

    Args:
        real: (B, D, T).
        fake: the same shape.
        mix: (B, 1, 1), uniform in [0, 1], where between them the penalty is taken.
        told: (B, K) style of each recording and of the fake beside it; None where nothing is told.

    Returns:
        the gap, a number.
    """
    if all(conv.is_live(real) for conv in critic.layers):
        return _by_hand(critic, real, fake, mix, losses, told)
    twice = None if told is None else torch.cat([told, told])
    scores = critic(torch.cat([fake, real]), twice).mean(dim=(1, 2))
    gap = scores[: len(fake)].mean() - scores[len(fake) :].mean()
    penalty = gradient_penalty(critic, real, fake, mix, losses.penalty_on == "frame", told)
    loss = losses.critic_scale * gap + losses.gradient_penalty * penalty
    parameters = list(critic.parameters())
    for parameter, gradient in zip(parameters, torch.autograd.grad(loss, parameters), strict=True):
        parameter.grad = gradient
    return gap.detach()


@torch.no_grad()
def _by_hand(
    critic: LevelDiscriminator,
    real: Tensor,
    fake: Tensor,
    mix: Tensor,
    losses: LossConfig,
    told: Tensor | None,
) -> Tensor:
    count, _, n_frames = real.shape
    # Fakes, recordings and the points between them; the penalty is on the last ones alone.
    whole, between = Rows(3 * count, n_frames), Rows(count, n_frames)
    scored, penalised = whole.part(0, 2 * count), whole.part(2 * count, count)
    motion = torch.cat([fake, real, torch.lerp(real, fake, mix)])
    weights = [conv.live_weights() for conv in critic.layers]
    wirings = [conv.wiring for conv in critic.layers]

    signals = [whole.mirrored(motion)]
    for conv, wiring, weight in zip(critic.layers, wirings, weights, strict=True):
        signals.append(wiring.forward(weight, conv.bias, signals[-1], whole, SLOPE))

    # The mean over time of the last convolution is a weighted sum of what goes into it.
    taken = _taken(n_frames, critic.score.kernel_size[0])
    heads = critic.score.weight
    if told is not None:
        heads = heads + torch.einsum("bk,kct->bct", told.repeat(3, 1), critic.styled.weight)
    slope = (heads @ taken).transpose(0, 1)
    last = whole.frames(signals[-1])
    scores = (last * slope).sum(dim=(0, 2)) + critic.score.bias
    seeds = torch.full((3 * count, 1), losses.critic_scale / count)
    seeds[count : 2 * count] *= -1
    seeds[2 * count :] = 1

    gradient = whole.zeros(len(slope))
    torch.mul(slope, seeds, out=whole.frames(gradient))
    gradients = [rectified(gradient, signals[-1], SLOPE)]
    for i in reversed(range(1, len(weights))):
        gradient = wirings[i].input_gradient(weights[i], gradient, whole, signals[i], SLOPE)
        gradients.insert(0, gradient)
    own = between.cut(gradient, whole, 2 * count)
    gradient = wirings[0].input_gradient(weights[0], own, between)

    towards = between.mirror(_penalty_gradient(gradient, between, losses))
    total = last[:, :count] - last[:, count : 2 * count]
    total *= losses.critic_scale / count
    # What goes in is, for the penalty, the direction in which its gradient should grow.
    for i, conv in enumerate(critic.layers):
        signals[i][:, penalised] = towards[:, between.part(0, count)]
        conv.weight.grad = conv.live_gradient(signals[i], gradients[i], whole)
        conv.bias.grad = gradients[i][:, scored].sum(dim=1)
        own = between.cut(signals[i + 1], whole, 2 * count)
        towards = wirings[i].forward_along(weights[i], towards, between, own, SLOPE)
    total += between.frames(towards)
    of_each = total.transpose(0, 1) @ taken.T
    critic.score.weight.grad = of_each.sum(dim=0, keepdim=True)
    if told is not None:
        critic.styled.weight.grad = torch.einsum("bk,bct->kct", told, of_each)
    critic.score.bias.grad = torch.zeros_like(critic.score.bias)
    return scores[:count].mean() - scores[count : 2 * count].mean()


def _penalty_gradient(gradient: Tensor, rows: Rows, losses: LossConfig) -> Tensor:
    """Of the penalty, by the gradient that it is on; both in rows."""
    frames = rows.frames(gradient)
    per_frame = losses.penalty_on == "frame"
    norm = frames.square().sum(dim=0 if per_frame else (0, 2), keepdim=True).sqrt()
    scale = 1.0 if per_frame else rows.n_frames**0.5
    terms = rows.batch * (rows.n_frames if per_frame else 1)
    # (s |g| - 1)^2; where g is zero any direction would do, and none is taken.
    factor = torch.where(norm > 0, 2 * scale * (scale * norm - 1) / norm, 0)
    frames *= factor * (losses.gradient_penalty / terms)
    return gradient


@lru_cache(maxsize=64)
def _taken(n_frames: int, kernel: int) -> Tensor:
    """(taps, T): how often the mean over time of a mirrored convolution takes a frame by a tap."""
    frames = torch.eye(n_frames)
    windows = reflect(frames, kernel // 2).unfold(-1, kernel, 1)
    return windows.sum(dim=1).T / n_frames
