"""Bounded random samples of motion, for metrics that need all motion of a set at once."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from gesturekit.motion import Motion

MOST_BYTES = 300_000_000
"""Memory of the rotations of a sample, at most: 70 minutes at 30 fps with 75 joints."""
PIECE_SECONDS = 10.0
"""Length of pieces that are drawn from larger sets, at least; shorter motions are one piece."""


class MotionSample:
    """Keeps all motions that are added; of more than `most` bytes, a random sample of pieces.

    Each piece gets a random number from (seed, number of its motion). Pieces whose number is below
    a threshold are kept, and the threshold is halved as long as they are too many: each piece of
    the set is kept with the same probability. Samples of one seed keep the same pieces of motions
    that are added in the same order, if they are equally large.

    Args:
        seed: seed of the random numbers.
        most: bytes of rotations to keep.

    Attributes:
        count: number of motions that were added.
        seconds: their length.
    """

    def __init__(self, seed: int, most: int = MOST_BYTES) -> None:
        self.count = 0
        self.seconds = 0.0
        self._seed = seed
        self._most = most
        self._kept: list[_Piece] = []
        self._bytes = 0
        self._threshold = 1.0

    def add(self, motion: Motion) -> None:
        """Add a motion; only copies of its pieces are kept if the set is larger than the limit."""
        added: list[_Piece] = [(self.count, 0.0, motion)]
        self.count += 1
        self.seconds += motion.duration
        added = added if self.is_whole else self._drawn(added)
        self._kept += added
        self._bytes += _size(added)
        while self._bytes > self._most:
            whole = self.is_whole
            self._threshold /= 2
            below = [piece for piece in self._kept if piece[1] < self._threshold]
            self._kept = self._drawn(self._kept) if whole else below
            self._bytes = _size(self._kept)

    @property
    def is_whole(self) -> bool:
        """True if all motion that was added is kept, uncut."""
        return self._threshold == 1.0

    @property
    def motions(self) -> list[Motion]:
        """The motions or pieces that are kept, in order."""
        return [motion for _, _, motion in self._kept]

    @property
    def owners(self) -> list[int]:
        """Number of the added motion, from 0, that each of `motions` is part of."""
        return [owner for owner, _, _ in self._kept]

    def _drawn(self, whole: Iterable[_Piece]) -> list[_Piece]:
        """Cut motions into pieces; return copies of those below the threshold."""
        kept = []
        for owner, _, motion in whole:
            count = max(1, int(motion.duration / PIECE_SECONDS))
            ends = [i * motion.n_frames // count for i in range(count + 1)]
            draws = np.random.default_rng([self._seed, owner]).random(count)
            kept += [
                (owner, draw, copied(motion, start, stop))
                for start, stop, draw in zip(ends, ends[1:], draws.tolist())
                if draw < self._threshold
            ]
        return kept


_Piece = tuple[int, float, Motion]
"""Number of a motion, random number, and the motion or piece of it."""


def copied(motion: Motion, start_frame: int, stop_frame: int) -> Motion:
    """Return a copy of some frames, which does not keep the whole motion in memory as a slice does.

    Raises:
        MotionError: the range is empty.
    """
    part = motion[start_frame:stop_frame]
    return replace(
        part,
        rotations=part.rotations.copy(),
        translation=part.translation.copy(),
        joint_translations={name: v.copy() for name, v in part.joint_translations.items()},
        expressions=None,
    )


def _size(pieces: Iterable[_Piece]) -> int:
    return sum(motion.rotations.nbytes for _, _, motion in pieces)
