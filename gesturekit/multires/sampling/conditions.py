"""Conditions of each level: speech features and one-hot styles.

`condition_levels` prepares whole windows in a batch, for the window cache and the monitor, and
`LevelConditions` one tile of a long motion at a time. The residual features of both are equal bit
for bit. Plain resampled ones differ in the last bit (torch and numpy interpolation).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

import audio_features as af
from gesturekit.corpus.speech import SpeechConditioner
from gesturekit.errors import ModelError
from gesturekit.multires.network.resampling import resample

_LEVELS = re.compile(r"(\d+)(?:-(\d+))?")


@dataclass(frozen=True, eq=False)
class Conditions:
    """Inputs of a trained model beside noise.

    Attributes:
        conditioner: turns waves into speech features; None for a model without speech input.
        styles: names of the K styles; empty for a model without styles.
        residual: give finer levels only the detail that coarser ones lack (section 5).
        recalls: columns of vocal effort are for recall only, and not for the network.
    """

    conditioner: SpeechConditioner | None = None
    styles: tuple[str, ...] = ()
    residual: bool = False
    recalls: bool = False

    @property
    def width(self) -> int:
        """S + K, the channels of a condition."""
        return len(self.styles) + len(self.columns)

    @property
    def columns(self) -> list[int]:
        """Columns of the speech features that the network gets."""
        if self.conditioner is None:
            return []
        hidden = self.conditioner.effort if self.recalls else ()
        return [i for i in range(self.conditioner.dim) if i not in hidden]

    def of_motion(
        self,
        speech: np.ndarray,
        lengths: Sequence[int],
        styles: Sequence[Tensor],
        level_speech: Sequence[tuple[range, np.ndarray]] = (),
    ) -> LevelConditions | None:
        """Return the `LevelConditions` of one motion, or None for a model without conditions."""
        if not speech.shape[1] and not styles:
            return None
        speeches = [speech[:, self.columns]] * len(lengths)
        for levels, own in level_speech:
            speeches[levels.start : levels.stop] = [own[:, self.columns]] * len(levels)
        return LevelConditions(speeches, lengths, self.residual, styles)


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
    speech: Tensor, lengths: Sequence[int], residual: bool, styles: Sequence[Tensor] = ()
) -> list[Tensor]:
    """Return the condition (B, S + K, T_i) of each level from `speech` (B, S, T) at the finest one.

    S is 0 without speech input; `styles` are (B, K, T_i) for each level, or empty. With `residual`,
    finer levels get only the detail that coarser ones lack.
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
    if not styles:
        return features
    return [torch.cat(parts, dim=1) for parts in zip(features, styles, strict=True)]


class LevelConditions:
    """Conditions of any frames of any level, without a pyramid of the whole speech in memory.

    Args:
        speeches: of each level, (T, S) float32 features at the finest level; S is 0 without speech
            input.
        lengths: T_i, frames of each level.
        residual: give finer levels only the detail that coarser ones lack.
        styles: (1, K, T_i) for each level, or empty.
    """

    def __init__(
        self,
        speeches: Sequence[np.ndarray],
        lengths: Sequence[int],
        residual: bool,
        styles: Sequence[Tensor] = (),
    ) -> None:
        self.speeches = speeches
        self.lengths = lengths
        self.residual = residual
        self.styles = styles

    def __call__(self, level: int, start: int, stop: int) -> Tensor:
        """Return (1, S + K, stop - start): these frames of the condition of a level."""
        parts, speech = [], self.speeches[level]
        if speech.shape[1]:
            if self.residual:
                features = af.residual_level(speech, self.lengths, level, start, stop)
            else:
                features = af.resample_frames(speech, self.lengths[level], start, stop)
            parts.append(torch.from_numpy(np.ascontiguousarray(features.T))[None])
        if self.styles:
            parts.append(self.styles[level][..., start:stop])
        return torch.cat(parts, dim=1)
