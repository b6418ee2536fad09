"""Sparse skeleton convolution: multiplies only by weights between neighbouring blocks.

Each output channel is a sum of shifted input channels, computed two at a time: ten products for
every five numbers read. Forward, input gradient and weight gradient are separate operations; the
rectifier and the reflected ends are part of each. Output channels are shared among the threads of
a pool; another pool runs independent tasks. The results do not depend on the number of threads nor
on the other windows of a batch, in any bit.
"""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import lru_cache
from typing import Any, TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from gesturekit.multires.cpu import kernels
from gesturekit.multires.cpu.kernels import LINE, PADDING, START, TAPS, Plan, Rectifier, Shape
from gesturekit.multires.layers import SkeletonConv1d


class _Local(threading.local):
    """Threads that kernels called from this Python thread may use; None for torch's number."""

    kernel_threads: int | None = None


_local = _Local()
T = TypeVar("T")


@contextmanager
def threads_for_kernels() -> Iterator[None]:
    """Within this context kernels use all of torch's threads, and torch's operators only one.

    Training and sampling call thousands of torch operators too short to be parallel. Between them
    torch's threads would spin on the cores that the kernels need.
    """
    if _local.kernel_threads is not None:
        yield
        return
    count = torch.get_num_threads()
    torch.set_num_threads(1)
    _local.kernel_threads = count
    try:
        yield
    finally:
        _local.kernel_threads = None
        torch.set_num_threads(count)


def kernel_threads() -> int:
    """Return how many threads a kernel called from this thread may use."""
    return _local.kernel_threads or torch.get_num_threads()


def run_tasks(*tasks: Callable[[], T]) -> list[T]:
    """Return the results of independent tasks, run in parallel within `threads_for_kernels`.

    A free thread takes the next task, so that the longest should come first. A task starts with
    torch's default modes (gradients, autocast) and sets those it needs. The kernels it calls share
    the threads that are left. Outside of that context tasks run one after another.
    """
    threads = _local.kernel_threads or 1
    count = min(threads, len(tasks))
    if count == 1:
        return [task() for task in tasks]
    own_threads = threads // count
    left, made = deque(enumerate(tasks)), {}

    def work() -> None:
        before, _local.kernel_threads = _local.kernel_threads, own_threads
        try:
            while left:
                try:
                    number, task = left.popleft()
                except IndexError:  # another thread took the last one
                    return
                made[number] = task()
        finally:
            _local.kernel_threads = before

    futures = [submit("tasks", work) for _ in range(count - 1)]
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


def submit(pool: str, function: Callable[..., T], *arguments: Any) -> Future[T]:
    """Call a function on a pool's thread: "tasks", or "kernels", which tasks wait for."""
    return _threads(pool).submit(function, *arguments)


@lru_cache(maxsize=2)
def _threads(pool: str) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(thread_name_prefix=pool)


if hasattr(os, "register_at_fork"):  # a forked process does not inherit threads
    os.register_at_fork(after_in_child=_threads.cache_clear)


_MIN_PARALLEL = 16_000_000
"""Multiply-adds below which a single thread is faster than several."""


