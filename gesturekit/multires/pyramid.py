"""Noise and conditions of the levels of a pyramid, and the sampling of the levels in tiles.

Noise is Gaussian, or shuffled patches of the training recordings' z*. A recording is reconstructed
from its z* alone. Fresh noise need not cover all that the network can reconstruct, and short
patches of z* do: each stands for a piece of a recording, in a new context.

Conditions are speech features, one-hot styles and a state of movement. `condition_levels` prepares
whole windows in a batch, for training and the monitor, and `LevelConditions` one tile of a long
motion at a time. The residual features of both are equal bit for bit. Plain resampled ones differ
in the last bit (torch and numpy interpolation).

Sampling is tiled, so that memory is bounded and there are no seams. A frame of a level depends on
the frames within reach of the convolutions only. So each level is generated tile by tile, each with
that many more frames at both sides (its halo), which are cut off. A short motion is one tile.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

import audio_features as af
from gesturekit.corpus.speech import SpeechConditioner, style_track
from gesturekit.errors import ModelError
from gesturekit.multires.backend import choose_backend
from gesturekit.multires.controls import MultiresControls
from gesturekit.multires.networks import LevelGenerator, MultiresGenerator
from gesturekit.multires.resampling import resample
from gesturekit.state.channels import CARRIERS, StateChannels, averaged

if TYPE_CHECKING:
    from gesturekit.multires.model import MultiresModel

_LEVELS = re.compile(r"(\d+)(?:-(\d+))?")
_EXAMPLES = {"level style": "1-4=describe,5-8=angry", "level speech": "7-10=b.wav"}


class ZStarPatches:
    """Patches of z*, each drawn once in random order before any is drawn again.

    Args:
        z_stars: z* of each recording, (T_1,), or (D, T_1) with a value for each channel.
        styles: number of the style of each recording. Other styles get patches of all recordings.
        longest: frames of a patch at most. The cuts are random and differ in every round.
    """

    def __init__(self, z_stars: Sequence[Tensor], styles: Sequence[int], longest: int) -> None:
        self.all, self.longest = (
            [z_star.reshape(-1, z_star.shape[-1]) for z_star in z_stars],
            longest,
        )
        self.by_style: dict[int, list[Tensor]] = {}
        for z_star, style in zip(self.all, styles, strict=True):
            self.by_style.setdefault(style, []).append(z_star)

    def draw(self, styles: Sequence[int], rng: torch.Generator) -> Tensor:
        """Return (1, 1 or D, T_1) noise; each patch has the style of its first frame.

        Args:
            styles: (T_1,) number of the style of each frame.
            rng: source of the cuts and of the order.
        """
        rounds: dict[int, Iterator[Tensor]] = {}
        pieces, done = list[Tensor](), 0
        while done < len(styles):
            style = styles[done]
            if style not in rounds:
                rounds[style] = self._rounds(self.by_style.get(style, self.all), rng)
            pieces.append(next(rounds[style]))
            done += pieces[-1].shape[-1]
        return torch.cat(pieces, dim=-1)[None, :, : len(styles)]

    def _rounds(self, z_stars: Sequence[Tensor], rng: torch.Generator) -> Iterator[Tensor]:
        """Yield patches (1 or D, T) without end; each round cuts all of (1 or D, T_1) anew."""
        while True:
            patches = []
            for z_star in z_stars:
                first = 1 + int(torch.randint(self.longest, (), generator=rng))
                edges = [0, *range(first, z_star.shape[-1], self.longest), z_star.shape[-1]]
                patches += [z_star[:, a:b] for a, b in pairwise(edges)]
            for i in torch.randperm(len(patches), generator=rng).tolist():
                yield patches[i]


@dataclass(frozen=True, eq=False)
class RandomNoise:
    """Noise of random motions, in training and in generation.

    Attributes:
        sigma: (L,) standard deviation of the noise of each level.
        levels: number of the coarsest levels that get noise.
        patches: z* patches for the first level, or None for Gaussian noise there too.
    """

    sigma: Tensor
    levels: int
    patches: ZStarPatches | None

    def gaussian(
        self,
        lengths: Sequence[int],
        rng_of: Callable[[int], torch.Generator],
        *,
        first: int = 0,
        count: int = 1,
    ) -> list[Tensor | None]:
        """Draw Gaussian noise (B, 1, T_i) for each level, or None for levels without noise.

        Args:
            lengths: T_i, frames of each of these levels.
            rng_of: random generator of a level, by its index.
            first: index of the first of these levels.
            count: B.
        """
        return [
            torch.randn(count, 1, n, generator=rng_of(i)) * self.sigma[i]
            if i < self.levels
            else None
            for i, n in enumerate(lengths, first)
        ]

    def shuffled(
        self, gaussian: Tensor | None, styles: Sequence[Sequence[int]], rng: torch.Generator
    ) -> Tensor:
        """Return the noise (B, 1 or D, T_1) of the first level: z* patches if there are any.

        Args:
            gaussian: (B, 1, T_1), returned as it is where noise is not made of patches.
            styles: (B, T_1) number of the style of each frame.
            rng: random generator of the patches.
        """
        if self.patches is None:
            assert gaussian is not None
            return gaussian
        return torch.cat([self.patches.draw(row, rng) for row in styles])

    def clocked(
        self, state: np.ndarray, n_carriers: int, lengths: Sequence[int]
    ) -> list[Tensor | None]:
        """Return noise in the time of the hands' movement for states (B, C, T).

        That of level 1 is the mean of the hands' first carriers, the last `n_carriers` channels;
        white noise would move the body where the state says that it rests. Finer levels get none.
        """
        mixed = mixed_carriers(torch.from_numpy(state[:, state.shape[1] - n_carriers :]))
        first = self.sigma[0] * resample(mixed, lengths[0])
        return [first, *[None] * (len(lengths) - 1)]


def mixed_carriers(carriers: Tensor) -> Tensor:
    """Return the mean (B, 1, T) of the hands' first carriers, (B, 4 H, T), of variance 1."""
    first = carriers[:, ::CARRIERS]
    return first.sum(dim=1, keepdim=True) / first.shape[1] ** 0.5


