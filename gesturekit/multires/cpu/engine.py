"""Sparse skeleton convolutions, and the discriminator loss's gradients by hand (eqs. 12 and 13).

Convolutions multiply only by weights between neighbouring blocks. Each output channel is a sum of
shifted input channels, computed two at a time: ten products for every five numbers read. The
rectifier and the reflected ends are part of each operation. Output channels are shared among the
threads of a pool; another pool runs independent tasks. The results do not depend on the number of
threads nor on the other windows of a batch, in any bit.

The gradient penalty needs the derivative of a gradient, for which autograd passes through the
network six times. As the network is piecewise linear, three passes are enough: forward, backward,
and one more forward pass (a Jacobian-vector product) for the derivative of the penalty. Scores and
penalty of a few windows at a time are independent tasks, which threads run in parallel.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, TypeVar
from weakref import WeakSet

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gesturekit.multires.config import LossConfig
from gesturekit.multires.cpu import kernels
from gesturekit.multires.cpu.kernels import LINE, PADDING, START, TAPS, Plan, Rectifier, Shape
from gesturekit.multires.networks import (
    SLOPE,
    Film,
    LevelDiscriminator,
    LevelGenerator,
    MultiresGenerator,
    SkeletonConv1d,
    TorchBackend,
    convolve_dense,
    tap_frequencies,
)

T = TypeVar("T")
_THREADS: ContextVar[int] = ContextVar("threads", default=0)
"""Threads that kernels may use in this context; 0 outside of `threads_for_kernels`."""


@contextmanager
def threads_for_kernels() -> Iterator[None]:
    """Within this context kernels use all of torch's threads, and torch's operators only one.

    Training and sampling call thousands of torch operators too short to be parallel. Between them
    torch's threads would spin on the cores that the kernels need.
    """
    if _THREADS.get():
        yield
        return
    count = torch.get_num_threads()
    torch.set_num_threads(1)
    before = _THREADS.set(count)
    try:
        yield
    finally:
        _THREADS.reset(before)
        torch.set_num_threads(count)


def run_tasks(*tasks: Callable[[], T]) -> list[T]:
    """Return the results of independent tasks, run in parallel within `threads_for_kernels`.

    A free thread takes the next task, so that the longest should come first. A task starts with
    torch's default modes (gradients, autocast) and sets those it needs. The kernels it calls share
    the threads that are left. Outside of that context tasks run one after another.
    """
    threads = _THREADS.get()
    count = min(threads, len(tasks))
    if count <= 1:
        return [task() for task in tasks]
    left, made = deque(enumerate(tasks)), {}

    def work() -> None:
        before = _THREADS.set(threads // count)
        try:
            while left:
                try:
                    number, task = left.popleft()
                except IndexError:  # another thread took the last one
                    return
                made[number] = task()
        finally:
            _THREADS.reset(before)

    futures = [_pool("tasks").submit(work) for _ in range(count - 1)]
    try:
        work()
    except BaseException:
        left.clear()
        raise
    finally:
        wait(futures)  # after an error too: no task may run on in the background
    for future in futures:
        future.result()
    return [made[number] for number in range(len(tasks))]


@lru_cache(maxsize=2)
def _pool(name: str) -> ThreadPoolExecutor:
    """Return a pool of threads: "tasks", or "kernels", which tasks wait for."""
    return ThreadPoolExecutor(thread_name_prefix=name)


if hasattr(os, "register_at_fork"):  # a forked process does not inherit threads
    os.register_at_fork(after_in_child=_pool.cache_clear)


_MIN_PARALLEL = 16_000_000
"""Multiply-adds below which a single thread is faster than several."""


class Packing:
    """Layout of B windows of T frames as one array (C, width), window after window.

    Before and after each window are two columns for its reflected frames or, in a gradient, zeros.
    """

    def __init__(self, batch: int, n_frames: int) -> None:
        self.shape: Shape = (batch, n_frames)
        self.columns = batch * (n_frames + 2 * PADDING)
        # Kernels write whole lines, and read PADDING columns beyond them.
        self.width = START - PADDING + -(-self.columns // LINE) * LINE + LINE

    def empty(self, channels: int) -> np.ndarray:
        """Return an uninitialised (channels, width) array, aligned as torch aligns it."""
        return torch.empty(channels, self.width).numpy()

    def _frames(self, signal: np.ndarray) -> np.ndarray:
        """Return the frames of a (C, width) array as a view (B, C, T)."""
        columns = signal[:, START - PADDING : START - PADDING + self.columns]
        windows = columns.reshape(len(signal), self.shape[0], -1)
        return windows[..., PADDING:-PADDING].transpose(1, 0, 2)

    def pack(self, x: Tensor, *, reflect: bool) -> np.ndarray:
        """Return windows (B, C, T) as (C, width), padded by reflection or by zeros."""
        signal = torch.zeros(x.shape[1], self.width).numpy()
        self._frames(signal)[:] = x.numpy()
        if reflect:
            kernels.reflect_windows(signal, self.shape)
        return signal

    def unpack(self, signal: np.ndarray) -> Tensor:
        """Return the frames of a (C, width) array as (B, C, T)."""
        return torch.from_numpy(np.ascontiguousarray(self._frames(signal)))


class SparseConv:
    """Convolution with given connections; its arrays are (C, width), see `Packing`.

    Weights are (N,), TAPS numbers for each connected pair of channels.

    Args:
        neighbours: (output blocks, input blocks) bool, True where the first sees the second.
        sizes_in: channels of each input block.
        sizes_out: channels of each output block.
    """

    def __init__(
        self, neighbours: np.ndarray, sizes_in: Sequence[int], sizes_out: Sequence[int]
    ) -> None:
        mask = np.repeat(np.repeat(neighbours, sizes_out, axis=0), sizes_in, axis=1)
        positions = np.where(mask, TAPS * (np.cumsum(mask).reshape(mask.shape) - 1), -1)
        self.n_weights = TAPS * int(mask.sum())
        self.plans = _plan(positions, sizes_out), _plan(positions.T, sizes_in)
        self.channels = positions.shape

    def convolve(
        self,
        weight: np.ndarray,
        signal: np.ndarray,
        packing: Packing,
        *,
        bias: np.ndarray | None = None,
        gate: np.ndarray | None = None,
        slope: float = 1.0,
        reverse: bool = False,
    ) -> np.ndarray:
        """Return the convolution of a signal, rectified; reflect-padded, as the signal is.

        Args:
            weight: (N,).
            signal: (C_in, width); with `reverse` (C_out, width), zero-padded.
            packing: layout of the signal.
            bias: (C_out,); zeros by default.
            gate: scale the result by `slope` where this is not above 0; by default the result
                itself. With the output of an earlier call, the derivative of that call.
            slope: negative slope of the rectifier.
            reverse: return the gradient of the input, zero-padded, for the output's gradient.
        """
        n_made = self.channels[int(reverse)]
        bias = np.zeros(n_made, np.float32) if bias is None else bias
        rectifier: Rectifier = (np.float32(slope), signal[:0] if gate is None else gate)
        output = packing.empty(n_made)
        arguments = (signal, weight, bias, output, rectifier, packing.shape, reverse)
        self._run(self.plans[int(reverse)], packing, kernels.convolve, *arguments)
        return output

    def weight_gradient(self, signal: np.ndarray, gradient: np.ndarray, packing: Packing) -> Tensor:
        """Return the gradient of the weights, (N,), from the input and the output's gradient."""
        made = torch.empty(self.n_weights)
        arguments = (signal, gradient, made.numpy(), packing.columns)
        self._run(self.plans[0], packing, kernels.weight_gradients, *arguments)
        return made

    def _run(
        self, plan: Plan, packing: Packing, kernel: Callable[..., None], *arguments: Any
    ) -> None:
        """Call a kernel with a plan, on several threads if it has enough multiply-adds."""
        parallel = self.n_weights * packing.width > _MIN_PARALLEL
        count, others = (_THREADS.get() or torch.get_num_threads()) if parallel else 1, []
        if count > 1:
            counts, begins, ends = plan.steps[:, 1:4].T
            work = np.cumsum((ends - begins) * (1 + 2 * counts))
            edges = np.searchsorted(work, work[-1] * np.arange(1, count) / count)
            plan, *others = (Plan(steps, plan.inputs) for steps in np.split(plan.steps, edges))
        futures = [_pool("kernels").submit(kernel, other, *arguments) for other in others]
        kernel(plan, *arguments)
        for future in futures:
            future.result()


