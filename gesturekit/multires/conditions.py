"""Conditions of each level: speech features and one-hot styles.

`condition_levels` prepares whole windows in a batch, for training and the monitor, and
`LevelConditions` one tile of a long motion at a time. The residual features of both are equal bit
for bit. Plain resampled ones differ in the last bit (torch and numpy interpolation).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

import audio_features as af
from gesturekit.corpus.speech import SpeechConditioner, style_track
from gesturekit.errors import ModelError
from gesturekit.multires.controls import MultiresControls
from gesturekit.multires.resampling import resample
from gesturekit.state.channels import StateChannels, averaged

_LEVELS = re.compile(r"(\d+)(?:-(\d+))?")
_LEVEL_STYLE = "1-4=describe,5-8=angry"


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


def level_range(text: str, n_levels: int, name: str, example: str) -> range:
    """Return the indices of levels such as 1-4, which count from 1, or a single one.

    Raises:
        ModelError: not such a text, or levels that the model does not have; it says `name`.
    """
    match = _LEVELS.fullmatch(text.strip())
    if match is None:
        raise ModelError(f"{name} {text!r}: it looks like {example}")
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
            raise ModelError(f"level style {numbers!r} names no style: {_LEVEL_STYLE} does")
        levels = level_range(numbers, len(lengths), "level style", _LEVEL_STYLE)
        tracks[levels.start : levels.stop] = [with_margins(name)] * len(levels)
    return [resample(track, n)[None] for track, n in zip(tracks, lengths, strict=True)]
