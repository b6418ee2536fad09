"""Style conditions of each level and frame.

Levels may have different styles: coarse levels decide posture and path, fine levels detail.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from gesturekit.corpus.styles import style_track
from gesturekit.errors import ModelError
from gesturekit.multires.controls import MultiresControls
from gesturekit.multires.network.resampling import resample
from gesturekit.multires.sampling.conditions import level_range

_EXAMPLE = "1-4=describe,5-8=angry"


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


def level_track(names: Sequence[str], style: str, n_frames: int, fps: float) -> Tensor:
    """Return the style of each frame, (K, T); see `style_track`."""
    return torch.from_numpy(style_track(names, style, n_frames, fps).T.copy())


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
    style, level_style = controls.style, controls.level_style
    if style is None:
        style = names[int(torch.randint(len(names), (), generator=rng))]

    def with_margins(style: str) -> Tensor:
        track = level_track(names, style, lengths[-1] - 2 * margin, fps)
        return F.pad(track[None], (margin, margin), mode="replicate")[0]

    tracks = [with_margins(style)] * len(lengths)
    for text in level_style.split(",") if level_style else ():
        numbers, _, name = text.strip().partition("=")
        if not name:
            raise ModelError(f"level style {numbers!r} names no style: {_EXAMPLE} does")
        levels = level_range(numbers, len(lengths), "level style", _EXAMPLE)
        tracks[levels.start : levels.stop] = [with_margins(name)] * len(levels)
    return [resample(own, n)[None] for own, n in zip(tracks, lengths, strict=True)]
