"""Styles: which of them a level is told, frame by frame.

A style is one-hot over the names that the corpus has. It may change over time, with blends, and
differ from level to level: coarse levels decide posture and path, fine levels detail.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from gesturekit.errors import ModelError
from gesturekit.multires.interpolation import reflect, resample

BLEND_SECONDS = 1.0
"""How long one style takes to become the next, half of it on either side of the border."""

_SPAN = re.compile(r"(?P<name>.+)@(?P<start>\d+(\.\d+)?)-(?P<end>\d+(\.\d+)?)")
_LEVELS = re.compile(r"(?P<first>\d+)(-(?P<last>\d+))?=(?P<name>.+)")


def style_levels(styles: Tensor, n_styles: int, lengths: Sequence[int]) -> list[Tensor]:
    """(B, L) numbers of styles to the one-hot (B, K, T_i) of each level, the same at all times."""
    codes = F.one_hot(styles, n_styles).float()
    return [codes[:, i, :, None].expand(-1, -1, n) for i, n in enumerate(lengths)]


def mixed_styles(
    shares: Tensor, count: int, levels: int, mixing: float, rng: torch.Generator
) -> Tensor:
    """(count, L) numbers of styles for random-generation steps (section 4.2 of the paper).

    A share `mixing` of them has one style up to a random level and another one above it.

    Args:
        shares: (K,) how often each style is drawn.
        count: how many motions.
        levels: L.
        mixing: share of motions with two styles.
        rng: where chance comes from.
    """
    coarse, fine = torch.multinomial(shares, 2 * count, replacement=True, generator=rng).split(
        count
    )
    crossover = torch.randint(1, max(levels, 2), (count,), generator=rng)
    unmixed = torch.rand(count, generator=rng) >= mixing
    crossover[unmixed] = levels
    return torch.where(torch.arange(levels) < crossover[:, None], coarse[:, None], fine[:, None])


def style_track(names: Sequence[str], wanted: str, n_frames: int, fps: float) -> Tensor:
    """(K, T) weights of the styles over time, which add up to 1.

    Args:
        names: the K styles there are.
        wanted: one of them, or spans of seconds: `old@0-10,angry@10-20`. Before the first span,
            after the last and between two, the nearest span holds; where spans overlap they share.
        n_frames: T.
        fps: frames per second.

    Raises:
        ModelError: an unknown style, or a span that cannot be read.
    """
    if "@" not in wanted:
        track = torch.zeros(len(names), n_frames)
        track[_number(names, wanted)] = 1.0
        return track
    time = torch.arange(n_frames) / fps
    apart, numbers = [], []
    for text in wanted.split(","):
        match = _SPAN.fullmatch(text.strip())
        if match is None:
            raise ModelError(f"style {text.strip()!r}: spans look like old@0-10,angry@10-20")
        start, end = float(match["start"]), float(match["end"])
        if end <= start:
            raise ModelError(f"style {text.strip()!r}: the span ends before it begins")
        numbers.append(_number(names, match["name"]))
        apart.append(torch.maximum(start - time, time - end + 0.5 / fps).clamp(min=0.0))
    distance = torch.stack(apart)
    holds = (distance <= distance.min(dim=0).values + 1e-6).float()
    track = torch.zeros(len(names), n_frames).index_add_(0, torch.tensor(numbers), holds)
    track = track / track.sum(dim=0)
    # The mean over a blend's length turns every border into a ramp of that length.
    reach = math.floor(BLEND_SECONDS * fps / 2)
    return reflect(track, reach).unfold(-1, 2 * reach + 1, 1).mean(dim=-1) if reach else track


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
        track = style_track(names, wanted, lengths[-1] - 2 * margin, fps)
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


def _number(names: Sequence[str], name: str) -> int:
    if name not in names:
        raise ModelError(f"style {name!r}: the model knows {', '.join(names)}")
    return list(names).index(name)
