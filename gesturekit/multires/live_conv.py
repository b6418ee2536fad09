"""Skeleton-aware convolution on a CPU: products with live weights alone, compiled by numba.

A signal has one row a channel, with all frames of all windows in it (`Rows`). Each row that comes
out is a sum of shifted rows of the channels that it sees, two rows at a time: ten products for
every five numbers read. Nothing is laid out anew beforehand, neither weights nor signals, and
rectifiers and mirrored ends are seen to while a row is at hand.

Forward, the gradient of the input and that of the weights are functions of their own: a training
step that needs the convolution's derivative as a function (the gradient penalty) calls them without
recording anything. Rows are shared among as many threads as torch may use. What comes out is the
same to the bit, however many there are and whatever other windows or frames are filtered with it.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import lru_cache
from typing import Any, TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from gesturekit.compiled import compiled

TAPS = 5
"""Of all kernels; shorter ones have zeros at both ends."""
_EDGE = TAPS // 2
_GAP = 2 * _EDGE
_LINE = 16
"""Numbers that a processor loads and stores together; what is made begins with such a lot."""
_LEAD = _LINE + _EDGE
_BLOCK = 2048
"""Numbers of a row that are made at a time, so that those of all rows read stay at hand."""
_ALONE = 4_000_000
"""Products that one thread makes sooner than others would come to help."""


class Rows:
    """Signals of B windows of T frames as (C, width): the windows of a channel, one after another.

    Between windows, and at both ends, is room for what lies beyond their frames: two mirrored
    frames behind one and two before the next, or, in a gradient, zeros.
    """

    def __init__(self, batch: int, n_frames: int) -> None:
        self.batch, self.n_frames = batch, n_frames
        self.pitch = n_frames + _GAP
        self.width = -(-(_LEAD + batch * self.pitch + _GAP) // _LINE) * _LINE

    @staticmethod
    def fits(n_frames: int, kernel: int) -> bool:
        """Whether frames can be mirrored in place; very short signals go another way."""
        return kernel <= TAPS and n_frames > _EDGE

    def zeros(self, channels: int) -> Tensor:
        """For a signal of so many channels."""
        return torch.zeros(channels, self.width)

    def part(self, first: int, count: int) -> slice:
        """Columns of so many windows and of the frames beyond their ends."""
        start = _LEAD - _EDGE + first * self.pitch
        return slice(start, start + count * self.pitch)

    def frames(self, signal: Tensor) -> Tensor:
        """(C, B, T), a view."""
        windows = signal[:, self.part(0, self.batch)].unflatten(1, (self.batch, self.pitch))
        return windows[..., _EDGE:-_EDGE]

    def cut(self, signal: Tensor, rows: Rows, first: int) -> Tensor:
        """My windows out of more, the first of them the one of this number; a copy."""
        own = self.zeros(len(signal))
        own[:, self.part(0, self.batch)] = signal[:, rows.part(first, self.batch)]
        return own

    def pack(self, x: Tensor) -> Tensor:
        """(B, C, T) with zeros beyond the ends."""
        signal = self.zeros(x.shape[1])
        self.frames(signal).copy_(x.transpose(0, 1))
        return signal

    def mirrored(self, x: Tensor) -> Tensor:
        """(B, C, T) with mirrored frames beyond the ends."""
        return self.mirror(self.pack(x))

    def mirror(self, signal: Tensor) -> Tensor:
        """Write the frames beyond the ends."""
        _mirror_rows(signal.numpy(), self.batch, self.n_frames)
        return signal

    def unpack(self, signal: Tensor) -> Tensor:
        """The frames as (B, C, T)."""
        return self.frames(signal).transpose(0, 1).contiguous()


class Wiring:
    """Which rows a convolution's rows are made of; the same for all layers of one shape.

    Args:
        neighbours: (blocks, blocks) bool, which block sees which.
        sizes_in: channels of each block of what comes in.
        sizes_out: the same of what goes out.
    """

    def __init__(
        self, neighbours: np.ndarray, sizes_in: Sequence[int], sizes_out: Sequence[int]
    ) -> None:
        self.n_in, self.n_out = sum(sizes_in), sum(sizes_out)
        mask = np.repeat(np.repeat(neighbours, sizes_out, axis=0), sizes_in, axis=1)
        # Where in the live weights stand those from a channel to another.
        places = np.where(mask, TAPS * (np.cumsum(mask).reshape(mask.shape) - 1), -1)
        self.n_live = TAPS * int(mask.sum())
        self.forward_plan = _plan(places, sizes_out)
        self.reverse_plan = _plan(places.T, sizes_in)

    def forward(
        self, weight: Tensor, bias: Tensor | None, signal: Tensor, rows: Rows, slope: float = 1.0
    ) -> Tensor:
        """Filter a mirrored signal, rectify it with this slope below zero, and mirror it."""
        bias = torch.zeros(self.n_out) if bias is None else bias
        return self._filter(self.forward_plan, weight, bias, signal, rows, signal[:0], slope, False)

    def forward_along(
        self, weight: Tensor, direction: Tensor, rows: Rows, signal: Tensor, slope: float
    ) -> Tensor:
        """The derivative of `forward`, which gave `signal`, in a direction of what came in."""
        none = torch.zeros(self.n_out)
        return self._filter(self.forward_plan, weight, none, direction, rows, signal, slope, False)

    def input_gradient(
        self,
        weight: Tensor,
        gradient: Tensor,
        rows: Rows,
        signal: Tensor | None = None,
        slope: float = 1.0,
    ) -> Tensor:
        """The gradient of what came in, and back through the rectifier that gave `signal`."""
        none = torch.zeros(self.n_in)
        gate = gradient[:0] if signal is None else signal
        return self._filter(self.reverse_plan, weight, none, gradient, rows, gate, slope, True)

    def weight_gradient(self, signal: Tensor, gradient: Tensor, rows: Rows) -> Tensor:
        """Of the live weights, (n,)."""
        made = torch.zeros(self.n_live)
        _in_shares(
            _weight_gradient,
            self.forward_plan,
            signal.numpy(),
            gradient.numpy(),
            made.numpy(),
            rows.batch * rows.pitch,
            products=self.n_live * rows.width,
        )
        return made

    def _filter(
        self,
        plan: Plan,
        weight: Tensor,
        bias: Tensor,
        signal: Tensor,
        rows: Rows,
        gate: Tensor,
        slope: float,
        reverse: bool,
    ) -> Tensor:
        made = torch.empty(len(bias), rows.width)
        _in_shares(
            _filter,
            plan,
            signal.numpy(),
            weight.numpy(),
            bias.numpy(),
            made.numpy(),
            gate.numpy(),
            np.float32(slope),
            rows.batch,
            rows.n_frames,
            reverse,
            products=self.n_live * rows.width,
        )
        return made


class Plan:
    """Rows to make, two at a time, and what each is made of.

    Attributes:
        steps: (S, 5): a row, how many are made (this one, or the next as well), where in `reads`
            their own begin and end, and how far the next row's weights stand from this one's.
        reads: (N, 2): a row to read, and where the weights for it stand.
    """

    def __init__(self, steps: np.ndarray, reads: np.ndarray) -> None:
        self.steps, self.reads = steps, reads
        self._work = np.cumsum((steps[:, 3] - steps[:, 2]) * (1 + 2 * steps[:, 1]))

    @lru_cache(maxsize=8)  # noqa: B019 - plans are few and stay
    def shares(self, count: int) -> list[tuple[int, int]]:
        """Steps, from the first to before the last, for each of so many threads."""
        goals = self._work[-1] * np.arange(1, count) / count
        edges = [0, *np.searchsorted(self._work, goals).tolist(), len(self.steps)]
        return list(zip(edges[:-1], edges[1:], strict=True))


def _plan(places: np.ndarray, sizes: Sequence[int]) -> Plan:
    """Of rows in blocks of these sizes; (rows, rows read), where weights stand, -1 for none."""
    steps, reads, n_reads, first = [], [], 0, 0
    for size in sizes:
        seen = np.flatnonzero(places[first] >= 0)
        for row in range(first, first + size, 2):
            count = min(2, first + size - row)
            own = places[row, seen]
            apart = (places[row + 1, seen] - own)[0] if count == 2 and len(seen) else 0
            steps.append((row, count, n_reads, n_reads + len(seen), apart))
            reads.append(np.stack([seen, own], axis=1))
            n_reads += len(seen)
        first += size
    return Plan(np.array(steps), np.concatenate(reads))


class _Allowance(threading.local):
    """How many threads this Python thread's rows may use, where that is not torch's business."""

    rows: int | None = None


_allowance = _Allowance()
T = TypeVar("T")


@contextmanager
def only_rows_in_threads() -> Iterator[None]:
    """Within, torch's own operations stay on one thread, and rows have as many as torch had.

    Training has thousands of operations too short to be shared. Between them torch's threads wait
    busily, and where other programs want the processor one iteration took three times as long.
    """
    count = torch.get_num_threads()
    torch.set_num_threads(1)
    _allowance.rows = count
    try:
        yield
    finally:
        _allowance.rows = None
        torch.set_num_threads(count)


def side_by_side(*tasks: Callable[[], T]) -> list[T]:
    """What independent tasks give, within `only_rows_in_threads` made on threads of their own.

    The threads that rows may have are shared out among the tasks. Where there is one for all, or
    without `only_rows_in_threads`, tasks are done in turn. A task finds torch's modes (gradients,
    half precision) as a new thread does and sets those that it needs.
    """
    count = (_allowance.rows or 1) // len(tasks)
    if count == 0 or len(tasks) == 1:
        return [task() for task in tasks]

    def with_rows(task: Callable[[], T]) -> T:
        before, _allowance.rows = _allowance.rows, count
        try:
            return task()
        finally:
            _allowance.rows = before

    own, *others = tasks
    waiting = [_threads("tasks").submit(with_rows, task) for task in others]
    try:
        made = with_rows(own)
    finally:
        wait(waiting)  # whatever happened here: nothing goes on unseen
    return [made, *(one.result() for one in waiting)]


def _in_shares(function: Callable[..., None], plan: Plan, *arguments: Any, products: int) -> None:
    """Call a compiled function for all steps of a plan, on as many threads as rows may use."""
    count = (_allowance.rows or torch.get_num_threads()) if products > _ALONE else 1
    own, *others = plan.shares(count)
    waiting = [
        _threads("rows").submit(function, plan.steps[first:last], plan.reads, *arguments)
        for first, last in others
    ]
    function(plan.steps[slice(*own)], plan.reads, *arguments)
    for one in waiting:
        one.result()


@lru_cache(maxsize=2)
def _threads(work: str) -> ThreadPoolExecutor:
    """Of tasks or of rows, as many as were ever wanted at once; a task waits for rows."""
    return ThreadPoolExecutor(thread_name_prefix=work)


if hasattr(os, "register_at_fork"):  # threads do not come along into a forked process
    os.register_at_fork(after_in_child=_threads.cache_clear)


# Compiled. A sum of products may be rounded once, which is what the processor does; the order of
# sums over time is free, as many are made side by side.


@compiled(fastmath={"contract"})
def _add_two(
    made: np.ndarray,
    also: np.ndarray,
    signal: np.ndarray,
    weight: np.ndarray,
    reads: np.ndarray,
    apart: int,
    start: int,
    n: int,
    reverse: bool,
) -> None:
    """Add to n numbers of two rows what they see; `start` is two before the first of them."""
    one, two, three, four = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)
    for j in range(len(reads)):
        x = signal[reads[j, 0], start:]
        a = weight[reads[j, 1] :]
        b = weight[reads[j, 1] + apart :]
        a0, a1, a2, a3, a4 = a[0], a[1], a[2], a[3], a[4]
        b0, b1, b2, b3, b4 = b[0], b[1], b[2], b[3], b[4]
        if reverse:
            a0, a1, a3, a4 = a4, a3, a1, a0
            b0, b1, b3, b4 = b4, b3, b1, b0
        for t in range(np.uint64(n)):  # unsigned: numba is slow where an index may be negative
            p, q, r, s, u = x[t], x[t + one], x[t + two], x[t + three], x[t + four]
            made[t] += a0 * p + a1 * q + a2 * r + a3 * s + a4 * u
            also[t] += b0 * p + b1 * q + b2 * r + b3 * s + b4 * u


@compiled(fastmath={"contract"})
def _add_one(
    made: np.ndarray,
    signal: np.ndarray,
    weight: np.ndarray,
    reads: np.ndarray,
    start: int,
    n: int,
    reverse: bool,
) -> None:
    """The same for a row by itself. In a function with `_add_two`, both would be slower."""
    one, two, three, four = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)
    for j in range(len(reads)):
        x = signal[reads[j, 0], start:]
        a = weight[reads[j, 1] :]
        a0, a1, a2, a3, a4 = a[0], a[1], a[2], a[3], a[4]
        if reverse:
            a0, a1, a3, a4 = a4, a3, a1, a0
        for t in range(np.uint64(n)):
            p, q, r, s, u = x[t], x[t + one], x[t + two], x[t + three], x[t + four]
            made[t] += a0 * p + a1 * q + a2 * r + a3 * s + a4 * u


@compiled()
def _mirror(window: np.ndarray, n_frames: int) -> None:
    """Of one window, which begins two before its first frame."""
    for k in range(1, _EDGE + 1):
        window[_EDGE - k] = window[_EDGE + k]
        window[_EDGE + n_frames - 1 + k] = window[_EDGE + n_frames - 1 - k]


@compiled()
def _fold(window: np.ndarray, n_frames: int) -> None:
    """The transpose of `_mirror`."""
    for k in range(1, _EDGE + 1):
        before, after = _EDGE - k, _EDGE + n_frames - 1 + k
        window[_EDGE + k] += window[before]
        window[_EDGE + n_frames - 1 - k] += window[after]
        window[before] = window[after] = 0


@compiled()
def _mirror_rows(signal: np.ndarray, batch: int, n_frames: int) -> None:
    for c in range(len(signal)):
        for b in range(batch):
            _mirror(signal[c, _LEAD - _EDGE + b * (n_frames + _GAP) :], n_frames)


@compiled()
def _rectify(window: np.ndarray, gate: np.ndarray, n: int, slope: float) -> None:
    """Scale by the slope where `gate` is not above zero."""
    for t in range(np.uint64(n)):
        value = window[t]
        window[t] = value if gate[t] > 0 else slope * value


@compiled()
def _filter(
    steps: np.ndarray,
    reads: np.ndarray,
    signal: np.ndarray,
    weight: np.ndarray,
    bias: np.ndarray,
    made: np.ndarray,
    gate: np.ndarray,
    slope: float,
    batch: int,
    n_frames: int,
    reverse: bool,
) -> None:
    """Rows of `made`: filtered, folded if reverse, rectified, mirrored if not reverse."""
    pitch, begin = n_frames + _GAP, _LEAD - _EDGE
    stop = begin + batch * pitch
    for start in range(begin, stop, _BLOCK):
        n = min(_BLOCK, stop - start)
        for i in range(len(steps)):
            row, count, first, last, apart = steps[i]
            for c in range(row, row + count):
                made[c, start : start + n] = bias[c]
            here, seen, before = made[row, start:], reads[first:last], start - _EDGE
            if count == 2:
                also = made[row + 1, start:]
                _add_two(here, also, signal, weight, seen, apart, before, n, reverse)
            else:
                _add_one(here, signal, weight, seen, before, n, reverse)
    for i in range(len(steps)):
        for c in range(steps[i, 0], steps[i, 0] + steps[i, 1]):
            made[c, :begin] = 0
            made[c, stop:] = 0
            for b in range(batch):
                window = made[c, begin + b * pitch :]
                if reverse:
                    _fold(window, n_frames)
                if slope != 1:
                    deciding = gate[c] if len(gate) else made[c]
                    deciding = deciding[begin + b * pitch :]
                    _rectify(window[_EDGE:], deciding[_EDGE:], n_frames, slope)
                if not reverse:
                    _mirror(window, n_frames)


@compiled(fastmath={"contract", "reassoc", "nsz"})
def _weight_gradient(
    steps: np.ndarray,
    reads: np.ndarray,
    signal: np.ndarray,
    gradient: np.ndarray,
    made: np.ndarray,
    n: int,
) -> None:
    """Sums over time of products; beyond the ends of windows the gradient is zero."""
    one, two, three, four = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)
    begin = _LEAD - _EDGE
    for i in range(len(steps)):
        row, count, first, last, apart = steps[i]
        g, h = gradient[row, begin:], gradient[row + count - 1, begin:]
        for j in range(first, last):
            x = signal[reads[j, 0], begin - _EDGE :]
            a0 = a1 = a2 = a3 = a4 = b0 = b1 = b2 = b3 = b4 = np.float32(0)
            for t in range(np.uint64(n)):
                p, q, r, s, u = x[t], x[t + one], x[t + two], x[t + three], x[t + four]
                a0 += g[t] * p
                a1 += g[t] * q
                a2 += g[t] * r
                a3 += g[t] * s
                a4 += g[t] * u
                b0 += h[t] * p
                b1 += h[t] * q
                b2 += h[t] * r
                b3 += h[t] * s
                b4 += h[t] * u
            at = reads[j, 1]
            own = made[at:]
            own[0], own[1], own[2], own[3], own[4] = a0, a1, a2, a3, a4
            if count == 2:
                own = made[at + apart :]
                own[0], own[1], own[2], own[3], own[4] = b0, b1, b2, b3, b4


def widened(weight: Tensor, kernel: int) -> Tensor:
    """Live weights of a shorter kernel, (n,), with zeros at its ends."""
    if kernel == TAPS:
        return weight
    missing = (TAPS - kernel) // 2
    return F.pad(weight.view(-1, kernel), (missing, missing)).flatten()


def narrowed(gradient: Tensor, kernel: int) -> Tensor:
    """The gradient of weights that were `widened`."""
    if kernel == TAPS:
        return gradient
    missing = (TAPS - kernel) // 2
    return gradient.view(-1, TAPS)[:, missing : missing + kernel].flatten()
