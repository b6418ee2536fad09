"""Noise that recalls: random motions begin with pieces of z*, in another order.

A recording is made from its z* alone, and a network that reads fresh noise has no reason to bring
up all of it. Pieces shorter than what the first level sees at once bring up what they stand for,
but always as part of something new.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor


class Recall:
    """Puts noise together from pieces of z*, each once in chance order before any comes again.

    Args:
        z_stars: of each recording, (T_1,) or (D, T_1) where each channel has its own.
        styles: number of the style of each recording.
        piece: frames of a piece at most; a new deck of pieces is cut at other places.
    """

    def __init__(self, z_stars: Sequence[Tensor], styles: Sequence[int], piece: int) -> None:
        self.rows: dict[int, list[Tensor]] = {}
        for noise, style in zip(z_stars, styles, strict=True):
            self.rows.setdefault(style, []).append(noise.reshape(-1, noise.shape[-1]))
        self.piece = piece

    def __call__(self, styles: Sequence[int], rng: torch.Generator) -> Tensor:
        """(1, 1 or D, T_1) noise, each piece of the style asked for at its first frame.

        Args:
            styles: (T_1,) number of the style of each frame.
            rng: where chance comes from.
        """
        decks: dict[int, Iterator[Tensor]] = {}
        parts: list[Tensor] = []
        done = 0
        while done < len(styles):
            style = styles[done]
            if style not in decks:
                decks[style] = self._deck(self.rows[style], rng)
            parts.append(next(decks[style]))
            done += parts[-1].shape[-1]
        return torch.cat(parts, dim=-1)[None, :, : len(styles)]

    def _deck(self, rows: Sequence[Tensor], rng: torch.Generator) -> Iterator[Tensor]:
        while True:
            pieces = []
            for row in rows:
                first = 1 + int(torch.randint(self.piece, (), generator=rng))
                edges = [0, *range(first, row.shape[-1], self.piece), row.shape[-1]]
                pieces += [row[:, a:b] for a, b in zip(edges, edges[1:], strict=False)]
            for i in torch.randperm(len(pieces), generator=rng).tolist():
                yield pieces[i]