class Packing:
    """Layout of B windows of T frames as one array (C, width), window after window.

    Before and after each window are two columns for its reflected frames or, in a gradient, zeros.
    """

    def __init__(self, batch: int, n_frames: int) -> None:
        self.shape = Shape(batch, n_frames)
        self.columns = batch * (n_frames + 2 * PADDING)
        # Kernels write whole lines, and read PADDING columns beyond them.
        self.width = START - PADDING + kernels.round_up(self.columns, LINE) + LINE

    @staticmethod
    def fits(n_frames: int, kernel: int) -> bool:
        """Return whether the kernels can compute a convolution of n frames."""
        return kernel <= TAPS and n_frames > PADDING

    def empty(self, channels: int) -> np.ndarray:
        """Return an uninitialised (channels, width) array, aligned as torch aligns it."""
        return torch.empty(channels, self.width).numpy()

    def pack(self, x: Tensor, *, reflect: bool) -> np.ndarray:
        """Return windows (B, C, T) as (C, width), padded by reflection or by zeros."""
        signal = self.empty(x.shape[1])
        kernels.pack(x.contiguous().numpy(), signal, reflect)
        return signal

    def unpack(self, signal: np.ndarray) -> Tensor:
        """Return the frames of a (C, width) array as (B, C, T)."""
        windows = torch.empty(self.shape.batch, len(signal), self.shape.n_frames)
        kernels.unpack(signal, windows.numpy())
        return windows


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
        self.n_in, self.n_out = sum(sizes_in), sum(sizes_out)
        mask = np.repeat(np.repeat(neighbours, sizes_out, axis=0), sizes_in, axis=1)
        positions = np.where(mask, TAPS * (np.cumsum(mask).reshape(mask.shape) - 1), -1)
        self.n_weights = TAPS * int(mask.sum())
        self.plan = ParallelPlan(positions, sizes_out)
        self.transposed_plan = ParallelPlan(positions.T, sizes_in)

    def forward(
        self,
        weight: np.ndarray,
        bias: np.ndarray,
        signal: np.ndarray,
        packing: Packing,
        slope: float,
    ) -> np.ndarray:
        """Return the convolution of a reflect-padded signal, rectified and reflect-padded."""
        rectifier = Rectifier(np.float32(slope), signal[:0])
        return self._convolve(self.plan, weight, bias, signal, rectifier, packing)

    def jvp(
        self,
        weight: np.ndarray,
        direction: np.ndarray,
        packing: Packing,
        output: np.ndarray,
        slope: float,
    ) -> np.ndarray:
        """Return the derivative of `forward`, which gave `output`, in a direction of its input."""
        bias = np.zeros(self.n_out, np.float32)
        rectifier = Rectifier(np.float32(slope), output)
        return self._convolve(self.plan, weight, bias, direction, rectifier, packing)

    def input_gradient(
        self,
        weight: np.ndarray,
        gradient: np.ndarray,
        packing: Packing,
        signal: np.ndarray | None = None,
        slope: float = 1.0,
    ) -> np.ndarray:
        """Return the gradient of the input, zero-padded.

        Args:
            weight: (N,).
            gradient: (C_out, width) of the output before its rectifier, zero-padded.
            packing: layout of both.
            signal: the input, if it comes from a rectifier; the gradient returned is then that of
                the rectifier's input.
            slope: negative slope of that rectifier.
        """
        bias = np.zeros(self.n_in, np.float32)
        gate = gradient[:0] if signal is None else signal
        rectifier = Rectifier(np.float32(slope), gate)
        plan = self.transposed_plan
        return self._convolve(plan, weight, bias, gradient, rectifier, packing, reverse=True)

    def weight_gradient(self, signal: np.ndarray, gradient: np.ndarray, packing: Packing) -> Tensor:
        """Return the gradient of the weights, (N,), from the input and the output's gradient."""
        made = torch.empty(self.n_weights)
        arguments = (signal, gradient, made.numpy(), packing.columns)
        self.plan.run(self.n_weights * packing.width, kernels.weight_gradients, *arguments)
        return made

    def _convolve(
        self,
        plan: ParallelPlan,
        weight: np.ndarray,
        bias: np.ndarray,
        signal: np.ndarray,
        rectifier: Rectifier,
        packing: Packing,
        reverse: bool = False,
    ) -> np.ndarray:
        output = packing.empty(len(bias))
        arguments = (signal, weight, bias, output, rectifier, packing.shape, reverse)
        plan.run(self.n_weights * packing.width, kernels.convolve, *arguments)
        return output


class ParallelPlan:
    """Plan of a sparse convolution that threads can share.

    Args:
        positions: (C_out, C_in) int, position of each pair's kernel in the weights, -1 for none.
        sizes: channels of each output block; all channels of a block have the same inputs.
    """

    def __init__(self, positions: np.ndarray, sizes: Sequence[int]) -> None:
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
        self.plan = Plan(np.array(steps), np.concatenate(inputs))
        counts, begins, ends = self.plan.steps[:, 1:4].T
        self._work = np.cumsum((ends - begins) * (1 + 2 * counts))

    @lru_cache(maxsize=8)  # noqa: B019 - plans are few, and live as long as the process
    def split(self, count: int) -> list[Plan]:
        """Return `count` plans of about equal work that make up this one."""
        goals = self._work[-1] * np.arange(1, count) / count
        edges = [0, *np.searchsorted(self._work, goals).tolist(), len(self.plan.steps)]
        return [
            Plan(self.plan.steps[first:last], self.plan.inputs)
            for first, last in zip(edges[:-1], edges[1:], strict=True)
        ]

    def run(self, products: int, kernel: Callable[..., None], *arguments: Any) -> None:
        """Call a kernel with this plan, on several threads if it has enough multiply-adds."""
        own, *others = self.split(kernel_threads() if products > _MIN_PARALLEL else 1)
        futures = [submit("kernels", kernel, plan, *arguments) for plan in others]
        kernel(own, *arguments)
        for future in futures:
            future.result()


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
