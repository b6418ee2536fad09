"""Gradients of the discriminator loss by hand (eqs. 12 and 13), without autograd.

The gradient penalty needs the derivative of a gradient, for which autograd passes through the
network six times. As the network is piecewise linear, three passes are enough: forward, backward,
and one more forward pass (a Jacobian-vector product) for the derivative of the penalty. Scores and
penalty of a few windows at a time are independent tasks, which threads run in parallel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gesturekit.multires.config import LossConfig
from gesturekit.multires.cpu import kernels
from gesturekit.multires.cpu.sparse_conv import (
    Packing,
    cropped_gradient,
    padded_weight,
    sparse_conv,
)
from gesturekit.multires.network.discriminator import LevelDiscriminator, tap_frequencies
from gesturekit.multires.network.skeleton_conv import SLOPE

WINDOWS_PER_TASK = 4
"""Fixed, so that sums over windows have the same order with any number of threads."""


@dataclass(frozen=True)
class Gradients:
    """Parameter gradients from some windows.

    Attributes:
        weights: (N,) for each layer, with padded kernels.
        biases: (C,) for each layer; empty where all are zero.
        score_kernel: (kinds of windows, B, C, taps), of each window's score.
        scores: (kinds of windows, B), without bias; empty for the penalty.
    """

    weights: list[Tensor]
    biases: list[np.ndarray]
    score_kernel: np.ndarray
    scores: np.ndarray


class DiscriminatorStep:
    """Gradient computation of one discriminator, in tasks independent of one another.

    Args:
        discriminator: its parameters get the gradients.
        real: (B, D, T).
        fake: (B, D, T).
        mix: (B, 1, 1), see `losses.gradient_penalty`.
        style: (B, K) one-hot, or None.
        config: weights of the losses.
    """

    def __init__(
        self,
        discriminator: LevelDiscriminator,
        real: Tensor,
        fake: Tensor,
        mix: Tensor,
        style: Tensor | None,
        config: LossConfig,
    ) -> None:
        self.discriminator, self.style, self.config = discriminator, style, config
        self.real, self.fake, self.mix = real, fake, mix
        self.count, _, self.n_frames = real.shape
        self.parts = [
            slice(start, min(start + WINDOWS_PER_TASK, self.count))
            for start in range(0, self.count, WINDOWS_PER_TASK)
        ]
        self.convs = [sparse_conv(layer) for layer in discriminator.layers]
        self.weights = [padded_weight(layer) for layer in discriminator.layers]
        self.biases = [layer.bias.detach().numpy() for layer in discriminator.layers]
        with torch.no_grad():
            self.score_weights = discriminator.score_weights(self.n_frames, style).numpy()
        taps = discriminator.score.kernel_size[0]
        self.tap_frequencies = tap_frequencies(self.n_frames, taps).numpy()

    def finish(self, scored: Sequence[Gradients], penalised: Sequence[Gradients]) -> Tensor:
        """Set the parameters' gradients to the sums over all parts, and return eq. 12.

        Args:
            scored: results of `score` for each of `parts`, in their order.
            penalised: results of `penalise`, likewise.
        """
        for i, layer in enumerate(self.discriminator.layers):
            weight, *others = (part.weights[i] for part in (*scored, *penalised))
            for other in others:
                weight += other
            layer.weight.grad = cropped_gradient(weight, layer.shape[-1])
            layer.bias.grad = torch.from_numpy(sum(part.biases[i] for part in scored))
        of_score, of_penalty = (
            np.concatenate([part.score_kernel for part in parts], axis=1).sum(axis=0)
            for parts in (scored, penalised)
        )
        kernels_by_window = torch.from_numpy(of_score + of_penalty)
        score = self.discriminator.score
        assert score.bias is not None
        score.weight.grad = kernels_by_window.sum(dim=0, keepdim=True)
        score.bias.grad = torch.zeros_like(score.bias)
        if self.style is not None:
            styled = torch.einsum("bk,bct->kct", self.style, kernels_by_window)
            self.discriminator.styled.weight.grad = styled
        fake, real = np.concatenate([part.scores for part in scored], axis=1).mean(axis=1)
        return torch.tensor(fake - real)

    def _score_weights(self, part: slice) -> np.ndarray:
        """Return (1 or B, C, T), the score weights of a part's windows."""
        return self.score_weights if self.style is None else self.score_weights[part]

    def _signals(self, packing: Packing, windows: Tensor) -> list[np.ndarray]:
        """Return the input (B, D, T) packed, and the rectified output of each layer."""
        signals = [packing.pack(windows, reflect=True)]
        for conv, weight, bias in zip(self.convs, self.weights, self.biases, strict=True):
            signals.append(conv.forward(weight, bias, signals[-1], packing, SLOPE))
        return signals

    def score(self, part: slice) -> Gradients:
        """Return scores and parameter gradients of eq. 12 for a part of the windows."""
        real, fake = self.real[part], self.fake[part]
        windows = torch.cat([fake, real])
        share = self.config.discriminator_scale / self.count
        score_gradients = np.repeat(np.array([share, -share], dtype=np.float32), len(real))
        packing = Packing(len(windows), self.n_frames)
        signals = self._signals(packing, windows)
        gradient = packing.empty(len(signals[-1]))
        weights = self._score_weights(part)
        if len(weights) > 1:
            weights = np.concatenate([weights, weights])
        slope = np.float32(SLOPE)
        scores = kernels.score(signals[-1], weights, score_gradients, slope, gradient)
        by_weight, by_bias = list[Tensor](), list[np.ndarray]()
        for i in reversed(range(len(self.convs))):
            conv, weight = self.convs[i], self.weights[i]
            by_weight.insert(0, conv.weight_gradient(signals[i], gradient, packing))
            by_bias.insert(0, gradient.sum(axis=1))
            if i:
                gradient = conv.input_gradient(weight, gradient, packing, signals[i], SLOPE)
        kernel = kernels.score_kernel_gradients(signals[-1], score_gradients, self.tap_frequencies)
        two = (2, len(real))
        return Gradients(
            by_weight, by_bias, kernel.reshape(*two, *kernel.shape[1:]), scores.reshape(two)
        )

    def penalise(self, part: slice) -> Gradients:
        """Return parameter gradients of eq. 13 (double backward by hand) for a part."""
        windows = torch.lerp(self.real[part], self.fake[part], self.mix[part])
        packing = Packing(len(windows), self.n_frames)
        signals = self._signals(packing, windows)
        gradient = packing.empty(len(signals[-1]))
        ones = np.ones(len(windows), dtype=np.float32)
        weights = self._score_weights(part)
        kernels.score(signals[-1], weights, ones, np.float32(SLOPE), gradient)
        gradients = [gradient]
        for i in reversed(range(len(self.convs))):
            rectifier = (signals[i], SLOPE) if i else (None, 1.0)
            gradient = self.convs[i].input_gradient(self.weights[i], gradient, packing, *rectifier)
            gradients.insert(0, gradient)
        # Derivative of the penalty with respect to the input gradient, then forward through the
        # linearised network: each layer's weights meet it in a product with their output gradient.
        tangent = gradients[0]
        penalty, penalty_on = self.config.gradient_penalty / self.count, self.config.penalty_on
        scale = self.n_frames ** {"window": 0.5, "frame": 1.0, "printed": 0.0}[penalty_on]
        kernels.penalty_gradient(tangent, packing.shape, penalty, penalty_on == "frame", scale)
        kernels.reflect_windows(tangent, packing.shape)
        by_weight = []
        for i, conv in enumerate(self.convs):
            by_weight.append(conv.weight_gradient(tangent, gradients[i + 1], packing))
            tangent = conv.jvp(self.weights[i], tangent, packing, signals[i + 1], SLOPE)
        kernel = kernels.score_kernel_gradients(tangent, ones, self.tap_frequencies)
        # The input gradient does not depend on the biases.
        return Gradients(by_weight, [], kernel[None], np.empty((0, 0)))
