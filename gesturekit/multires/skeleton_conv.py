"""Skeleton-aware convolution: each joint sees the joints near it on the rig's own tree.

Aberman et al. 2020, in the form of Li et al. 2022 (GANimator). The channels of a frame are split
into blocks: one a modelled joint, one a foot contact, one for the root's displacement.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gesturekit.motion.representation import MultiresRepresentation
from gesturekit.multires.interpolation import reflect
from gesturekit.multires.part_conv import Layout, Parts


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
    memory, nor optimiser state, nor room in the model file. On a CPU the arithmetic is that of
    `part_conv`; on other devices, and for a handful of frames, a dense convolution.

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
        self._laid_out: dict[str, tuple[tuple, list[Tensor]]] = {}

    def dense_weight(self) -> Tensor:
        """(channels out, channels in, kernel), zero where blocks do not see one another."""
        dense = self.weight.new_zeros(math.prod(self.shape))
        return dense.index_put((self.live,), self.weight).view(self.shape)

    def dense(self, x: Tensor) -> Tensor:
        """The same as `forward`, by one dense convolution."""
        return F.conv1d(reflect(x, self.padding), self.dense_weight(), self.bias)

    def forward(self, x: Tensor) -> Tensor:
        """(B, channels in, T) to (B, channels out, T)."""
        if not self.in_parts(x):
            return self.dense(x)
        return _PartFilter.apply(x, self.weight, self.bias, self)

    def in_parts(self, x: Tensor) -> bool:
        """Whether a signal (..., T) is filtered part by part."""
        exact = x.dtype == self.weight.dtype == torch.float32
        on_cpu = x.device.type == "cpu" and not torch.is_autocast_enabled("cpu")
        return exact and on_cpu and Layout.fits(x.shape[-1], self.shape[-1])

    @property
    def parts(self) -> Parts:
        """How the layer is split."""
        near = self.neighbours
        return _split(near.tobytes(), len(near), *self.sizes, self.shape[-1])

    def forward_weights(self) -> list[Tensor]:
        """`Parts.forward_weights` of the weights as they are now."""
        return self._transformed("forward", self.parts.forward_weights)

    def reverse_weights(self) -> list[Tensor]:
        """`Parts.reverse_weights` of the weights as they are now."""
        return self._transformed("reverse", self.parts.reverse_weights)

    @torch.no_grad()
    def _transformed(self, way: str, make: Callable[[Tensor], list[Tensor]]) -> list[Tensor]:
        """Made anew where the weights have changed."""
        state = _version(self.weight), self.weight.data_ptr()
        if way not in self._laid_out or self._laid_out[way][0] != state:
            self._laid_out[way] = state, make(self.weight.detach())
        return self._laid_out[way][1]


@torch.no_grad()
def chained(layers: Sequence[SkeletonConv1d], x: Tensor, slope: float) -> Tensor:
    """Layers `in_parts` one after the other, with leaky rectifiers between them.

    Between them the signal stays in its layout; nothing is recorded for gradients.

    Args:
        layers: each reads the blocks that the one before it makes.
        x: (B, channels in, T).
        slope: of the rectifiers below zero.

    Returns:
        (B, channels out, T).
    """
    layout = Layout(len(x), x.shape[-1], layers[0].padding)
    signal = layout.pack(x, layers[0].parts.order_in)
    for i, layer in enumerate(layers):
        if i:
            F.leaky_relu_(signal, slope)
        parts = layer.parts
        bias = layer.bias[parts.order_out]
        signal, _ = parts.forward(layer.forward_weights(), bias, layout.mirror(signal), layout)
    return layout.unpack(signal, layers[-1].parts.back_out)


@lru_cache(maxsize=64)
def _split(
    neighbours: bytes,
    n_blocks: int,
    sizes_in: tuple[int, ...],
    sizes_out: tuple[int, ...],
    kernel: int,
) -> Parts:
    near = np.frombuffer(neighbours, dtype=bool).reshape(n_blocks, n_blocks)
    return Parts(near, sizes_in, sizes_out, kernel)


class _PartFilter(torch.autograd.Function):
    """`part_conv` under autograd; a gradient of a gradient goes by the dense convolution."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor, conv: SkeletonConv1d) -> Tensor:
        parts, layout = conv.parts, Layout(len(x), x.shape[-1], conv.padding)
        signal = layout.mirror(layout.pack(x, parts.order_in))
        bias_here = bias[parts.order_out]
        made, seen = parts.forward(conv.forward_weights(), bias_here, signal, layout)
        ctx.conv, ctx.layout, ctx.seen = conv, layout, seen if weight.requires_grad else None
        ctx.save_for_backward(x, weight, bias)
        return layout.unpack(made, parts.back_out)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        x, weight, bias = ctx.saved_tensors
        conv, layout, parts = ctx.conv, ctx.layout, ctx.conv.parts
        if torch.is_grad_enabled():
            wanted = [part for part in (x, weight, bias) if part.requires_grad]
            found = iter(torch.autograd.grad(conv.dense(x), wanted, gradient, create_graph=True))
            return *(next(found) if p.requires_grad else None for p in (x, weight, bias)), None
        spread = parts.spread(layout.pack(gradient, parts.order_out), layout)
        by_input = by_weight = by_bias = None
        if ctx.needs_input_grad[0]:
            made = parts.input_gradient(conv.reverse_weights(), spread, layout)
            by_input = layout.unpack(made, parts.back_in)
        if ctx.needs_input_grad[1]:
            by_weight = parts.weight_gradient(spread, ctx.seen)
        if ctx.needs_input_grad[2]:
            by_bias = parts.bias_gradient(spread)[parts.back_out]
        return by_input, by_weight, by_bias, None


def _version(parameter: Tensor) -> int:
    """Grows with each change in place; a tensor made in inference mode does not count them."""
    return 0 if parameter.is_inference() else parameter._version
