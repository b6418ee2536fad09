"""Clips and recordings of one speaker, and what the speaker's recordings are compared with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gesturekit.errors import GestureKitError, MotionError
from gesturekit.evaluation.measuring.clips import load_recording
from gesturekit.evaluation.measuring.samples import copied
from gesturekit.evaluation.metrics.hands import FPS
from gesturekit.evaluation.metrics.two_sample import (
    motion_windows,
    two_sample_accuracy,
    within_reach,
)
from gesturekit.evaluation.pairs import Excluded, ItemInterval, Items
from gesturekit.motion import Motion

TRAINING_SECONDS = 1200.0
"""Length of training motion that is compared with, at most; of more, items are drawn at random."""

MOST_TAKES = 12
"""Takes of a speaker that are compared with that speaker's other takes, at most."""


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
        every = [one for one in zip(self.motions, self.speakers, fit) if one[2]]
        own = [motion for motion, name, _ in every if name == speaker]
        return own or [motion for motion, _, _ in every]


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
            chosen = takes[:: -(-len(takes) // MOST_TAKES)]
            sides = zip(self.recorded, self.takes)
            every = [(motion, take) for motion, take in sides]
            return [
                ([m for m, take in every if take == held], [m for m, take in every if take != held])
                for held in chosen
            ]
        if len(self.recorded) > 1:
            halves = self.recorded[::2], self.recorded[1::2]
        else:
            (motion,) = self.recorded
            middle = motion.n_frames // 2
            if middle < 1:
                raise MotionError("the recording is too short to be cut into halves")
            halves = [motion[:middle]], [motion[middle:]]
        return [halves, halves[::-1]]


def own_windows(
    held: Sequence[Motion],
    others: Sequence[Motion],
    joints: Sequence[str],
    seed: int,
) -> dict[str, float]:
    """Return 1-NN accuracy and share within reach of recordings.

    Args:
        held: held-out recordings, judged as if they had been generated.
        others: the recordings that they are compared with.
        joints: upper-body joints to compare.
        seed: seed of subsamples.

    Raises:
        MotionError: recordings that are too short, or lack a joint.
    """
    mine, theirs = motion_windows(held, joints), motion_windows(others, joints)
    return {
        "one_nn": two_sample_accuracy(theirs, mine, seed=seed),
        "within_reach": 100.0 * within_reach(theirs, mine, seed=seed),
    }
