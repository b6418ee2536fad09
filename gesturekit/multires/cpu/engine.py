"""Gradients of the discriminator loss by hand (eqs. 12 and 13), without autograd.

The gradient penalty needs the derivative of a gradient, for which autograd passes through the
network six times. As the network is piecewise linear, three passes are enough: forward, backward,
and one more forward pass (a Jacobian-vector product) for the derivative of the penalty. Scores and
penalty of a few windows at a time are independent tasks, which threads run in parallel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar
from weakref import WeakSet

import numpy as np
import torch
from torch import Tensor, nn

from gesturekit.multires.config import LossConfig
from gesturekit.multires.cpu import kernels
from gesturekit.multires.cpu.kernels import TAPS
from gesturekit.multires.cpu.sparse_conv import (
    Packing,
    cropped_gradient,
    padded_weight,
    run_tasks,
    sparse_conv,
    threads_for_kernels,
)
from gesturekit.multires.layers import SLOPE, SkeletonConv1d, convolve_dense
from gesturekit.multires.networks import (
    Film,
    LevelDiscriminator,
    LevelGenerator,
    MultiresGenerator,
    TorchBackend,
    tap_frequencies,
)

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


T = TypeVar("T")

_PARTS = {
    MultiresGenerator: {"levels"},
    LevelGenerator: {"layers", "embed", "films"},
    LevelDiscriminator: {"layers", "score", "styled"},
    Film: {"gain", "shift"},
    SkeletonConv1d: {"weight", "bias"},
    nn.Conv1d: {"weight", "bias"},
}
"""Modules that the engine supports: class to the names of its children and parameters."""


_SUPPORTED: WeakSet[nn.Module] = WeakSet()
"""Networks in evaluation mode that can be computed."""


def unsupported(*networks: nn.Module) -> str | None:
    """Return why the engine cannot compute these networks, or None if it can.

    Classes must be exactly those that it was written for: it does not call their `forward`, so that
    a subclass would be trained with the gradients of its base class. Networks in evaluation mode
    are examined once.
    """
    for network in networks:
        if not network.training and network in _SUPPORTED:
            continue
        for name, module in network.named_modules():
            problem = _problem(module)
            if problem:
                return f"{type(module).__name__}{f' ({name})' if name else ''} {problem}"
        for parameter in network.parameters():
            if parameter.device.type != "cpu" or parameter.dtype != torch.float32:
                return f"it needs float32 weights on the CPU, not {parameter.dtype} on " + str(
                    parameter.device
                )
        if not network.training:
            _SUPPORTED.add(network)
    return None


def _problem(module: nn.Module) -> str | None:
    if type(module) is nn.ModuleList:
        return None
    if type(module) not in _PARTS:
        return "is not a class that the numba engine was written for"
    parts = {*dict(module.named_children()), *dict(module.named_parameters(recurse=False))}
    if extra := sorted(parts - _PARTS[type(module)]):
        return f"has parts that the numba engine does not know: {', '.join(extra)}"
    hooks = (module._forward_hooks, module._forward_pre_hooks, module._backward_hooks)
    if "forward" in vars(module) or any(hooks):
        return "has a hook or overrides forward, which the numba engine would not call"
    if type(module) is SkeletonConv1d and module.shape[-1] > TAPS:
        return f"has a kernel of {module.shape[-1]} frames; the numba engine computes up to {TAPS}"
    return None


def _computes(layers: Sequence[SkeletonConv1d], x: Tensor) -> bool:
    """Return whether the kernels can compute these layers for x (B, C, T)."""
    exact = all(x.dtype == layer.weight.dtype == torch.float32 for layer in layers)
    on_cpu = x.device.type == "cpu" and not torch.is_autocast_enabled("cpu")
    return exact and on_cpu and all(Packing.fits(x.shape[-1], layer.shape[-1]) for layer in layers)


class NumbaBackend(TorchBackend):
    """Sparse convolutions and discriminator gradients in compiled kernels.

    Signals that the kernels cannot compute (one or two frames, half precision) go to plain torch.
    """

    name = "numba"

    def convolve(
        self, layers: Sequence[SkeletonConv1d], x: Tensor, slope: float, last_slope: float
    ) -> Tensor:
        """Return the output of a chain of convolutions; see `convolve_dense`."""
        if not _computes(layers, x):
            return super().convolve(layers, x, slope, last_slope)
        if not torch.is_grad_enabled():
            packing = Packing(len(x), x.shape[-1])
            slopes = (*(slope for _ in layers[1:]), last_slope)
            return packing.unpack(_signals(layers, x, slopes, packing, keep=False)[-1])
        weights = (part for layer in layers for part in (layer.weight, layer.bias))
        return _SparseChain.apply(x, layers, slope, last_slope, *weights)

    def discriminator_gradients(
        self,
        discriminators: Sequence[LevelDiscriminator],
        reals: Sequence[Tensor],
        fakes: Sequence[Tensor],
        mixes: Sequence[Tensor],
        config: LossConfig,
        styles: Sequence[Tensor | None],
    ) -> Tensor:
        """Set the parameters' gradients and return eq. 12; see `TorchBackend`."""
        if not all(map(_computes, (each.layers for each in discriminators), reals)):
            return super().discriminator_gradients(
                discriminators, reals, fakes, mixes, config, styles
            )
        steps = [
            DiscriminatorStep(*level, config)
            for level in zip(discriminators, reals, fakes, mixes, styles, strict=True)
        ]
        # The longest tasks first: those of the finer level, and of these the scores, as they are of
        # two windows each.
        parts = [(step, part) for step in reversed(steps) for part in step.parts]
        results = run_tasks(
            *(partial(step.score, part) for step, part in parts),
            *(partial(step.penalise, part) for step, part in parts),
        )
        scored, penalised = results[: len(parts)], results[len(parts) :]

        def of(step: DiscriminatorStep, made: list[Gradients]) -> list[Gradients]:
            return [each for (other, _), each in zip(parts, made, strict=True) if other is step]

        return torch.stack([step.finish(of(step, scored), of(step, penalised)) for step in steps])

    def run_tasks(self, *tasks: Callable[[], T]) -> list[T]:
        """Run independent tasks in parallel and return their results."""
        return run_tasks(*tasks)

    def threads(self) -> AbstractContextManager[None]:
        """Return a context in which kernels use the CPU threads, and torch's operators one.

        In half precision it does nothing: dense convolutions are parallel by themselves.
        """
        return nullcontext() if torch.is_autocast_enabled("cpu") else threads_for_kernels()