@dataclass(frozen=True)
class TrainedSequence:
    """Data of a training sequence that its reconstruction needs.

    Attributes:
        frames: its length at the full rate.
        style: its style, or None.
    """

    frames: int
    style: str | None


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainedNoise:
    """Noise of a trained model: scales, z*, and settings for drawing random noise.

    Attributes:
        sigma: (N, L) noise scale of each training sequence and level.
        z_star: noise from which each training sequence is reconstructed, by the sequence's name.
        sequences: length and style of each training sequence, by its name.
        z_star_shuffle: longest patch, in frames, when noise is made of z* patches; 0 for Gaussian
            noise.
        noise_levels: number of the coarsest levels that get noise.
    """

    sigma: Tensor
    z_star: Mapping[str, Tensor]
    sequences: Mapping[str, TrainedSequence]
    z_star_shuffle: int
    noise_levels: int

    def random(self, styles: tuple[str, ...]) -> RandomNoise:
        """Return the noise of random motions of a model with these styles."""
        patches = None
        if self.z_star_shuffle:
            names = sorted(self.z_star)
            owners = [styles.index(self.sequences[name].style) if styles else 0 for name in names]
            z_stars = [self.z_star[name] for name in names]
            patches = ZStarPatches(z_stars, owners, self.z_star_shuffle)
        return RandomNoise(self.sigma.mean(dim=0), self.noise_levels, patches)


