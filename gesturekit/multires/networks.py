"""Networks of the pyramid in plain torch (Moreno-Villamarin et al. 2024, section 3).

`LevelGenerator` is G_i with FiLM (eqs. 6 to 10), `LevelDiscriminator` is D_i, and `TorchBackend`
defines the operations that the CPU engine computes faster.

A skeleton-aware convolution connects each joint to the joints near it in the skeleton's tree
(Aberman et al. 2020, in the form of Li et al. 2022, GANimator). The channels of a frame are split
into blocks: one for each modelled joint and each foot contact, and one for the root's displacement.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from scipy.sparse import coo_array
from scipy.sparse.csgraph import shortest_path
from torch import Tensor, nn

from gesturekit.errors import ConfigError
from gesturekit.motion.parts import unidentified, upper_body
from gesturekit.multires import losses
from gesturekit.multires.config import LossConfig, NetworkConfig
from gesturekit.multires.motion_vector import MultiresRepresentation
from gesturekit.multires.resampling import reflect, resample

T = TypeVar("T")
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


def n_weights(
    representation: MultiresRepresentation, config: NetworkConfig, n_condition: int
) -> int:
    """Return the number of weights of all generators' skeleton convolutions, without making any."""
    n_concatenated = config.embedding if n_condition and config.film == "concatenate" else 0
    shapes = layer_shapes(representation, config, n_concatenated=n_concatenated)
    connected = sum(np.array(b) @ near @ np.array(a) for near, a, b in shapes)
    return config.levels * config.kernel * int(connected)


