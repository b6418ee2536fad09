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
import torch.nn.functional as F
from torch import Tensor

from gesturekit.multires.config import LossConfig
from gesturekit.multires.interpolation import reflect
from gesturekit.multires.networks import SLOPE, LevelDiscriminator, gradient_penalty
from gesturekit.multires.part_conv import Layout


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
    gradient penalty (eqs. 12 and 13). By hand where `part_conv` runs, else by autograd.

    Args:
        real: (B, D, T).
        fake: the same shape.
        mix: (B, 1, 1), uniform in [0, 1], where between them the penalty is taken.
        told: (B, K) style of each recording and of the fake beside it; None where nothing is told.

    Returns:
        the gap, a number.
    """
    if all(conv.in_parts(real) for conv in critic.layers):
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
    kernel = critic.score.kernel_size[0]
    whole, some = (Layout(n, n_frames, kernel // 2) for n in (3 * count, count))
    scored = 2 * some.row  # columns of fakes and recordings; those between them follow
    motion = torch.cat([fake, real, torch.lerp(real, fake, mix)])
    parts = [conv.parts for conv in critic.layers]
    forward = [conv.forward_weights() for conv in critic.layers]

    signals, seen = [whole.pack(motion, parts[0].order_in)], []
    for conv, part, weights in zip(critic.layers, parts, forward, strict=True):
        bias = conv.bias[part.order_out]
        made, saw = part.forward(weights, bias, whole.mirror(signals[-1]), whole)
        signals.append(F.leaky_relu_(made, SLOPE))
        seen.append(saw)

    # The mean over time of the last convolution is a weighted sum of what goes into it.
    taken = _taken(n_frames, kernel)
    order, back = parts[-1].order_out, parts[-1].back_out
    heads = critic.score.weight
    if told is not None:
        heads = heads + torch.einsum("bk,kct->bct", told.repeat(3, 1), critic.styled.weight)
    heard = Layout(len(heads), n_frames, 0)
    slope = heard.windows(heard.pack(heads @ taken, order))
    last = whole.windows(signals[-1])
    scores = (last * slope).sum(dim=(0, 1, 3)) + critic.score.bias
    seeds = torch.full((3 * count, 1), losses.critic_scale / count)
    seeds[count : 2 * count] *= -1
    seeds[2 * count :] = 1

    gradient = whole.empty(len(order))
    torch.mul(slope, seeds, out=whole.windows(gradient))
    spreads = []
    for i in reversed(range(len(parts))):
        gradient = _rectified(gradient, signals[i + 1])
        spreads.insert(0, parts[i].spread(gradient, whole))
        if i:
            reverse = critic.layers[i].reverse_weights()
            gradient = parts[i].input_gradient(reverse, spreads[0], whole)
    reverse, between = critic.layers[0].reverse_weights(), spreads[0][..., scored:]
    gradient = parts[0].input_gradient(reverse, between, some)

    towards = _penalty_gradient(gradient, some, losses)
    total = some.empty(len(order))
    torch.sub(last[:, :, :count], last[:, :, count : 2 * count], out=some.windows(total))
    some.windows(total).mul_(losses.critic_scale / count)
    for i, (conv, part, weights) in enumerate(zip(critic.layers, parts, forward, strict=True)):
        towards, moved = part.forward(weights, None, some.mirror(towards), some)
        for own, other in zip(seen[i], moved, strict=True):
            own[..., scored:] = other
        here = whole.windows(signals[i + 1])[:, :, 2 * count :]
        _rectify(some.windows(towards), here)
        conv.weight.grad = part.weight_gradient(spreads[i], seen[i])
        conv.bias.grad = part.bias_gradient(spreads[i][..., :scored])[part.back_out]
    of_each = some.unpack(total + towards, back) @ taken.T
    critic.score.weight.grad = of_each.sum(dim=0, keepdim=True)
    if told is not None:
        critic.styled.weight.grad = torch.einsum("bk,bct->kct", told, of_each)
    critic.score.bias.grad = torch.zeros_like(critic.score.bias)
    return scores[:count].mean() - scores[count : 2 * count].mean()


def _penalty_gradient(gradient: Tensor, layout: Layout, losses: LossConfig) -> Tensor:
    """Of the penalty, by the gradient that it is on; both in the layout."""
    windows = layout.windows(gradient)
    per_frame = losses.penalty_on == "frame"
    norm = windows.square().sum(dim=1 if per_frame else (0, 1, 3), keepdim=True).sqrt()
    scale = 1.0 if per_frame else layout.n_frames**0.5
    terms = layout.batch * (layout.n_frames if per_frame else 1)
    # (s |g| - 1)^2; where g is zero any direction would do, and none is taken.
    factor = torch.where(norm > 0, 2 * scale * (scale * norm - 1) / norm, 0)
    windows *= factor * (losses.gradient_penalty / terms)
    return gradient


def _rectified(gradient: Tensor, signal: Tensor) -> Tensor:
    _rectify(gradient, signal)
    return gradient


def _rectify(gradient: Tensor, signal: Tensor) -> None:
    """Back through a leaky rectifier that gave this signal, in place."""
    torch.ops.aten.leaky_relu_backward.grad_input(
        gradient, signal, SLOPE, True, grad_input=gradient
    )


@lru_cache(maxsize=64)
def _taken(n_frames: int, kernel: int) -> Tensor:
    """(taps, T): how often the mean over time of a mirrored convolution takes a frame by a tap."""
    frames = torch.eye(n_frames)
    windows = reflect(frames, kernel // 2).unfold(-1, kernel, 1)
    return windows.sum(dim=1).T / n_frames