@dataclass(frozen=True, eq=False)
class Conditions:
    """Inputs of a trained model beside noise.

    Attributes:
        conditioner: turns waves into speech features; None for a model without speech input.
        styles: names of the K styles; empty for a model without styles.
        residual: give finer levels only the detail that coarser ones lack (section 5).
        state: channels of the state of movement; None for a model without it.
    """

    conditioner: SpeechConditioner | None = None
    styles: tuple[str, ...] = ()
    residual: bool = False
    state: StateChannels | None = None

    @property
    def width(self) -> int:
        """S + K + C, the channels of a condition: speech, styles, state, in this order.

        The state stands last, its carriers at its end: training and streaming count from there.
        """
        n_state = 0 if self.state is None else self.state.width
        return len(self.styles) + len(self.columns) + n_state

    @property
    def n_carriers(self) -> int:
        """Number of the carriers of the state of movement, the last channels of a condition."""
        return 0 if self.state is None else self.state.n_carriers

    @property
    def columns(self) -> list[int]:
        """Columns of the speech features that the network gets.

        Those of vocal effort only predict what is drawn.
        """
        if self.conditioner is None:
            return []
        hidden = self.conditioner.effort if self.state else ()
        return [i for i in range(self.conditioner.dim) if i not in hidden]

    def of_motion(
        self,
        speech: np.ndarray,
        lengths: Sequence[int],
        styles: Sequence[Tensor],
        level_speech: Sequence[tuple[range, np.ndarray]] = (),
        state: np.ndarray | None = None,
    ) -> LevelConditions | None:
        """Return the `LevelConditions` of one motion, or None for a model without conditions."""
        if not speech.shape[1] and not styles and state is None:
            return None
        speeches = [speech[:, self.columns]] * len(lengths)
        for levels, other in level_speech:
            speeches[levels.start : levels.stop] = [other[:, self.columns]] * len(levels)
        return LevelConditions(speeches, lengths, self.residual, styles, state, self.n_carriers)

    def of_batch(
        self, speech: Tensor, lengths: Sequence[int], styles: Tensor, state: np.ndarray | None
    ) -> list[Tensor]:
        """Return the condition (B, S + K + C, T_i) of each level of a batch of windows.

        Args:
            speech: (B, S, T) features at the finest level.
            lengths: T_i, frames of each level.
            styles: (B, L) number of the style of each level; not used without styles.
            state: (B, C, T) of a model with a state of movement.
        """
        one_hot = style_levels(styles, len(self.styles), lengths) if self.styles else []
        states = []
        if state is not None:
            levels = (state_level(state, self.n_carriers, n) for n in lengths)
            states = [torch.from_numpy(level) for level in levels]
        return condition_levels(speech[:, self.columns], lengths, self.residual, one_hot, states)


def level_range(text: str, n_levels: int, name: str) -> range:
    """Return the indices of levels such as 1-4, which count from 1, or a single one.

    Raises:
        ModelError: not such a text, or levels that the model does not have; it says `name`.
    """
    match = _LEVELS.fullmatch(text.strip())
    if match is None:
        raise ModelError(f"{name} {text!r}: it looks like {_EXAMPLES[name]}")
    first, last = int(match[1]), int(match[2] or match[1])
    if not 1 <= first <= last <= n_levels:
        raise ModelError(f"{name} {text!r}: the model has levels 1 (coarse) to {n_levels}")
    return range(first - 1, last)


def condition_levels(
    speech: Tensor,
    lengths: Sequence[int],
    residual: bool,
    styles: Sequence[Tensor] = (),
    states: Sequence[Tensor] = (),
) -> list[Tensor]:
    """Return the condition (B, S + K + C, T_i) of each level from `speech` (B, S, T) at the finest.

    S is 0 without speech input; `styles` are (B, K, T_i) for each level, or empty, and so are
    `states`, (B, C, T_i). With `residual`, finer levels get only the detail that coarser ones lack.
    """
    batch, width, n_frames = speech.shape
    if residual and width:
        flat = speech.permute(2, 0, 1).reshape(n_frames, batch * width).numpy()
        features = [
            torch.from_numpy(level).float().reshape(-1, batch, width).permute(1, 2, 0)
            for level in af.residual_pyramid(flat, lengths)
        ]
    else:
        features = [resample(speech, n) for n in lengths]
    given = [features, *(list(inputs) for inputs in (styles, states) if inputs)]
    return [torch.cat(inputs, dim=1) for inputs in zip(*given, strict=True)]