def _plan(positions: np.ndarray, sizes: Sequence[int]) -> Plan:
    """Return the plan of a sparse convolution.

    Args:
        positions: (C_out, C_in) int, position of each pair's kernel in the weights, -1 for none.
        sizes: channels of each output block; all channels of a block have the same inputs.
    """
    steps, inputs, n_inputs, first = [], [], 0, 0
    for size in sizes:
        seen = np.flatnonzero(positions[first] >= 0)
        for channel in range(first, first + size, 2):
            count = min(2, first + size - channel)
            own = positions[channel, seen]
            two = count == 2 and len(seen)
            distance = (positions[channel + 1, seen] - own)[0] if two else 0
            steps.append((channel, count, n_inputs, n_inputs + len(seen), distance))
            inputs.append(np.stack([seen, own], axis=1))
            n_inputs += len(seen)
        first += size
    return Plan(np.array(steps), np.concatenate(inputs))


def sparse_conv(layer: SkeletonConv1d) -> SparseConv:
    """Return the sparse convolution of a layer, the same object for all layers of one shape."""
    near = layer.neighbours
    return _sparse_conv(near.tobytes(), len(near), *layer.sizes)


@lru_cache(maxsize=64)
def _sparse_conv(
    neighbours: bytes, n_blocks: int, sizes_in: tuple[int, ...], sizes_out: tuple[int, ...]
) -> SparseConv:
    near = np.frombuffer(neighbours, dtype=bool).reshape(n_blocks, -1)
    return SparseConv(near, sizes_in, sizes_out)


