"""One discriminator step by hand: the loss and its gradients without recording anything.

The gradient penalty wants the derivative of a gradient, which autograd finds by going through the
networks six times, two of them with zeros: leaky rectifiers bend only at a point, so that the
network is linear around every input. Here one pass forward and one back serve the score and the
penalty alike, and the penalty's own derivative is one more pass forward, of the direction in which
the gradient should grow. Motions that are scored and those that the penalty is on are tasks of
their own, a few windows at a time, which threads do side by side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from gesturekit.multires.config import LossConfig
from gesturekit.multires.cpu.kernels import (
    mirror_rows,
    penalty_gradient,
    score_rows,
    sums_over_time,
)
from gesturekit.multires.cpu.sparse_conv import Rows, narrowed
from gesturekit.multires.cpu.threads import side_by_side
from gesturekit.multires.losses import critic_gap
from gesturekit.multires.network.networks import SLOPE, LevelDiscriminator, gradient_penalty, taken

TOGETHER = 4
"""Windows of a task; however many threads there are, sums over windows have one order."""


def critic_gradients(
    critics: Sequence[LevelDiscriminator],
    reals: Sequence[Tensor],
    fakes: Sequence[Tensor],
    mixes: Sequence[Tensor],
    losses: LossConfig,
    told: Sequence[Tensor | None],
) -> Tensor:
    """Give critics' parameters the gradients of their losses on these motions.

    The loss is `critic_scale` times the gap, score of fakes less score of recordings, plus the
    gradient penalty (eqs. 12 and 13). By hand where `live_conv` runs, else by autograd.

    Args:
        critics: of some levels; the following have an entry for each.
        reals: (B, D, T).
        fakes: the same shapes.
        mixes: (B, 1, 1), uniform in [0, 1], where between them the penalty is taken.
        losses: of all of them.
        told: (B, K) style of each recording and of the fake beside it; None where nothing is told.

    Returns:
        (levels,) gaps.
    """
    levels = [
        _Level(*parts, losses) for parts in zip(critics, reals, fakes, mixes, told, strict=True)
    ]
    if not all(level.is_live for level in levels):
        return torch.stack([_by_autograd(level) for level in levels])
    steps = [_Step(level) for level in levels]
    # The longest first: the finer level, and two windows to score for each that is penalised.
    parts = [(step, part) for step in reversed(steps) for part in step.parts]
    made = side_by_side(
        *(partial(step.score, part) for step, part in parts),
        *(partial(step.penalise, part) for step, part in parts),
    )
    for (step, _), scored, penalised in zip(
        parts, made[: len(parts)], made[len(parts) :], strict=True
    ):
        step.scored.append(scored)
        step.penalised.append(penalised)
    return torch.stack([step.finish() for step in steps])


@dataclass(frozen=True)
class _Level:
    """What `critic_gradients` is given, for one level."""

    critic: LevelDiscriminator
    real: Tensor
    fake: Tensor
    mix: Tensor
    told: Tensor | None
    losses: LossConfig

    @property
    def is_live(self) -> bool:
        return all(conv.is_live(self.real) for conv in self.critic.layers)


def _by_autograd(level: _Level) -> Tensor:
    critic, real, fake, told = level.critic, level.real, level.fake, level.told
    twice = None if told is None else torch.cat([told, told])
    scores = critic(torch.cat([fake, real]), twice)
    gap = critic_gap(scores[: len(fake)], scores[len(fake) :])
    penalty = gradient_penalty(critic, real, fake, level.mix, level.losses.penalty_on, told)
    loss = level.losses.discriminator_scale * gap + level.losses.gradient_penalty * penalty
    parameters = list(critic.parameters())
    for parameter, gradient in zip(parameters, torch.autograd.grad(loss, parameters), strict=True):
        parameter.grad = gradient
    return gap.detach()


class _Step:
    """A step of one critic in parts that do not wait for one another."""

    def __init__(self, level: _Level) -> None:
        self.level, self.critic, self.told = level, level.critic, level.told
        self.count, _, self.n_frames = level.real.shape
        self.parts = [
            slice(start, min(start + TOGETHER, self.count))
            for start in range(0, self.count, TOGETHER)
        ]
        self.wirings = [conv.wiring for conv in self.critic.layers]
        self.weights = [conv.live_weights() for conv in self.critic.layers]
        self.biases = [conv.bias.detach().numpy() for conv in self.critic.layers]
        with torch.no_grad():
            self.slopes = self.critic.slopes(self.n_frames, self.told).numpy()
        self.taken = taken(self.n_frames, self.critic.score.kernel_size[0]).numpy()
        self.scored: list[_Gradients] = []
        self.penalised: list[_Gradients] = []

    def finish(self) -> Tensor:
        """Hand out the gradients of all parts, in their order; the gap."""
        for i, conv in enumerate(self.critic.layers):
            by_weight, *others_by_weight = (
                one.weights[i] for one in (*self.scored, *self.penalised)
            )
            for more in others_by_weight:
                by_weight += more
            conv.weight.grad = narrowed(by_weight, conv.shape[-1])
            conv.bias.grad = torch.from_numpy(sum(one.biases[i] for one in self.scored))
        of_each = [
            np.concatenate([one.heads for one in kind], axis=1)
            for kind in (self.scored, self.penalised)
        ]
        of_each = torch.from_numpy(of_each[0].sum(axis=0) + of_each[1].sum(axis=0))
        self.critic.score.weight.grad = of_each.sum(dim=0, keepdim=True)
        self.critic.score.bias.grad = torch.zeros_like(self.critic.score.bias)
        if self.told is not None:
            self.critic.styled.weight.grad = torch.einsum("bk,bct->kct", self.told, of_each)
        fake, real = np.concatenate([one.scores for one in self.scored], axis=1).mean(axis=1)
        return torch.tensor(fake - real)

    def _slopes(self, part: slice) -> np.ndarray:
        """(1 or B, C, T): one for all windows where nothing is told."""
        return self.slopes if self.told is None else self.slopes[part]

    def _heard(self, rows: Rows, windows: Tensor) -> list[np.ndarray]:
        """What goes into the first layer and comes out of each, rectified."""
        signals = [rows.mirrored(windows)]
        for wiring, weight, bias in zip(self.wirings, self.weights, self.biases, strict=True):
            signals.append(wiring.forward(weight, bias, signals[-1], rows, SLOPE))
        return signals

    def score(self, part: slice) -> _Gradients:
        """Of the gap."""
        real, fake = self.level.real[part], self.level.fake[part]
        windows = torch.cat([fake, real])
        share = self.level.losses.discriminator_scale / self.count
        seeds = np.repeat(np.array([share, -share], dtype=np.float32), len(real))
        rows = Rows(len(windows), self.n_frames)
        signals = self._heard(rows, windows)
        gradient = rows.empty(len(signals[-1]))
        slopes = self._slopes(part)
        if len(slopes) > 1:
            slopes = np.concatenate([slopes, slopes])
        scores = score_rows(signals[-1], slopes, seeds, np.float32(SLOPE), gradient)
        by_weight, by_bias = [], []
        for i in reversed(range(len(self.wirings))):
            wiring = self.wirings[i]
            by_weight.insert(0, wiring.weight_gradient(signals[i], gradient, rows))
            by_bias.insert(0, gradient.sum(axis=1))
            if i:
                gradient = wiring.input_gradient(self.weights[i], gradient, rows, signals[i], SLOPE)
        heads = sums_over_time(signals[-1], seeds, self.taken)
        two = (2, len(real))
        return _Gradients(
            by_weight, by_bias, heads.reshape(*two, *heads.shape[1:]), scores.reshape(two)
        )

    def penalise(self, part: slice) -> _Gradients:
        """Of the penalty: of its gradient's length, in the direction in which that should grow."""
        level = self.level
        windows = torch.lerp(level.real[part], level.fake[part], level.mix[part])
        rows = Rows(len(windows), self.n_frames)
        signals = self._heard(rows, windows)
        gradient = rows.empty(len(signals[-1]))
        ones = np.ones(len(windows), dtype=np.float32)
        score_rows(signals[-1], self._slopes(part), ones, np.float32(SLOPE), gradient)
        gradients = [gradient]
        for i in reversed(range(len(self.wirings))):
            back = (signals[i], SLOPE) if i else (None, 1.0)
            gradient = self.wirings[i].input_gradient(self.weights[i], gradient, rows, *back)
            gradients.insert(0, gradient)
        towards = gradients[0]
        penalty = level.losses.gradient_penalty / self.count
        penalty_on = level.losses.penalty_on
        scale = rows.n_frames ** {"window": 0.5, "frame": 1.0, "printed": 0.0}[penalty_on]
        per_frame = penalty_on == "frame"
        penalty_gradient(towards, rows.batch, rows.n_frames, penalty, per_frame, scale)
        mirror_rows(towards, rows.batch, rows.n_frames)
        by_weight = []
        for i, wiring in enumerate(self.wirings):
            by_weight.append(wiring.weight_gradient(towards, gradients[i + 1], rows))
            towards = wiring.forward_along(self.weights[i], towards, rows, signals[i + 1], SLOPE)
        # Biases do not matter to a gradient by what comes in.
        heads = sums_over_time(towards, ones, self.taken)
        return _Gradients(by_weight, [], heads[None], np.empty((0, 0)))


@dataclass(frozen=True)
class _Gradients:
    """Of some windows.

    Attributes:
        weights: of each layer's live weights, (n,).
        biases: (C,) of each layer; none at all where they are zero.
        heads: (kinds of windows, B, C, K) of the weights of the score, by window.
        scores: (kinds, B), without bias.
    """

    weights: list[Tensor]
    biases: list[np.ndarray]
    heads: np.ndarray
    scores: np.ndarray