def layer_shapes(
    representation: MultiresRepresentation,
    config: NetworkConfig,
    *,
    output: bool = True,
    n_concatenated: int = 0,
) -> list[tuple[np.ndarray, tuple[int, ...], tuple[int, ...]]]:
    """Return neighbours, and channels of input and output blocks, of each layer of one level.

    Layers lead from motion vectors to hidden features.

    Args:
        representation: of the motion vectors.
        config: widths and neighbours.
        output: add a last layer, back to motion vectors.
        n_concatenated: further channels of the input, which the modulated blocks see.

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


class Film(nn.Module):
    """Modulation of chosen channels, gamma * x + delta (eqs. 8 to 10).

    gamma = 1 + f(y) and delta = h(y), both per frame. f and h are initialised to zero, so that an
    untrained modulation is the identity. Other channels are not changed.

    Args:
        embedding: channels of y.
        channels: (C,) bool, True for modulated channels.
    """

    index: Tensor

    def __init__(self, embedding: int, channels: np.ndarray) -> None:
        super().__init__()
        index = torch.zeros(len(channels), dtype=torch.long)
        index[torch.from_numpy(channels)] = torch.arange(1, int(channels.sum()) + 1)
        # Channel 0 of the padded gain and shift is zero; every channel not modulated points at it.
        self.register_buffer("index", index, persistent=False)
        self.gain = nn.Conv1d(embedding, int(channels.sum()), 1)
        self.shift = nn.Conv1d(embedding, int(channels.sum()), 1)
        for parameter in (*self.gain.parameters(), *self.shift.parameters()):
            nn.init.zeros_(parameter)

    def forward(self, x: Tensor, y: Tensor) -> Tensor:
        """Return x (B, C, T) modulated by y (B, embedding, T)."""
        gamma = F.pad(self.gain(y), (0, 0, 1, 0)).index_select(1, self.index)
        delta = F.pad(self.shift(y), (0, 0, 1, 0)).index_select(1, self.index)
        return x + x * gamma + delta


class LevelGenerator(nn.Module):
    """Generator of one level: adds detail to the coarser motion, eqs. 6, 7 and 10.

    G_i(x, z, s) = g_i(FiLM(up(x) + z, y)) + up(x), with y = S_i(s) the embedding of the condition
    and g_i a chain of skeleton convolutions. With `film: all` each of them is modulated; with
    `film: concatenate` none is, and y is a part of the input: g_i(up(x) + z, y) + up(x).
    """

    def __init__(
        self, representation: MultiresRepresentation, n_condition: int, config: NetworkConfig
    ) -> None:
        super().__init__()
        self.concatenates = bool(n_condition) and config.film == "concatenate"
        n_concatenated = config.embedding if self.concatenates else 0
        shapes = layer_shapes(representation, config, n_concatenated=n_concatenated)
        self.layers = module_list(SkeletonConv1d(*shape, config.kernel) for shape in shapes)
        self.rectify_embedding, self.residual = config.rectify_embedding, config.residual
        self.embed, self.films = None, module_list(list[Film]())
        if n_condition:
            self.embed = nn.Conv1d(n_condition, config.embedding, 1)
            blocks = modulated_blocks(representation, config)
            modulated = self.layers[: {"input": 1, "concatenate": 0}.get(config.film)]
            self.films = module_list(
                Film(config.embedding, np.repeat(blocks, layer.sizes[0])) for layer in modulated
            )

    def forward(
        self,
        up: Tensor,
        noise: Tensor,
        condition: Tensor | None,
        convolve: Convolve = convolve_dense,
    ) -> Tensor:
        """Return the motion of this level, (B, D, T).

        Args:
            up: (B, D, T) the coarser level's motion, upsampled; zeros at the first level.
            noise: (B, 1, T), shared by all channels.
            condition: (B, S, T) speech features and style of this level; not used by a level
                without conditions.
            convolve: implementation of the convolutions.
        """
        x, y = up + noise, None
        if self.embed is not None and condition is not None:
            y = self.embed(condition)
            y = F.leaky_relu(y, SLOPE) if self.rectify_embedding else y
            x = torch.cat([x, y], dim=1) if self.concatenates else x
        # Layers between one modulation and the next.
        chains = [[layer] for layer in self.layers] if len(self.films) > 1 else [self.layers]
        for i, chain in enumerate(chains):
            x = x if y is None or self.concatenates else self.films[i](x, y)
            x = convolve(chain, x, SLOPE, 1.0 if i == len(chains) - 1 else SLOPE)
        return x + up if self.residual else x


class MultiresGenerator(nn.Module):
    """Generators G_1 ... G_L, coarse to fine. Their motion is normalised."""

    def __init__(
        self, representation: MultiresRepresentation, n_condition: int, config: NetworkConfig
    ) -> None:
        super().__init__()
        self.levels = module_list(
            LevelGenerator(representation, n_condition, config) for _ in range(config.levels)
        )

    def forward(
        self,
        noises: Sequence[Tensor | None],
        conditions: Sequence[Tensor] | None,
        *,
        first: int = 0,
        coarser: Tensor | None = None,
        recorded: Sequence[Tensor] = (),
        lengths: Sequence[int],
        convolve: Convolve = convolve_dense,
    ) -> list[Tensor]:
        """Return the motion of levels `first` to `first + len(noises) - 1`, (B, D, T_i) each.

        Gradients do not flow from a level into the coarser one.

        Args:
            noises: (B, 1, T_i) for each level; None stands for zeros.
            conditions: (B, S, T_i) for each of these levels, or None.
            first: index of the first of these levels.
            coarser: (B, D, T) motion of level `first - 1`; None if `first` is 0.
            recorded: (B, D, T_i) motion of each of these levels that the next one upsamples in
                place of the generated one (eq. 15 as printed); empty for the generated ones.
            lengths: frames of each of these levels.
            convolve: implementation of the convolutions.
        """
        made: list[Tensor] = []
        for i, (noise, n_frames) in enumerate(zip(noises, lengths, strict=True)):
            level = self.levels[first + i]
            if coarser is None:
                assert noise is not None
                up = noise.new_zeros(len(noise), level.layers[-1].shape[0], n_frames)
            else:
                up = resample(coarser.detach(), n_frames)
            if noise is None:
                noise = up.new_zeros(len(up), 1, n_frames)
            made.append(level(up, noise, conditions[i] if conditions else None, convolve))
            coarser = recorded[i] if recorded else made[-1]
        return made


_CONVOLUTION = re.compile(r"layers\.\d+\.weight")


def load_generator(
    representation: MultiresRepresentation,
    n_condition: int,
    config: NetworkConfig,
    weights: Mapping[str, Tensor],
) -> MultiresGenerator:
    """Return generators with the weights of a model file.

    Raises:
        ValueError: another number of weights than the settings ask for; no layer is made then.
    """
    given = sum(t.numel() for name, t in weights.items() if _CONVOLUTION.search(name))
    if (needed := n_weights(representation, config, n_condition)) != given:
        raise ValueError(f"{needed} weights by config.yaml, {given} in model.safetensors")
    network = MultiresGenerator(representation, n_condition, config)
    network.load_state_dict(weights)
    return network


class LevelDiscriminator(nn.Module):
    """Patch discriminator D_i of one level; it has no speech input.

    With styles, each style adds a learnt projection of the last features to the score (projection
    discriminator, Miyato and Koyama 2018).
    """

    def __init__(
        self, representation: MultiresRepresentation, config: NetworkConfig, n_styles: int = 0
    ) -> None:
        super().__init__()
        shapes = layer_shapes(representation, config, output=False)
        self.layers = module_list(SkeletonConv1d(*shape, config.kernel) for shape in shapes)
        width = self.layers[-1].shape[0]
        self.score = nn.Conv1d(width, 1, config.kernel)
        if n_styles:
            self.styled = nn.Conv1d(width, n_styles, config.kernel, bias=False)

    def score_weights(self, n_frames: int, style: Tensor | None = None) -> Tensor:
        """Return the weight of each feature in the mean score, (1 or B, C, T).

        The mean over time of the last, reflect-padded convolution is linear in its input, so that
        it is a weighted sum and no convolution.

        Args:
            n_frames: T.
            style: (B, K) one-hot, or None.
        """
        kernels = self.score.weight
        if style is not None:
            kernels = kernels + torch.einsum("bk,kct->bct", style, self.styled.weight)
        return kernels @ tap_frequencies(n_frames, kernels.shape[-1]).to(kernels)

    def forward(
        self, x: Tensor, style: Tensor | None = None, convolve: Convolve = convolve_dense
    ) -> Tensor:
        """Return the mean score of all patches of each motion, (B,). There is one patch around each
        frame.

        Args:
            x: (B, D, T).
            style: (B, K) one-hot; zeros for a motion without a style.
            convolve: implementation of the convolutions.
        """
        assert self.score.bias is not None
        x = convolve(self.layers, x, SLOPE, SLOPE)
        # Scores are means over time with small differences: too fine for half precision.
        with torch.autocast(x.device.type, enabled=False):
            x = x.to(self.score.weight.dtype)
            return (x * self.score_weights(x.shape[-1], style)).sum(dim=(1, 2)) + self.score.bias


@lru_cache(maxsize=64)
def tap_frequencies(n_frames: int, kernel: int) -> Tensor:
    """Return how often each frame is multiplied by each kernel tap, divided by T: (kernel, T).

    It is the average over time of a reflect-padded convolution, without its weights.
    """
    windows = reflect(torch.eye(n_frames), kernel // 2).unfold(-1, kernel, 1)
    return windows.sum(dim=1).T.contiguous() / n_frames


@dataclass(frozen=True)
class TorchBackend:
    """Dense convolutions and autograd: the definition of what every backend computes.

    Attributes:
        reason: why this backend was chosen, for the log.
    """

    name: ClassVar[str] = "torch"

    reason: str

    def convolve(
        self, layers: Sequence[SkeletonConv1d], x: Tensor, slope: float, last_slope: float
    ) -> Tensor:
        """Return the output of a chain of convolutions; see `convolve_dense`."""
        return convolve_dense(layers, x, slope, last_slope)

    def discriminator_gradients(
        self,
        discriminators: Sequence[LevelDiscriminator],
        reals: Sequence[Tensor],
        fakes: Sequence[Tensor],
        mixes: Sequence[Tensor],
        config: LossConfig,
        styles: Sequence[Tensor | None],
    ) -> Tensor:
        """Set the parameters' `grad` to the gradients of the discriminator loss (eqs. 12 and 13).

        Args:
            discriminators: one per level; all following arguments have one entry per discriminator.
            reals: (B, D, T_i).
            fakes: (B, D, T_i).
            mixes: (B, 1, 1) uniform in [0, 1], interpolation weights of the gradient penalty.
            config: weights of the losses.
            styles: (B, K) one-hot, of each recording and of the fake with the same index; None for
                a discriminator without styles.

        Returns:
            (levels,) values of eq. 12, without weights.
        """
        gaps = []
        levels = zip(discriminators, reals, fakes, mixes, styles, strict=True)
        for discriminator, real, fake, mix, style in levels:
            score = partial(self._scores, discriminator, style)
            gap = losses.discriminator_gap(*score(torch.cat([fake, real])).split(len(real)))
            penalty = losses.gradient_penalty(score, real, fake, mix, config.penalty_on)
            loss = config.discriminator_scale * gap + config.gradient_penalty * penalty
            parameters = list(discriminator.parameters())
            gradients = torch.autograd.grad(loss, parameters)
            for parameter, gradient in zip(parameters, gradients, strict=True):
                parameter.grad = gradient
            gaps.append(gap.detach())
        return torch.stack(gaps)

    def _scores(
        self, discriminator: LevelDiscriminator, style: Tensor | None, motions: Tensor
    ) -> Tensor:
        """Return the scores of motions, which are as many as the styles (B, K) or twice as many."""
        if style is not None:
            style = torch.cat([style] * (len(motions) // len(style)))
        return discriminator(motions, style, self.convolve)

    def run_tasks(self, *tasks: Callable[[], T]) -> list[T]:
        """Run independent tasks and return their results."""
        return [task() for task in tasks]

    def threads(self) -> AbstractContextManager[None]:
        """Return a context that shares the CPU threads between torch and this backend."""
        return nullcontext()
