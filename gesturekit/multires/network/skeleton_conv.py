"""Skeleton-aware convolution: each joint sees the joints near it on the rig's own tree.

Aberman et al. 2020, in the form of Li et al. 2022 (GANimator). The channels of a frame are split
into blocks: one a modelled joint, one a foot contact, one for the root's displacement.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import lru_cache
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gesturekit.multires.cpu.kernels import TAPS
from gesturekit.multires.cpu.sparse_conv import Rows, Wiring, narrowed, widened
from gesturekit.multires.cpu.threads import only_rows_in_threads
from gesturekit.multires.motion_vector import MultiresRepresentation
from gesturekit.multires.network.resampling import reflect


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
    `live_conv`; on other devices, for kernels of more than five frames and for one or two frames, a
    dense convolution.

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

    def dense_weight(self) -> Tensor:
        """(channels out, channels in, kernel), zero where blocks do not see one another."""
        dense = self.weight.new_zeros(math.prod(self.shape))
        return dense.index_put((self.live,), self.weight).view(self.shape)

    def dense(self, x: Tensor) -> Tensor:
        """The same as `forward`, by one dense convolution."""
        return F.conv1d(reflect(x, self.padding), self.dense_weight(), self.bias)

    def forward(self, x: Tensor, compiled: bool = True) -> Tensor:
        """(B, channels in, T) to (B, channels out, T); `compiled` as in `chained`."""
        return chained([self], x, compiled=compiled)

    def is_live(self, x: Tensor) -> bool:
        """Whether a signal (..., T) is filtered by live weights alone."""
        exact = x.dtype == self.weight.dtype == torch.float32
        on_cpu = x.device.type == "cpu" and not torch.is_autocast_enabled("cpu")
        return exact and on_cpu and Rows.fits(x.shape[-1], self.shape[-1])

    @property
    def wiring(self) -> Wiring:
        """Which channels make which."""
        near = self.neighbours
        return _wiring(near.tobytes(), len(near), *self.sizes)

    def live_weights(self) -> np.ndarray:
        """The weights as `Wiring` wants them."""
        return widened(self.weight.detach(), self.shape[-1]).numpy()

    def live_gradient(self, signal: np.ndarray, gradient: np.ndarray, rows: Rows) -> Tensor:
        """Of the weights, by what came in and the gradient of what went out."""
        return narrowed(self.wiring.weight_gradient(signal, gradient, rows), self.shape[-1])


def threads_for(layer: SkeletonConv1d, like: Tensor) -> AbstractContextManager[None]:
    """Threads for rows alone where this layer filters live weights in tensors such as this one.

    Dense convolutions, on a GPU or in half precision, share their own work.
    """
    is_live = layer.is_live(like.new_empty(TAPS))
    return only_rows_in_threads() if is_live else nullcontext()


def chained(
    layers: Sequence[SkeletonConv1d],
    x: Tensor,
    slope: float = 1.0,
    last_slope: float = 1.0,
    compiled: bool = True,
) -> Tensor:
    """Layers one after the other, with leaky rectifiers between them.

    Args:
        layers: each reads the blocks that the one before it makes.
        x: (B, channels in, T).
        slope: of the rectifiers below zero.
        last_slope: of the one behind the last layer; 1 for none.
        compiled: filter live weights by compiled kernels where they can; False takes dense
            convolutions, which need no compiling and differ in the last bits.

    Returns:
        (B, channels out, T).
    """
    slopes = (*(slope for _ in layers[1:]), last_slope)
    if compiled and all(layer.is_live(x) for layer in layers):
        weights = (part for layer in layers for part in (layer.weight, layer.bias))
        return _LiveFilters.apply(x, layers, slopes, *weights)
    return _dense(layers, slopes, x)


def _dense(layers: Sequence[SkeletonConv1d], slopes: Sequence[float], x: Tensor) -> Tensor:
    for layer, slope in zip(layers, slopes, strict=True):
        x = layer.dense(x)
        x = x if slope == 1 else F.leaky_relu(x, slope)
    return x


@lru_cache(maxsize=64)
def _wiring(
    neighbours: bytes, n_blocks: int, sizes_in: tuple[int, ...], sizes_out: tuple[int, ...]
) -> Wiring:
    near = np.frombuffer(neighbours, dtype=bool).reshape(n_blocks, n_blocks)
    return Wiring(near, sizes_in, sizes_out)


class _LiveFilters(torch.autograd.Function):
    """`live_conv` under autograd; a gradient of a gradient goes by dense convolutions."""

    @staticmethod
    def forward(
        ctx: Any,
        x: Tensor,
        layers: Sequence[SkeletonConv1d],
        slopes: Sequence[float],
        *parameters: Tensor,
    ) -> Tensor:
        rows = Rows(len(x), x.shape[-1])
        signals = [rows.mirrored(x.detach())]
        for layer, slope in zip(layers, slopes, strict=True):
            weight, bias = layer.live_weights(), layer.bias.detach().numpy()
            made = layer.wiring.forward(weight, bias, signals[-1], rows, slope)
            if any(ctx.needs_input_grad):
                signals.append(made)
            else:
                signals = [made]
        ctx.layers, ctx.slopes, ctx.rows, ctx.signals = layers, slopes, rows, signals
        ctx.save_for_backward(x, *parameters)
        return rows.unpack(signals[-1])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        layers, slopes, rows, signals = ctx.layers, ctx.slopes, ctx.rows, ctx.signals
        x, *parameters = ctx.saved_tensors
        wanted = (ctx.needs_input_grad[0], *ctx.needs_input_grad[3:])
        if torch.is_grad_enabled():
            inputs = [part for part, want in zip((x, *parameters), wanted, strict=True) if want]
            made = torch.autograd.grad(
                _dense(layers, slopes, x), inputs, gradient, create_graph=True
            )
            found = iter(made)
            by_input, *by_parameters = (next(found) if want else None for want in wanted)
            return by_input, None, None, *by_parameters
        gradient = rows.pack(gradient)
        if slopes[-1] != 1:
            gradient[signals[-1] <= 0] *= slopes[-1]
        found: list[Tensor | None] = []
        for i in reversed(range(len(layers))):
            layer, (by_weight, by_bias) = layers[i], wanted[1 + 2 * i : 3 + 2 * i]
            found.insert(0, torch.from_numpy(gradient.sum(axis=1)) if by_bias else None)
            found.insert(0, layer.live_gradient(signals[i], gradient, rows) if by_weight else None)
            if any(wanted[: 1 + 2 * i]):
                back = (signals[i], slopes[i - 1]) if i else (None, 1.0)
                gradient = layer.wiring.input_gradient(layer.live_weights(), gradient, rows, *back)
        return rows.unpack(gradient) if wanted[0] else None, None, None, *found