def _signals(
    layers: Sequence[SkeletonConv1d],
    x: Tensor,
    slopes: Sequence[float],
    packing: Packing,
    *,
    keep: bool,
) -> list[np.ndarray]:
    """Return the packed input of a chain of convolutions and all outputs, or the last one only."""
    signals = [packing.pack(x.detach(), reflect=True)]
    for layer, negative in zip(layers, slopes, strict=True):
        weight, bias = padded_weight(layer), layer.bias.detach().numpy()
        made = sparse_conv(layer).forward(weight, bias, signals[-1], packing, negative)
        signals = [*signals, made] if keep else [made]
    return signals


class _SparseChain(torch.autograd.Function):
    """A chain of sparse convolutions; its second derivatives are those of dense convolutions."""

    @staticmethod
    def forward(
        ctx: Any,
        x: Tensor,
        layers: Sequence[SkeletonConv1d],
        slope: float,
        last_slope: float,
        *parameters: Tensor,
    ) -> Tensor:
        packing = Packing(len(x), x.shape[-1])
        slopes = (*(slope for _ in layers[1:]), last_slope)
        signals = _signals(layers, x, slopes, packing, keep=any(ctx.needs_input_grad))
        ctx.layers, ctx.slopes, ctx.packing, ctx.signals = layers, slopes, packing, signals
        ctx.save_for_backward(x, *parameters)
        return packing.unpack(signals[-1])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        layers, slopes, packing, signals = ctx.layers, ctx.slopes, ctx.packing, ctx.signals
        x, *parameters = ctx.saved_tensors
        wanted = (ctx.needs_input_grad[0], *ctx.needs_input_grad[4:])
        if torch.is_grad_enabled():
            inputs = [part for part, want in zip((x, *parameters), wanted, strict=True) if want]
            made = convolve_dense(layers, x, slopes[0], slopes[-1])
            derivatives = iter(torch.autograd.grad(made, inputs, gradient, create_graph=True))
            by_input, *by_parameters = (next(derivatives) if want else None for want in wanted)
            return by_input, None, None, None, *by_parameters
        gradient = packing.pack(gradient, reflect=False)
        if slopes[-1] != 1:
            gradient[signals[-1] <= 0] *= slopes[-1]
        by_layers: list[Tensor | None] = []
        for i in reversed(range(len(layers))):
            layer, (by_weight, by_bias) = layers[i], wanted[1 + 2 * i : 3 + 2 * i]
            conv, by = sparse_conv(layer), None
            if by_weight:
                by = conv.weight_gradient(signals[i], gradient, packing)
                by = cropped_gradient(by, layer.shape[-1])
            by_layer = [by, torch.from_numpy(gradient.sum(axis=1)) if by_bias else None]
            by_layers = [*by_layer, *by_layers]
            if any(wanted[: 1 + 2 * i]):
                rectifier = (signals[i], slopes[i - 1]) if i else (None, 1.0)
                gradient = conv.input_gradient(padded_weight(layer), gradient, packing, *rectifier)
        return packing.unpack(gradient) if wanted[0] else None, None, None, None, *by_layers
