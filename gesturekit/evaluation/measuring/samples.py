"""Samples of motion that are in memory at once: of a set, of the training split, of a speaker."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from gesturekit.errors import GestureKitError, MotionError
from gesturekit.evaluation.measuring.clips import load_recording
from gesturekit.evaluation.metrics.hands import FPS
from gesturekit.evaluation.pairs import Excluded, ItemInterval, Items
from gesturekit.motion import Motion

T = TypeVar("T")
MOST_BYTES = 300_000_000
"""Memory of the rotations of a sample, at most: 70 minutes at 30 fps with 75 joints."""
PIECE_SECONDS = 10.0
"""Length of pieces that are drawn from larger sets, at least; shorter motions are one piece."""
TRAINING_SECONDS = 1200.0
"""Length of training motion that is compared with, at most; of more, items are drawn at random."""

MOST_TAKES = 12
"""Takes of a speaker that are compared with that speaker's other takes, at most."""


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
        face=None,
    )


def _size(pieces: Iterable[_Piece]) -> int:
    return sum(motion.rotations.nbytes for _, _, motion in pieces)


@dataclass
class TrainingMotion:
    """Motion of the manifest's training split.

    Attributes:
        motions: at 25 fps; empty without such a split.
        speakers: the speaker of each motion, if known.
        note: "" or how much of the split is used.
        excluded: items that cannot be read.
    """

    motions: list[Motion] = field(default_factory=list)
    speakers: list[str | None] = field(default_factory=list)
    note: str = ""
    excluded: list[Excluded] = field(default_factory=list)

    @classmethod
    def of(cls, reference: Path | Items, seed: int) -> TrainingMotion:
        """Read the training split that belongs to recordings; nothing unless they are `Items`."""
        found = cls()
        items = list(reference.training) if isinstance(reference, Items) else []
        total = sum(item.duration for item in items)
        if total > TRAINING_SECONDS:
            np.random.default_rng(seed).shuffle(items)
        left = TRAINING_SECONDS
        for item in items:
            if left < 1.0:
                break
            try:
                motion = load_recording(ItemInterval(item), FPS)
            except GestureKitError as error:
                found.excluded.append(Excluded(item.id, str(error), "the training split"))
                continue
            motion = copied(motion, 0, min(motion.n_frames, round(left * FPS)))
            left -= motion.duration
            found.motions.append(motion)
            found.speakers.append(item.speaker)
        if total > TRAINING_SECONDS:
            found.note = f"{TRAINING_SECONDS / 60:.0f} of {total / 60:.0f} min of it"
        return found

    def of_speaker(self, speaker: str | None, joints: Sequence[str]) -> list[Motion]:
        """Return the motion of a speaker; of all speakers if that one has none.

        Args:
            speaker: name, or None.
            joints: motions without these joints are left out.
        """
        fit = [set(joints) <= set(motion.skeleton.names) for motion in self.motions]
        fitting = [(m, name) for m, name, fits in zip(self.motions, self.speakers, fit) if fits]
        own = [motion for motion, name in fitting if name == speaker]
        return own or [motion for motion, _ in fitting]


@dataclass(frozen=True)
class SpeakerClips:
    """Clips of one speaker (and style) with their recordings, or pieces of them; see `groups_of`.

    Attributes:
        recorded: (R) recordings.
        recordings: (R) number of each among the recordings of all groups; pieces share it.
        takes: (R) take of each.
        generated: (C) clips, in the order of their recordings.
        clips: (C) number of each among the clips of all groups.
        recording_of: number of the recording of each clip of all groups.
        joints: upper-body joints that all clips have.
        training: motion of the speaker's training split.
    """

    recorded: list[Motion]
    recordings: np.ndarray
    takes: list[str]
    generated: list[Motion]
    clips: np.ndarray
    recording_of: Sequence[int]
    joints: tuple[str, ...]
    training: list[Motion]

    @property
    def has_others(self) -> bool:
        """True where held-out recordings can be compared with another take or training motion."""
        return bool(self.training) or len(set(self.takes)) > 1

    def splits(self) -> list[tuple[list[Motion], list[Motion]]]:
        """Return pairs of (held-out recordings, other recordings of the speaker) to compare.

        Held-out recordings are compared with training motion if there is any, else each take with
        the other takes, else one half of a single take with the other half.
        """
        if self.training:
            return [(self.recorded, self.training)]
        takes = sorted(set(self.takes))
        if len(takes) > 1:
            every = list(zip(self.recorded, self.takes))
            return [
                ([m for m, take in every if take == held], [m for m, take in every if take != held])
                for held in evenly(takes, MOST_TAKES)
            ]
        both = halves(self.recorded)
        return [both, both[::-1]]


def halves(motions: Sequence[Motion]) -> tuple[list[Motion], list[Motion]]:
    """Return every other recording, and the rest; of a single one its halves.

    Raises:
        MotionError: a single one has one frame.
    """
    if len(motions) > 1:
        return list(motions[::2]), list(motions[1::2])
    (motion,) = motions
    middle = motion.n_frames // 2
    if middle < 1:
        raise MotionError("the recording is too short to be cut into halves")
    return [motion[:middle]], [motion[middle:]]


def evenly(items: Sequence[T], most: int) -> Sequence[T]:
    """Return every k-th item, with the least k that leaves at most `most`."""
    return items[:: max(1, -(-len(items) // most))]