def state_level(
    state: np.ndarray, n_carriers: int, n_frames: int, start: int = 0, stop: int | None = None
) -> np.ndarray:
    """Return frames `start` to `stop` of a state (..., C, T) at a level of `n_frames`.

    Channels are averaged over the duration of each frame, as fast ones would be aliased; the last
    ones, the carriers, are interpolated, as motion is. The state is no residual: a slow channel has
    none above level 1.
    """
    rows = averaged(state[..., : state.shape[-2] - n_carriers, :], n_frames, start, stop)
    carriers = np.moveaxis(state[..., state.shape[-2] - n_carriers :, :], -1, 0)
    carriers = af.resample_frames(carriers, n_frames, start, stop)
    return np.concatenate([rows, np.moveaxis(carriers, 0, -1)], axis=-2)


@dataclass(frozen=True, eq=False)
class LevelConditions:
    """Conditions of any frames of any level, without a pyramid of the whole speech in memory.

    Attributes:
        speeches: of each level, (T, S) float32 features at the finest level; S is 0 without speech
            input.
        lengths: T_i, frames of each level.
        residual: give finer levels only the detail that coarser ones lack.
        styles: (1, K, T_i) for each level, or empty.
        state: (C, T) at the finest level, see `StateProcess.condition`; None without.
        n_carriers: the number of its carriers.
    """

    speeches: Sequence[np.ndarray]
    lengths: Sequence[int]
    residual: bool
    styles: Sequence[Tensor] = ()
    state: np.ndarray | None = None
    n_carriers: int = 0

    def __call__(self, level: int, start: int, stop: int) -> Tensor:
        """Return (1, S + K + C, stop - start): these frames of the condition of a level."""
        parts, speech = [], self.speeches[level]
        if speech.shape[1]:
            if self.residual:
                features = af.residual_level(speech, self.lengths, level, start, stop)
            else:
                features = af.resample_frames(speech, self.lengths[level], start, stop)
            parts.append(torch.from_numpy(np.ascontiguousarray(features.T))[None])
        if self.styles:
            parts.append(self.styles[level][..., start:stop])
        if self.state is not None:
            n_frames = self.lengths[level]
            rows = state_level(self.state, self.n_carriers, n_frames, start, stop)
            parts.append(torch.from_numpy(np.ascontiguousarray(rows))[None])
        return torch.cat(parts, dim=1)


def style_levels(styles: Tensor, n_styles: int, lengths: Sequence[int]) -> list[Tensor]:
    """Return one-hot styles (B, K, T_i) of each level, constant over time.

    Args:
        styles: (B, L) number of the style of each level.
        n_styles: K.
        lengths: T_i, frames of each level.
    """
    codes = F.one_hot(styles, n_styles).float()
    return [codes[:, i, :, None].expand(-1, -1, n) for i, n in enumerate(lengths)]


def agreed_style(styles: Tensor, n_styles: int, level: int) -> Tensor:
    """Return the one-hot style (B, K) that all levels up to this one share, else zeros.

    Args:
        styles: (B, L) numbers of styles.
        n_styles: K.
        level: index of the level.
    """
    first = styles[:, :1]
    agreed = (styles[:, : level + 1] == first).all(dim=1)
    return F.one_hot(first[:, 0], n_styles).float() * agreed[:, None]


