"""Layers along time and along the skeleton, of which the networks are made.

Resampling and padding are index operations: torch has deterministic backward passes of these on a
GPU (`torch.use_deterministic_algorithms`), but not of its own interpolation and reflection padding.
On a CPU numpy gathers frames several times faster than torch. The interpolation weights are those
of the audio front-end, so that motion and speech features have the same frame times.

A skeleton-aware convolution connects each joint to the joints near it in the skeleton's tree
(Aberman et al. 2020, in the form of Li et al. 2022, GANimator). The channels of a frame are split
into blocks: one for each modelled joint and each foot contact, and one for the root's displacement.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache
from typing import Any, TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from scipy.sparse import coo_array
from scipy.sparse.csgraph import shortest_path
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from audio_features.pyramid import interpolation_weights
from gesturekit.errors import ConfigError
from gesturekit.motion.parts import unidentified, upper_body
from gesturekit.multires.config import NetworkConfig
from gesturekit.multires.motion_vector import MultiresRepresentation


@lru_cache(maxsize=4096)
def _weights(n_in: int, n_out: int, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor]:
    low, high, weight = map(torch.from_numpy, interpolation_weights(n_in, n_out))
    return low, high, weight.to(dtype)


def resample(x: Tensor, n_frames: int) -> Tensor:
    """Return x (..., T) as (..., n_frames): linear interpolation with align_corners=False."""
    if x.shape[-1] == n_frames:
        return x
    return _interpolate(x, *_weights(x.shape[-1], n_frames, x.dtype))


def resample_part(x: Tensor, n_frames: int, start: int, stop: int) -> Tensor:
    """Return frames `start` to `stop` of `resample(x, n_frames)`, equal in every bit."""
    if x.shape[-1] == n_frames:
        return x[..., start:stop]
    if (start, stop) == (0, n_frames):
        return resample(x, n_frames)
    low, high, weight = map(
        torch.from_numpy, interpolation_weights(x.shape[-1], n_frames, start, stop)
    )
    return _interpolate(x, low, high, weight.to(x.dtype))


def _interpolate(x: Tensor, low: Tensor, high: Tensor, weight: Tensor) -> Tensor:
    """Interpolate between frames `low` and `high`, (n,) each, of x (..., T): (..., n)."""
    if x.device.type == "cpu" and x.dtype == torch.float32:
        return _Interpolate.apply(x, low, high, weight)
    low, high, weight = (part.to(x.device) for part in (low, high, weight))
    below = x.index_select(-1, low)
    return below + weight * (x.index_select(-1, high) - below)


class _Interpolate(torch.autograd.Function):
    """`_interpolate` of float32 on a CPU, equal in every bit, and its transpose."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, low: Tensor, high: Tensor, weight: Tensor) -> Tensor:
        ctx.n_frames = x.shape[-1]
        ctx.places = low, high, weight
        frames = x.numpy()
        below, made = (frames.take(index.numpy(), axis=-1) for index in (low, high))
        made -= below
        made *= weight.numpy()
        made += below
        return torch.from_numpy(made)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None, None]:
        low, high, weight = ctx.places
        # Time comes first: index_add_ is fast where it adds whole rows. Frame by frame, low before
        # high, is the order of the sums.
        gradient = gradient.movedim(-1, 0).contiguous()
        above = weight.reshape(-1, *[1] * (gradient.ndim - 1)) * gradient
        parts = torch.stack([gradient - above, above], dim=1).flatten(0, 1)
        made = gradient.new_zeros(ctx.n_frames, *gradient.shape[1:])
        made.index_add_(0, torch.stack([low, high], dim=1).flatten(), parts)
        return made.movedim(0, -1).contiguous(), None, None, None


@lru_cache(maxsize=4096)
def _reflection(n_frames: int, padding: int) -> Tensor:
    period = max(1, 2 * (n_frames - 1))
    index = torch.arange(-padding, n_frames + padding).remainder(period)
    return torch.minimum(index, period - index).clamp(max=n_frames - 1)


def reflect(x: Tensor, padding: int) -> Tensor:
    """Pad x (..., T) by reflection to (..., T + 2 padding); short signals reflect repeatedly."""
    return x.index_select(-1, _reflection(x.shape[-1], padding).to(x.device))


