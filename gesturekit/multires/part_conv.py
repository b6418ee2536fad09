"""Skeleton-aware convolution on a CPU with a sixth of the multiplications of a dense one.

Two things make it so. The blocks of a part of the body see much the same blocks, so that a few
small dense products hold few zeros. And four frames at a time are filtered by the scheme of Cook
and Toom (Winograd 1980; Lavin and Gray 2016 for networks): eight products where five taps on four
frames have twenty, in fp32 to some 1e-6 of the signal.

Between layers a signal stays in the layout that the scheme wants (`Layout`), and channels stand
part by part. Forward, the gradient of the input and that of the weights are functions of their own:
a training step that needs the convolution's derivative as a function (the gradient penalty) calls
them without recording anything.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

TILE = 4
"""Frames filtered at a time."""
_POINTS = (0, 1, -1, 2, -2, 0.5, -0.5)
_BLOCKS_A_PART = 5
"""On average, where a convolution is split. Fewer multiply more zeros, more spend their time on
calls (benchmarks/bench_multires_sample.py)."""


@lru_cache(maxsize=8)
def _schemes(kernel: int) -> tuple[Tensor, Tensor, Tensor]:
    """(P, taps), (P, frames in) and (frames out, P): of taps, signal, and back; P = kernel + 3."""
    n = TILE + kernel - 1
    points = np.array(_POINTS[: n - 1], dtype=np.float64)

    def values(width: int) -> np.ndarray:
        # Of a polynomial at the points, and at infinity.
        last = np.eye(width)[-1:]
        return np.concatenate([points[:, None] ** np.arange(width), last])

    taps, back = values(kernel), values(TILE).T
    signal = np.linalg.inv(values(n)).T
    # Each product may be scaled on one side and back on the other: alike is best for fp32.
    spread = np.sqrt(np.abs(signal).sum(1) / np.abs(taps).sum(1))
    return tuple(
        torch.from_numpy(np.ascontiguousarray(part)).float()
        for part in (taps * spread[:, None], signal / spread[:, None], back)
    )


class Layout:
    """Signals of B windows of T frames as (4, 2 + C x B x (n + 1)): frame 4 i + p in row p.

    Each channel of each window has n = ceil(T / 4) places and one more, which holds the mirrored
    frames behind its end and those before the beginning of the next.
    """

    def __init__(self, batch: int, n_frames: int, padding: int) -> None:
        self.batch, self.n_frames, self.padding = batch, n_frames, padding
        self.places = -(-n_frames // TILE)
        self.row = batch * (self.places + 1)

    @staticmethod
    def fits(n_frames: int, kernel: int) -> bool:
        """Whether mirrored frames fit into the layout; very short signals go another way."""
        return kernel in (3, 5) and n_frames >= 2 * TILE

    def empty(self, channels: int) -> Tensor:
        """Room for a signal of so many channels."""
        signal = torch.empty(TILE, 2 + channels * self.row)
        # Nothing reads what lies before the first and behind the last but to throw it away.
        signal[:, 0] = signal[:, -1] = 0
        return signal

    def windows(self, signal: Tensor) -> Tensor:
        """(4, C, B, n + 1), a view."""
        return signal[:, 1:-1].view(TILE, -1, self.batch, self.places + 1)

    def _edges(self, signal: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Of all channels: see `_edges`."""
        return _edges(self.batch, self.n_frames, self.padding, signal.shape[1])

    def mirror(self, signal: Tensor) -> Tensor:
        """Write the frames beyond the ends."""
        beyond, within, _ = self._edges(signal)
        flat = signal.view(-1)
        flat.index_copy_(0, beyond, flat.index_select(0, within))
        return signal

    def fold(self, signal: Tensor) -> Tensor:
        """The transpose of `mirror`: what lies beyond the ends is added within, and cleared."""
        beyond, within, _ = self._edges(signal)
        flat = signal.view(-1)
        flat.index_add_(0, within, flat.index_select(0, beyond))
        return self.clear(signal)

    def clear(self, signal: Tensor) -> Tensor:
        """Zeros wherever no frame of a window is."""
        signal.view(-1).index_fill_(0, self._edges(signal)[2], 0)
        return signal

    def pack(self, x: Tensor, channels: Tensor) -> Tensor:
        """(B, C, T) to the layout, its channels in this order, cleared."""
        signal = self.empty(len(channels))
        windows = self.windows(signal)
        whole = self.n_frames // TILE
        order = x.index_select(1, channels).transpose(0, 1)
        body = order[..., : whole * TILE].unflatten(-1, (whole, TILE))
        windows[..., :whole] = body.movedim(-1, 0)
        rest = self.n_frames % TILE
        if rest:
            windows[:rest, :, :, whole] = order[..., whole * TILE :].movedim(-1, 0)
        return self.clear(signal)

    def unpack(self, signal: Tensor, channels: Tensor) -> Tensor:
        """The layout to (B, C, T); `channels` says where each channel stands."""
        windows = self.windows(signal)[..., : self.places].index_select(1, channels)
        return windows.permute(2, 1, 3, 0).flatten(2)[..., : self.n_frames]