def mixed_styles(
    coarse_shares: Tensor,
    fine_shares: Tensor,
    count: int,
    levels: int,
    mixing: float,
    rng: torch.Generator,
) -> Tensor:
    """Draw style numbers (count, L) for random-generation steps (section 4.2 of the paper).

    A share `mixing` of the motions has one style up to a random level and another one above it.

    Args:
        coarse_shares: (K,) relative frequency of each style at the coarse levels.
        fine_shares: (K,) the same for the levels above.
        count: number of motions.
        levels: L.
        mixing: share of motions with two styles.
        rng: random generator.
    """
    coarse, fine = (
        torch.multinomial(shares, count, replacement=True, generator=rng)
        for shares in (coarse_shares, fine_shares)
    )
    crossover = torch.randint(1, max(levels, 2), (count,), generator=rng)
    unmixed = torch.rand(count, generator=rng) >= mixing
    crossover[unmixed] = levels
    return torch.where(torch.arange(levels) < crossover[:, None], coarse[:, None], fine[:, None])


def requested_styles(
    names: Sequence[str],
    controls: MultiresControls,
    lengths: Sequence[int],
    *,
    fps: float,
    rng: torch.Generator,
    margin: int = 0,
) -> list[Tensor]:
    """Return one-hot or blended styles (1, K, T_i) for each level of a motion.

    Args:
        names: the K styles of the model.
        controls: their `style` (see `style_track`; None draws one) and `level_style`.
        lengths: T_i, frames of each level.
        fps: frames per second of the finest level.
        rng: random generator of a style that is not given.
        margin: frames of the finest level before and after the motion, with the styles of its
            first and last frame.

    Raises:
        ModelError: an unknown style or level, or text that cannot be parsed.
    """
    style, level_style = controls["style"], controls["level_style"]
    if style is None:
        style = names[int(torch.randint(len(names), (), generator=rng))]

    def with_margins(style: str) -> Tensor:
        track = style_track(names, style, lengths[-1] - 2 * margin, fps).T.copy()
        return F.pad(torch.from_numpy(track)[None], (margin, margin), mode="replicate")[0]

    tracks = [with_margins(style)] * len(lengths)
    for text in level_style.split(",") if level_style else ():
        numbers, _, name = text.strip().partition("=")
        if not name:
            example = _EXAMPLES["level style"]
            raise ModelError(f"level style {numbers!r} names no style: {example} does")
        levels = level_range(numbers, len(lengths), "level style")
        tracks[levels.start : levels.stop] = [with_margins(name)] * len(levels)
    return [resample(track, n)[None] for track, n in zip(tracks, lengths, strict=True)]


TILE = 2048
"""Frames of a tile, which need about 50 MB; the halo of 16 frames is a small part of it."""

Constraint = Callable[[int, Tensor], Tensor]
"""constraint(level, output): the normalised output of a level, (1, D, T_i), with the constraint
applied before the next level adds detail: inpainting in a coarse-to-fine pyramid."""
Condition = Callable[[int, int, int], Tensor]
"""condition(level, start, stop): (B, S, stop - start), the condition of these frames of a level."""


@dataclass(frozen=True, eq=False)
class Pyramid:
    """The levels of a trained network, for one motion from random noise.

    Attributes:
        model: the trained model.
        lengths: T_i, frames of each level.
        condition: conditions of each level; None for a model without any. A state of movement
            among them is what its noise is made of.
        rng_of: random generator of a level, by its index; a new one at each call.
    """

    model: MultiresModel
    lengths: Sequence[int]
    condition: LevelConditions | None
    rng_of: Callable[[int], torch.Generator]

    def random(
        self,
        *,
        levels: int | None = None,
        coarser: np.ndarray | None = None,
        first: int = 0,
        constraint: Constraint | None = None,
    ) -> np.ndarray:
        """Return the output (T, D) of the first `levels` levels, all by default.

        Args:
            levels: their number.
            coarser: (T_i, D) output of the level before `first`, in its own units, with which to
                begin; returned if there are no finer levels.
            first: index of the first level that is generated.
            constraint: applied to the output of each level.

        Raises:
            ModelError: the output is not finite.
        """
        lengths, given = self.lengths[first:levels], self.condition
        noise = self.model.noise.random(self.model.styles)
        if given is not None and given.state is not None:
            noises = noise.clocked(given.state[None], given.n_carriers, self.lengths)[first:levels]
        else:
            noises = noise.gaussian(lengths, self.rng_of, first=first)
            if not first:
                styles = [0] * lengths[0]
                if given is not None and given.styles:
                    styles = given.styles[0][0].argmax(dim=0).tolist()
                noises[0] = noise.shuffled(noises[0], [styles], self.rng_of(0))
        below = None if coarser is None else self.model.normaliser.from_values(coarser)
        about = {"first": first, "coarser": below, "constraint": constraint}
        return generated(self.model, noises, lengths, given, **about)