Modules = TypeVar("Modules", bound=nn.Module)
_MOST_WEIGHTS = 1 << 27  # of a dense kernel; GANimator's have 0.3 million
SLOPE = 0.2
"""Negative slope of the leaky rectifiers, as in GANimator."""


def block_neighbours(
    representation: MultiresRepresentation, distance: int, contact_reach: str = "near"
) -> np.ndarray:
    """Return (blocks, blocks) bool, True where the first block takes the second as input.

    Joints are connected if they are at most `distance` bones apart. A contact label counts as
    located at its foot joint, and the root's displacement as located at the root; it is also
    connected to all contacts. With `contact_reach` "foot", a contact label is an input of its foot
    joint, of labels at that joint, and of the root's displacement only.
    """
    skeleton = representation.skeleton
    # Distances on the whole rig: a joint that is not modelled still lies between its neighbours.
    bones = [(child, parent) for child, parent in enumerate(skeleton.parents) if parent >= 0]
    ends = np.array(bones, dtype=int).reshape(-1, 2).T
    size = (skeleton.n_joints, skeleton.n_joints)
    graph = coo_array((np.ones(len(bones)), tuple(ends)), shape=size).tocsr()
    apart = shortest_path(graph, directed=False, unweighted=True)
    joints = representation.indices
    feet = [skeleton.index(point.joint) for point in representation.foot_points]
    places = [*joints, *feet, representation.root]
    near = apart[np.ix_(places, places)] <= distance
    contacts = slice(len(joints), len(joints) + len(feet))
    if contact_reach == "foot":
        near[:, contacts] = np.equal.outer(places, feet)
    near[-1, contacts] = near[contacts, -1] = True
    return near


def modulated_blocks(representation: MultiresRepresentation, config: NetworkConfig) -> np.ndarray:
    """Return (blocks,) bool, True for blocks that the condition modulates.

    Contacts and the root's displacement are modulated only with `modulate: all`. If the upper body
    of a rig cannot be identified, `upper` modulates every block too.
    """
    skeleton, n_blocks = representation.skeleton, len(representation.block_sizes)
    if config.modulate == "all" or (config.modulate == "upper" and unidentified(skeleton)):
        return np.ones(n_blocks, dtype=bool)
    if config.modulate == "upper":
        names = set(upper_body(skeleton))
    else:
        names = {skeleton.names[skeleton.index(name)] for name in config.modulate}
    joints = [name in names for name in representation.joints]
    return np.array(joints + [False] * (n_blocks - len(joints)))


class SkeletonConv1d(nn.Module):
    """Convolution over time in which each output block depends only on the input blocks near it.

    Only weights between neighbours are parameters. About 80 % of the dense kernel is always zero,
    and takes no memory in the optimiser or the model file.

    Args:
        neighbours: (output blocks, input blocks) bool, see `block_neighbours`.
        sizes_in: channels of each input block.
        sizes_out: channels of each output block.
        kernel: odd number of frames; the ends are padded by reflection.

    Attributes:
        weight: (N,) weights between neighbours, in the order of the dense kernel.
        bias: (channels out,).
    """

    positions: Tensor

    def __init__(
        self, neighbours: np.ndarray, sizes_in: Sequence[int], sizes_out: Sequence[int], kernel: int
    ) -> None:
        super().__init__()
        self.padding = kernel // 2
        self.neighbours = neighbours
        self.sizes = (tuple(sizes_in), tuple(sizes_out))
        self.shape = (sum(sizes_out), sum(sizes_in), kernel)
        mask = np.repeat(np.repeat(neighbours, sizes_out, axis=0), sizes_in, axis=1)
        positions = np.flatnonzero(np.repeat(mask[..., None], kernel, axis=2))
        self.register_buffer("positions", torch.from_numpy(positions), persistent=False)
        # Each output channel starts as a layer of its own fan-in would (Kaiming, a = sqrt 5).
        bound = 1 / np.sqrt(kernel * mask.sum(axis=1))
        per_weight = np.broadcast_to(bound[:, None, None], self.shape).reshape(-1)[positions]
        self.weight = nn.Parameter(torch.empty(len(positions)).uniform_(-1, 1))
        self.bias = nn.Parameter(torch.empty(self.shape[0]).uniform_(-1, 1))
        with torch.no_grad():
            self.weight.mul_(torch.from_numpy(per_weight.astype(np.float32)))
            self.bias.mul_(torch.from_numpy(bound.astype(np.float32)))

    def dense_weight(self) -> Tensor:
        """Return the dense kernel (channels out, channels in, kernel)."""
        dense = self.weight.new_zeros(math.prod(self.shape))
        return dense.scatter_(0, self.positions, self.weight).view(self.shape)

    def forward(self, x: Tensor) -> Tensor:
        """Return (B, channels out, T) of x (B, channels in, T)."""
        return F.conv1d(reflect(x, self.padding), self.dense_weight(), self.bias)