def padded_weight(layer: SkeletonConv1d) -> np.ndarray:
    """Return a layer's weights with every kernel padded to TAPS, (N,)."""
    weight, kernel = layer.weight.detach(), layer.shape[-1]
    if kernel != TAPS:
        missing = (TAPS - kernel) // 2
        weight = F.pad(weight.view(-1, kernel), (missing, missing)).flatten()
    return weight.numpy()


def cropped_gradient(gradient: Tensor, kernel: int) -> Tensor:
    """Return the gradient of weights from that of the padded weights, (N,)."""
    if kernel == TAPS:
        return gradient
    missing = (TAPS - kernel) // 2
    return gradient.view(-1, TAPS)[:, missing : missing + kernel].flatten()


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
        starts = range(0, self.count, WINDOWS_PER_TASK)
        self.parts = [slice(start, start + WINDOWS_PER_TASK) for start in starts]
        self.convs = [sparse_conv(layer) for layer in discriminator.layers]
        self.weights = [padded_weight(layer) for layer in discriminator.layers]
        self.slopes = [SLOPE] * len(self.convs)
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

    def _passes(
        self, part: slice, windows: Tensor, score_gradients: np.ndarray
    ) -> tuple[Packing, list[np.ndarray], list[np.ndarray], np.ndarray]:
        """Return the layout of windows, the input of each layer and the output of the last one.

        Then the gradient (C, width) of each layer's output, before its rectifier, and the scores
        without bias. The windows are those of a part, once or twice.
        """
        packing, weights = Packing(len(windows), self.n_frames), self.score_weights
        signals = _signals(self.discriminator.layers, windows, self.slopes, packing)
        if self.style is not None:
            weights = np.concatenate([weights[part]] * (len(windows) // len(self.real[part])))
        gradient = packing.empty(len(signals[-1]))
        scores = kernels.score(signals[-1], weights, score_gradients, np.float32(SLOPE), gradient)
        gradients = [gradient]
        for i in reversed(range(1, len(self.convs))):
            gradient = self.convs[i].convolve(
                self.weights[i], gradient, packing, gate=signals[i], slope=SLOPE, reverse=True
            )
            gradients.insert(0, gradient)
        return packing, signals, gradients, scores

    def score(self, part: slice) -> Gradients:
        """Return scores and parameter gradients of eq. 12 for a part of the windows."""
        windows = torch.cat([self.fake[part], self.real[part]])
        share, two = self.config.discriminator_scale / self.count, (2, len(windows) // 2)
        score_gradients = np.repeat(np.array([share, -share], dtype=np.float32), two[1])
        packing, signals, gradients, scores = self._passes(part, windows, score_gradients)
        layers = zip(self.convs, signals[:-1], gradients, strict=True)
        by_weight = [conv.weight_gradient(x, g, packing) for conv, x, g in layers]
        by_bias = [gradient.sum(axis=1) for gradient in gradients]
        kernel = kernels.score_kernel_gradients(signals[-1], score_gradients, self.tap_frequencies)
        kernel = kernel.reshape(*two, *kernel.shape[1:])
        return Gradients(by_weight, by_bias, kernel, scores.reshape(two))

    def penalise(self, part: slice) -> Gradients:
        """Return parameter gradients of eq. 13 (double backward by hand) for a part."""
        windows = torch.lerp(self.real[part], self.fake[part], self.mix[part])
        ones = np.ones(len(windows), dtype=np.float32)
        packing, signals, gradients, _ = self._passes(part, windows, ones)
        # Derivative of the penalty with respect to the input gradient, then forward through the
        # linearised network: each layer's weights meet it in a product with their output gradient.
        tangent = self.convs[0].convolve(self.weights[0], gradients[0], packing, reverse=True)
        penalty, penalty_on = self.config.gradient_penalty / self.count, self.config.penalty_on
        scale = self.n_frames ** {"window": 0.5, "frame": 1.0, "printed": 0.0}[penalty_on]
        kernels.penalty_gradient(tangent, packing.shape, penalty, penalty_on == "frame", scale)
        kernels.reflect_windows(tangent, packing.shape)
        by_weight = []
        for i, conv in enumerate(self.convs):
            by_weight.append(conv.weight_gradient(tangent, gradients[i], packing))
            tangent = conv.convolve(
                self.weights[i], tangent, packing, gate=signals[i + 1], slope=SLOPE
            )
        kernel = kernels.score_kernel_gradients(tangent, ones, self.tap_frequencies)
        # The input gradient does not depend on the biases.
        return Gradients(by_weight, [], kernel[None], np.empty((0, 0)))


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
            if problem := _problem(module):
                return f"{type(module).__name__}{f' ({name})' if name else ''} {problem}"
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
    for weight in module.parameters(recurse=False):
        if weight.device.type != "cpu" or weight.dtype != torch.float32:
            return f"needs float32 weights on the CPU, not {weight.dtype} on {weight.device}"
    return None


def _computes(layers: Sequence[SkeletonConv1d], x: Tensor) -> bool:
    """Return whether the kernels can compute these layers for x (B, C, T)."""
    exact = all(x.dtype == layer.weight.dtype == torch.float32 for layer in layers)
    on_cpu = x.device.type == "cpu" and not torch.is_autocast_enabled("cpu")
    short = all(layer.shape[-1] <= TAPS for layer in layers)
    return exact and on_cpu and short and x.shape[-1] > PADDING


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
    keep: bool = True,
) -> list[np.ndarray]:
    """Return the packed input of a chain of convolutions and all outputs, or the last one only."""
    signals = [packing.pack(x.detach(), reflect=True)]
    for layer, negative in zip(layers, slopes, strict=True):
        weight, bias = padded_weight(layer), layer.bias.detach().numpy()
        made = sparse_conv(layer).convolve(weight, signals[-1], packing, bias=bias, slope=negative)
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
                gate, slope = (signals[i], slopes[i - 1]) if i else (None, 1.0)
                gradient = conv.convolve(
                    padded_weight(layer), gradient, packing, gate=gate, slope=slope, reverse=True
                )
        return (
            packing.unpack(gradient) if wanted[0] else None,
            None,
            None,
            None,
            *by_layers,
        )