def generated(
    model: MultiresModel,
    noises: Sequence[Tensor | None],
    lengths: Sequence[int],
    condition: LevelConditions | None,
    **further: Any,
) -> np.ndarray:
    """Return the finest of these levels of a model, (T, D) in their own units.

    `further` are arguments of `sample`.

    Raises:
        ModelError: the output is not finite.
    """
    vectors = sample(model.network, noises, lengths, condition, **further)
    return finite(model.normaliser.to_values(vectors))


def finite(values: np.ndarray) -> np.ndarray:
    """Return the output of a network; raise ModelError if it is not finite."""
    if not np.isfinite(values).all():
        raise ModelError("the model gave NaN; its weights are damaged or its training diverged")
    return values


@torch.no_grad()
def sample(
    network: MultiresGenerator,
    noises: Sequence[Tensor | None],
    lengths: Sequence[int],
    condition: Condition | None,
    *,
    first: int = 0,
    coarser: Tensor | None = None,
    constraint: Constraint | None = None,
    tile: int = TILE,
) -> Tensor:
    """Return the finest level of `network(noises, conditions, ...)`, in bounded memory.

    Args:
        network: the pyramid, in evaluation mode.
        noises: (B, 1, T_i) for each level; None means no noise, which the coarsest level needs.
        lengths: T_i, frames of each of these levels.
        condition: called for each tile of each level; None for a model without conditions.
        first: index of the first of these levels.
        coarser: (B, D, T) output of the level before `first`; None at the coarsest level. It is
            returned if there are no finer levels.
        constraint: applied to the output of each level before the next one.
        tile: frames generated at a time.

    Returns:
        (B, D, T); `tile` changes it by the rounding of sums only.
    """
    if coarser is None:
        assert noises[0] is not None
        n_columns = network.levels[0].layers[-1].shape[0]
        coarser = noises[0].new_zeros(len(noises[0]), n_columns, lengths[0])
    levels = network.levels[first : first + len(lengths)]
    backend = choose_backend("auto", *levels)
    with backend.threads():
        for i, (level, noise, n_frames) in enumerate(
            zip(levels, noises, lengths, strict=True), first
        ):
            output = coarser.new_empty(*coarser.shape[:2], n_frames)
            reach, n_tiles = halo(level), -(-n_frames // tile)
            for start, stop in pairwise(n_frames * k // n_tiles for k in range(n_tiles + 1)):
                begin, end = max(0, start - reach), min(n_frames, stop + reach)
                up = resample(coarser, n_frames, begin, end)
                tile_noise = up.new_zeros(len(up), 1, 1) if noise is None else noise[..., begin:end]
                given = None if condition is None else condition(i, begin, end)
                made = level(up, tile_noise, given, backend.convolve)
                output[..., start:stop] = made[..., start - begin : stop - begin]
            coarser = output if constraint is None else constraint(i, output)
    return coarser


def halo(level: LevelGenerator) -> int:
    """Return the number of frames that a level sees to each side, at its own rate."""
    return sum(layer.padding for layer in level.layers)
