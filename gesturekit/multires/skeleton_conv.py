"""Skeleton-aware convolution: each joint sees the joints near it on the rig's own tree.

Aberman et al. 2020, in the form of Li et al. 2022 (GANimator). The channels of a frame are split
into blocks: one a modelled joint, one a foot contact, one for the root's displacement.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gesturekit.motion.representation import MultiresRepresentation
from gesturekit.multires.interpolation import reflect

_BLOCKS_A_PART = 5
"""On average, where a convolution is split. Fewer multiply more zeros, more spend their time on
calls (benchmarks/bench_multires_sample.py)."""


def block_neighbours(representation: MultiresRepresentation, distance: int) -> np.ndarray:
    """(B, B) bool: which blocks see which.

    Joints at most `distance` bones apart see one another. A contact stands at its foot's joint.
    The root's displacement stands at the root joint and sees all contacts.
    """
    skeleton = representation.skeleton
    joints = [skeleton.index(name) for name in representation.joints]
    # Distances over the whole rig: a joint that is not modelled still lies between its neighbours.
    n_joints = skeleton.n_joints
    apart = np.full((n_joints, n_joints), np.inf)
    np.fill_diagonal(apart, 0)
    for child, parent in enumerate(skeleton.parents):
        if parent >= 0:
            apart[child, parent] = apart[parent, child] = 1
    for middle in range(n_joints):
        apart = np.minimum(apart, apart[:, middle, None] + apart[None, middle])
    feet = [skeleton.index(point.joint) for point in representation.foot_points]
    places = [*joints, *feet, representation.root]
    near = apart[np.ix_(places, places)] <= distance
    contacts = slice(len(joints), len(joints) + len(feet))
    near[-1, contacts] = near[contacts, -1] = True
    return near


class SkeletonConv1d(nn.Module):
    """Convolution over time whose output blocks see only the input blocks near them.

    Only live weights are parameters: some 80 % of the dense kernel is zero and costs neither
    memory, nor optimiser state, nor room in the model file. In training the arithmetic is a dense
    convolution, which with its backward pass beats grouped and gathered ones at these sizes
    (benchmarks/RESULTS.md). In evaluation without gradients it is a few dense convolutions, one for
    each part of the body, whose weights are laid out once; sums then run in another order.

    Args:
        neighbours: (B, B) bool, from `block_neighbours`.
        sizes_in: channels of each input block.
        sizes_out: channels of each output block.
        kernel: odd number of frames; the ends are padded by reflection.
    """

    live: Tensor

    def __init__(
        self, neighbours: np.ndarray, sizes_in: Sequence[int], sizes_out: Sequence[int], kernel: int
    ) -> None:
        super().__init__()
        self.padding = kernel // 2
        self.neighbours = neighbours
        self.sizes = (tuple(sizes_in), tuple(sizes_out))
        self.shape = (sum(sizes_out), sum(sizes_in), kernel)
        mask = np.repeat(np.repeat(neighbours, sizes_out, axis=0), sizes_in, axis=1)
        live = np.flatnonzero(np.repeat(mask[..., None], kernel, axis=2))
        self.register_buffer("live", torch.from_numpy(live), persistent=False)
        # Each output channel starts as a layer of its own fan-in would (Kaiming, a = sqrt 5).
        bound = 1 / np.sqrt(kernel * mask.sum(axis=1))
        per_weight = np.broadcast_to(bound[:, None, None], self.shape).reshape(-1)[live]
        self.weight = nn.Parameter(torch.empty(len(live)).uniform_(-1, 1))
        self.bias = nn.Parameter(torch.empty(self.shape[0]).uniform_(-1, 1))
        with torch.no_grad():
            self.weight.mul_(torch.from_numpy(per_weight.astype(np.float32)))
            self.bias.mul_(torch.from_numpy(bound.astype(np.float32)))
        self._laid_out: tuple[tuple, _PartConvs] | None = None

    def dense_weight(self) -> Tensor:
        """(channels out, channels in, kernel), zero where blocks do not see one another."""
        dense = self.weight.new_zeros(math.prod(self.shape))
        return dense.index_put((self.live,), self.weight).view(self.shape)

    def forward(self, x: Tensor) -> Tensor:
        """(B, channels in, T) to (B, channels out, T)."""
        if self.training or torch.is_grad_enabled() or x.device.type != "cpu":
            return F.conv1d(reflect(x, self.padding), self.dense_weight(), self.bias)
        pad = self.padding
        if x.shape[-1] <= pad:
            return self._split()(reflect(x, pad))
        # The same, four times as fast as by index; training keeps to the other's gradients.
        ends = x[..., 1 : pad + 1].flip(-1), x[..., -pad - 1 : -1].flip(-1)
        return self._split()(torch.cat([ends[0], x, ends[1]], dim=-1))

    def _split(self) -> _PartConvs:
        """The layer as it is now, split; made anew where its weights have changed."""
        state = tuple((_version(p), p.data_ptr()) for p in (self.weight, self.bias))
        if self._laid_out is None or self._laid_out[0] != state:
            self._laid_out = state, _PartConvs(self)
        return self._laid_out[1]


class _PartConvs:
    """A skeleton-aware convolution as one dense convolution for each part of the body.

    The blocks of a part see much the same blocks, so that few of its weights are zero.
    """

    def __init__(self, conv: SkeletonConv1d) -> None:
        sizes_in, sizes_out = conv.sizes
        dense = conv.dense_weight().detach()
        reads, writes, self.layers = [], [], []
        for part in _parts(conv.neighbours.tobytes(), len(conv.neighbours)):
            seen = _channels(sizes_in, np.flatnonzero(conv.neighbours[list(part)].any(axis=0)))
            own = _channels(sizes_out, part)
            reads.append(seen)
            writes.append(own)
            weight = dense[own][:, seen].contiguous()
            self.layers.append((len(seen), weight, conv.bias.detach()[own]))
        self.reads = torch.cat(reads)
        self.back = torch.argsort(torch.cat(writes))

    def __call__(self, x: Tensor) -> Tensor:
        """(B, channels in, T + kernel - 1) to (B, channels out, T)."""
        seen, made, start = x.index_select(1, self.reads), [], 0
        for width, weight, bias in self.layers:
            made.append(F.conv1d(seen[:, start : start + width], weight, bias))
            start += width
        return torch.cat(made, dim=1).index_select(1, self.back)


@lru_cache(maxsize=64)
def _parts(neighbours: bytes, n_blocks: int) -> tuple[tuple[int, ...], ...]:
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


def _channels(sizes: Sequence[int], blocks: Sequence[int]) -> Tensor:
    """Where the channels of these blocks stand."""
    starts = np.cumsum((0, *sizes))
    return torch.from_numpy(np.concatenate([np.arange(starts[b], starts[b + 1]) for b in blocks]))


def _version(parameter: Tensor) -> int:
    """Grows with each change in place; a tensor made in inference mode does not count them."""
    return 0 if parameter.is_inference() else parameter._version
