"""Styles: which of them a level is told, frame by frame.

They may differ from level to level: coarse levels decide posture and path, fine levels detail.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from gesturekit.corpus.styles import style_track
from gesturekit.errors import ModelError
from gesturekit.multires.network.resampling import resample

_LEVELS = re.compile(r"(?P<first>\d+)(-(?P<last>\d+))?=(?P<name>.+)")


def style_levels(styles: Tensor, n_styles: int, lengths: Sequence[int]) -> list[Tensor]:
    """(B, L) numbers of styles to the one-hot (B, K, T_i) of each level, the same at all times."""
    codes = F.one_hot(styles, n_styles).float()
    return [codes[:, i, :, None].expand(-1, -1, n) for i, n in enumerate(lengths)]


def agreed_style(styles: Tensor, n_styles: int, level: int) -> Tensor:
    """(B, K) one-hot style of motions whose levels up to this one all have it, else zeros.

    Args:
        styles: (B, L) numbers of styles.
        n_styles: K.
        level: its index.
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
    """(count, L) numbers of styles for random-generation steps (section 4.2 of the paper).

    A share `mixing` of them has one style up to a random level and another one above it.

    Args:
        coarse_shares: (K,) how often each style is drawn for the coarse levels.
        fine_shares: the same for the levels above.
        count: how many motions.
        levels: L.
        mixing: share of motions with two styles.
        rng: where chance comes from.
    """
    coarse, fine = (
        torch.multinomial(shares, count, replacement=True, generator=rng)
        for shares in (coarse_shares, fine_shares)
    )
    crossover = torch.randint(1, max(levels, 2), (count,), generator=rng)
    unmixed = torch.rand(count, generator=rng) >= mixing
    crossover[unmixed] = levels
    return torch.where(torch.arange(levels) < crossover[:, None], coarse[:, None], fine[:, None])


def level_track(names: Sequence[str], wanted: str, n_frames: int, fps: float) -> Tensor:
    """(K, T) of `style_track`."""
    return torch.from_numpy(style_track(names, wanted, n_frames, fps).T.copy())


def asked_styles(
    names: Sequence[str],
    style: str | None,
    level_style: str | None,
    lengths: Sequence[int],
    fps: float,
    rng: torch.Generator,
    margin: int = 0,
) -> list[Tensor]:
    """One-hot or blended styles (1, K, T_i) for each level of a motion.

    Args:
        names: the K styles that the model knows.
        style: see `style_track`; None draws one by chance.
        level_style: styles of single levels, counted from 1, the coarsest:
            `1-4=describe,5-8=angry`. They go before `style`.
        lengths: frames of each level.
        fps: frames per second of the last.
        rng: where a style that nobody asked for is drawn from.
        margin: frames of the last level before and after the motion; its ends hold there.

    Raises:
        ModelError: an unknown style or level, or a text that cannot be read.
    """
    if style is None:
        style = names[int(torch.randint(len(names), (), generator=rng))]

    def with_margins(wanted: str) -> Tensor:
        track = level_track(names, wanted, lengths[-1] - 2 * margin, fps)
        return F.pad(track[None], (margin, margin), mode="replicate")[0]

    tracks = [with_margins(style)] * len(lengths)
    for text in level_style.split(",") if level_style else ():
        match = _LEVELS.fullmatch(text.strip())
        if match is None:
            raise ModelError(f"level style {text.strip()!r}: it looks like 1-4=describe,5-8=angry")
        first, last = int(match["first"]), int(match["last"] or match["first"])
        if not 1 <= first <= last <= len(lengths):
            raise ModelError(
                f"level style {text.strip()!r}: the model has levels 1 (coarse) to {len(lengths)}"
            )
        own = with_margins(match["name"])
        tracks[first - 1 : last] = [own] * (last - first + 1)
    return [resample(own, n)[None] for own, n in zip(tracks, lengths, strict=True)]