@lru_cache(maxsize=128)
def _edges(batch: int, n_frames: int, padding: int, width: int) -> tuple[Tensor, Tensor, Tensor]:
    """Where frames beyond the ends stand in a `Layout`, where those that they mirror do, and where
    no frame does; `width` is the layout's, and places count from the beginning of the first row."""
    places = -(-n_frames // TILE)
    starts = 1 + np.arange((width - 2) // (places + 1)) * (places + 1)

    def at(frame: int) -> np.ndarray:
        # A frame before the first stands in the place before: floor division goes downwards.
        return frame % TILE * width + starts + frame // TILE

    ahead = range(1, padding + 1)
    beyond = [at(-k) for k in ahead] + [at(n_frames - 1 + k) for k in ahead]
    within = [at(k) for k in ahead] + [at(n_frames - 1 - k) for k in ahead]
    blank = [at(frame) for frame in range(n_frames, TILE * (places + 1))]
    blank.append(np.arange(TILE) * width)
    return tuple(
        torch.from_numpy(np.concatenate(part or [np.empty(0, dtype=np.int64)]))
        for part in (beyond, within, blank)
    )


class Parts:
    """How the channels of a convolution are split; the same for all layers of one shape.

    Attributes:
        order_in: which channels stand where in the layout, of what comes in.
        order_out: the same, of what goes out.
    """

    def __init__(
        self, neighbours: np.ndarray, sizes_in: Sequence[int], sizes_out: Sequence[int], kernel: int
    ) -> None:
        self.kernel = kernel
        self.taps, self.signal, self.back = _schemes(kernel)
        parts = body_parts(neighbours.tobytes(), len(neighbours))
        order = np.concatenate([np.array(part) for part in parts])
        self.order_in, self.order_out = _channels(sizes_in, order), _channels(sizes_out, order)
        self.back_in, self.back_out = torch.argsort(self.order_in), torch.argsort(self.order_out)
        self.n_in, self.n_out = len(self.order_in), len(self.order_out)
        mask = np.repeat(np.repeat(neighbours, sizes_out, axis=0), sizes_in, axis=1)
        live = np.nonzero(mask)
        self.forward_reads, self.live = _split(parts, neighbours, sizes_in, sizes_out, live)
        self.reverse_reads, reverse = _split(parts, neighbours.T, sizes_out, sizes_in, live[::-1])
        self.forward_at = _filled(self.live, self.forward_reads)
        self.reverse_at = _filled(reverse, self.reverse_reads)

    def _products(
        self, weight: Tensor, at: Tensor, reads: list[tuple[Tensor, int]]
    ) -> list[Tensor]:
        live = torch.cat([weight.view(-1, self.kernel), weight.new_zeros(1, self.kernel)])
        whole = self.taps @ live.index_select(0, at).T
        split = whole.split([len(seen) * own for seen, own in reads], dim=1)
        return [
            part.view(len(whole), own, len(seen))
            for part, (seen, own) in zip(split, reads, strict=True)
        ]

    def forward_weights(self, weight: Tensor) -> list[Tensor]:
        """Live weights, transformed, part by part: (P, own, seen) each."""
        return self._products(weight, self.forward_at, self.forward_reads)

    def reverse_weights(self, weight: Tensor) -> list[Tensor]:
        """The same for the gradient of what comes in."""
        return self._products(weight, self.reverse_at, self.reverse_reads)

    def _transformed(self, signal: Tensor, layout: Layout) -> Tensor:
        """(P, C, row) of a mirrored signal."""
        pad, scheme = self.kernel // 2, self.signal
        whole = scheme[:, pad : pad + TILE] @ signal[:, 1:-1]
        whole.addmm_(scheme[:, :pad], signal[TILE - pad :, :-2])
        whole.addmm_(scheme[:, pad + TILE :], signal[:pad, 2:])
        return whole.view(len(scheme), -1, layout.row)

    def forward(
        self, weights: list[Tensor], bias: Tensor | None, signal: Tensor, layout: Layout
    ) -> tuple[Tensor, list[Tensor]]:
        """Filter a mirrored signal; `bias` in the layout's order.

        Returns:
            what comes out, and what each part saw, transformed: (P, seen, row) each.
        """
        whole, seen = self._transformed(signal, layout), []
        out, start = layout.empty(self.n_out), 1
        for weight, (reads, _) in zip(weights, self.forward_reads, strict=True):
            # One part after the other, while what it reads is at hand.
            seen.append(whole.index_select(1, reads))
            made = torch.bmm(weight, seen[-1])
            stop = start + weight.shape[1] * layout.row
            torch.mm(self.back, made.view(len(made), -1), out=out[:, start:stop])
            start = stop
        if bias is not None:
            layout.windows(out).add_(bias[:, None, None])
        return out, seen

    def spread(self, gradient: Tensor, layout: Layout) -> Tensor:
        """(P, C, row) of the gradient of what went out, cleared beyond the ends."""
        whole = self.back.T @ gradient[:, 1:-1]
        return whole.view(len(whole), -1, layout.row)

    def input_gradient(self, weights: list[Tensor], spread: Tensor, layout: Layout) -> Tensor:
        """The gradient of what came in, folded and cleared."""
        pad, scheme = self.kernel // 2, self.signal
        out, start = layout.empty(self.n_in), 1
        for weight, (seen, own) in zip(weights, self.reverse_reads, strict=True):
            made = torch.bmm(weight, spread.index_select(1, seen)).view(len(scheme), -1)
            stop = start + own * layout.row
            torch.mm(scheme[:, pad : pad + TILE].T, made, out=out[:, start:stop])
            out[TILE - pad :, start - 1 : stop - 1].addmm_(scheme[:, :pad].T, made)
            # Nothing runs over the end of a part: its last place holds no frame.
            made = made[:, :-1]
            out[:pad, start + 1 : stop].addmm_(scheme[:, pad + TILE :].T, made)
            start = stop
        return layout.fold(out)

    def weight_gradient(self, spread: Tensor, seen: list[Tensor]) -> Tensor:
        """Of the live weights."""
        parts, start = [], 0
        for part, (_, own) in zip(seen, self.forward_reads, strict=True):
            product = torch.bmm(spread[:, start : start + own], part.transpose(1, 2))
            parts.append(product.view(len(product), -1))
            start += own
        taps = torch.cat(parts, dim=1).T @ self.taps
        return taps.index_select(0, self.live).view(-1)

    def bias_gradient(self, spread: Tensor) -> Tensor:
        """In the layout's order: at the point 1 the spread is the sum over each four frames."""
        return spread[1].sum(dim=1)


@lru_cache(maxsize=64)
def body_parts(neighbours: bytes, n_blocks: int) -> tuple[tuple[int, ...], ...]:
    """Blocks (B, B) of whom each sees whom, joined into parts that see much the same.

    Two at a time, those whose union multiplies the fewest zeros.
    """
    near = np.frombuffer(neighbours, dtype=bool).reshape(n_blocks, n_blocks)
    parts, seen = [(block,) for block in range(n_blocks)], near.astype(np.int64)
    while len(parts) > max(1, round(n_blocks / _BLOCKS_A_PART)):
        own, width = np.array([len(part) for part in parts]), seen.sum(axis=1)
        union = width[:, None] + width - seen @ seen.T
        more = (own[:, None] + own) * union - (own * width)[:, None] - own * width
        np.fill_diagonal(more, np.iinfo(more.dtype).max)
        one, other = sorted(np.unravel_index(more.argmin(), more.shape))
        parts[one] += parts.pop(other)
        seen[one] |= seen[other]
        seen = np.delete(seen, other, axis=0)
    return tuple(tuple(sorted(part)) for part in parts)


def _split(
    parts: Sequence[tuple[int, ...]],
    neighbours: np.ndarray,
    sizes_in: Sequence[int],
    sizes_out: Sequence[int],
    live: Sequence[np.ndarray],
) -> tuple[list[tuple[Tensor, int]], Tensor]:
    """For each part (where what it sees stands, its own width); where live weights go."""
    order = np.concatenate([np.array(part) for part in parts])
    stands = torch.argsort(_channels(sizes_in, order)).numpy()
    places = np.full((sum(sizes_out), sum(sizes_in)), -1)
    reads, start = [], 0
    for part in parts:
        seen = _channels(sizes_in, np.flatnonzero(neighbours[list(part)].any(axis=0))).numpy()
        seen = seen[np.argsort(stands[seen])]
        own = _channels(sizes_out, part).numpy()
        size = len(own) * len(seen)
        places[np.ix_(own, seen)] = start + np.arange(size).reshape(len(own), len(seen))
        start += size
        reads.append((torch.from_numpy(stands[seen]), len(own)))
    return reads, torch.from_numpy(places[live])


def _channels(sizes: Sequence[int], blocks: Sequence[int]) -> Tensor:
    """Where the channels of these blocks stand."""
    starts = np.cumsum((0, *sizes))
    return torch.from_numpy(np.concatenate([np.arange(starts[b], starts[b + 1]) for b in blocks]))


def _filled(at: Tensor, reads: list[tuple[Tensor, int]]) -> Tensor:
    """Which live weight stands at each place of the parts' kernels; the one past the last: none."""
    weights = torch.full((sum(len(seen) * own for seen, own in reads),), len(at))
    weights[at] = torch.arange(len(at))
    return weights
