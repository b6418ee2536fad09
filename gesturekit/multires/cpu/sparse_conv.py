"""Skeleton-aware convolution on a CPU: products with live weights alone (`row_kernels`).

A signal has one row a channel, with all frames of all windows in it (`Rows`). Each row that comes
out is a sum of shifted rows of the channels that it sees, two rows at a time: ten products for
every five numbers read. Nothing is laid out anew beforehand, neither weights nor signals, and
rectifiers and mirrored ends are seen to while a row is at hand.

Forward, the gradient of the input and that of the weights are functions of their own. Rows are
shared among as many threads as torch may use. What comes out is the same to the bit, however many
there are and whatever other windows or frames are filtered with it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from gesturekit.multires.cpu.kernels import (
    EDGE,
    GAP,
    LEAD,
    LINE,
    TAPS,
    filter_rows,
    pack_rows,
    unpack_rows,
    weight_gradients,
    whole,
)
from gesturekit.multires.cpu.threads import row_threads, submit

_ALONE = 16_000_000
"""Products that one thread makes sooner than others would come to help."""


class Rows:
    """Signals of B windows of T frames as (C, width): the windows of a channel, one after another.

    Between windows, and at both ends, is room for what lies beyond their frames: two mirrored
    frames behind one and two before the next, or, in a gradient, zeros.
    """

    def __init__(self, batch: int, n_frames: int) -> None:
        self.batch, self.n_frames = batch, n_frames
        self.pitch = n_frames + GAP
        # Whole lines are made, and two numbers behind them read.
        self.width = LEAD - EDGE + whole(batch * self.pitch, LINE) + LINE

    @staticmethod
    def fits(n_frames: int, kernel: int) -> bool:
        """Whether frames can be mirrored in place; very short signals go another way."""
        return kernel <= TAPS and n_frames > EDGE

    def empty(self, channels: int) -> np.ndarray:
        """For a signal of so many channels; torch's arrays begin where a processor likes it."""
        return torch.empty(channels, self.width).numpy()

    def pack(self, x: Tensor) -> np.ndarray:
        """(B, C, T) with zeros beyond the ends."""
        return self._packed(x, False)

    def mirrored(self, x: Tensor) -> np.ndarray:
        """(B, C, T) with mirrored frames beyond the ends."""
        return self._packed(x, True)

    def _packed(self, x: Tensor, mirrored: bool) -> np.ndarray:
        signal = self.empty(x.shape[1])
        pack_rows(x.contiguous().numpy(), signal, mirrored)
        return signal

    def unpack(self, signal: np.ndarray) -> Tensor:
        """The frames as (B, C, T)."""
        windows = torch.empty(self.batch, len(signal), self.n_frames)
        unpack_rows(signal, windows.numpy())
        return windows


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
        self,
        weight: np.ndarray,
        bias: np.ndarray,
        signal: np.ndarray,
        rows: Rows,
        slope: float,
    ) -> np.ndarray:
        """Filter a mirrored signal, rectify it with this slope below zero, and mirror it."""
        return self._filter(self.forward_plan, weight, bias, signal, rows, signal[:0], slope, False)

    def forward_along(
        self,
        weight: np.ndarray,
        direction: np.ndarray,
        rows: Rows,
        signal: np.ndarray,
        slope: float,
    ) -> np.ndarray:
        """The derivative of `forward`, which gave `signal`, in a direction of what came in."""
        none = np.zeros(self.n_out, np.float32)
        return self._filter(self.forward_plan, weight, none, direction, rows, signal, slope, False)

    def input_gradient(
        self,
        weight: np.ndarray,
        gradient: np.ndarray,
        rows: Rows,
        signal: np.ndarray | None = None,
        slope: float = 1.0,
    ) -> np.ndarray:
        """The gradient of what came in, and back through the rectifier that gave `signal`."""
        none = np.zeros(self.n_in, np.float32)
        gate = gradient[:0] if signal is None else signal
        return self._filter(self.reverse_plan, weight, none, gradient, rows, gate, slope, True)

    def weight_gradient(self, signal: np.ndarray, gradient: np.ndarray, rows: Rows) -> Tensor:
        """Of the live weights, (n,)."""
        made = torch.empty(self.n_live)
        _in_shares(
            weight_gradients,
            self.forward_plan,
            signal,
            gradient,
            made.numpy(),
            rows.batch * rows.pitch,
            products=self.n_live * rows.width,
        )
        return made

    def _filter(
        self,
        plan: Plan,
        weight: np.ndarray,
        bias: np.ndarray,
        signal: np.ndarray,
        rows: Rows,
        gate: np.ndarray,
        slope: float,
        reverse: bool,
    ) -> np.ndarray:
        made = rows.empty(len(bias))
        _in_shares(
            filter_rows,
            plan,
            signal,
            weight,
            bias,
            made,
            gate,
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


def _in_shares(function: Callable[..., None], plan: Plan, *arguments: Any, products: int) -> None:
    """Call a compiled function for all steps of a plan, on as many threads as rows may use."""
    own, *others = plan.shares(row_threads() if products > _ALONE else 1)
    waiting = [
        submit("rows", function, plan.steps[first:last], plan.reads, *arguments)
        for first, last in others
    ]
    function(plan.steps[slice(*own)], plan.reads, *arguments)
    for one in waiting:
        one.result()


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