def module_list(modules: Iterable[Modules]) -> Sequence[Modules]:
    """Return torch's list of these modules, with their type, which torch's own lacks."""
    typed: Any = nn.ModuleList(modules)
    return typed


def skeleton_layers(
    representation: MultiresRepresentation,
    config: NetworkConfig,
    *,
    output: bool,
    n_concatenated: int,
) -> Sequence[SkeletonConv1d]:
    """Return the skeleton convolutions of one level, from motion vectors to hidden features.

    Args:
        representation: of the motion vectors.
        config: widths, kernel and neighbours.
        output: add a last layer, back to motion vectors.
        n_concatenated: further channels of the input, which the modulated blocks see.
    """
    shapes = _shapes(representation, config, output, n_concatenated)
    return module_list(SkeletonConv1d(*shape, config.kernel) for shape in shapes)


def n_weights(
    representation: MultiresRepresentation, config: NetworkConfig, n_condition: int
) -> int:
    """Return the number of weights of all generators' skeleton convolutions, without making any."""
    n_concatenated = config.embedding if n_condition and config.film == "concatenate" else 0
    shapes = _shapes(representation, config, True, n_concatenated)
    connected = sum(np.array(b) @ near @ np.array(a) for near, a, b in shapes)
    return config.levels * config.kernel * int(connected)


def _shapes(
    representation: MultiresRepresentation, config: NetworkConfig, output: bool, n_concatenated: int
) -> list[tuple[np.ndarray, tuple[int, ...], tuple[int, ...]]]:
    """Return each layer's neighbours, and the channels of its input and of its output blocks.

    Raises:
        ConfigError: the dense kernel of a layer would take too much memory.
    """
    near = block_neighbours(representation, config.neighbour_distance, config.contact_reach)
    motion = representation.block_sizes
    parts = len(near) if config.channels_per == "layer" else 1
    widths = [math.ceil(channels / parts) for channels in config.channels]
    sizes = [motion, *((width,) * len(near) for width in widths), *[motion] * output]
    shapes = [(near, a, b) for a, b in itertools.pairwise(sizes)]
    if n_concatenated:
        seen = modulated_blocks(representation, config)
        first = np.column_stack([near, seen]), (*motion, n_concatenated), sizes[1]
        shapes[0] = first
    if max(sum(a) * sum(b) for _, a, b in shapes) * config.kernel > _MOST_WEIGHTS:
        raise ConfigError(
            f"channels: {list(config.channels)} and kernel {config.kernel} on {len(near)} blocks: "
            f"a dense layer would have over {_MOST_WEIGHTS} weights"
        )
    return shapes


def convolve_dense(
    layers: Sequence[SkeletonConv1d], x: Tensor, slope: float, last_slope: float
) -> Tensor:
    """Apply layers one after another with leaky rectifiers between them, in plain torch.

    Args:
        layers: each takes the output of the previous one.
        x: (B, channels in, T).
        slope: negative slope of the rectifiers between layers.
        last_slope: that of the rectifier after the last layer; 1 for none.

    Returns:
        (B, channels out, T).
    """
    for i, layer in enumerate(layers):
        x = layer(x)
        negative = last_slope if i == len(layers) - 1 else slope
        x = x if negative == 1 else F.leaky_relu(x, negative)
    return x


Convolve = Callable[[Sequence[SkeletonConv1d], Tensor, float, float], Tensor]
"""An implementation of `convolve_dense`."""
