"""Baselines: motion made from recordings alone, which a model is compared with.

Each is an ordinary model of the report. A model that is not better than `other_utterance` does not
listen to the speech.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from audio_features import Wave
from gesturekit.errors import EvaluationError, MotionError
from gesturekit.evaluation.measuring.clips import load_recording
from gesturekit.evaluation.measuring.samples import MotionSample
from gesturekit.evaluation.pairs import (
    WINDOW_SECONDS,
    ItemInterval,
    Items,
    Pair,
    Pairs,
    recordings,
)
from gesturekit.motion import Motion
from gesturekit.motion.rotations import mean_quaternion

_FRAMES = 500  # of each recording, evenly spaced, that the mean pose is taken of


def baseline_pairs(
    names: Sequence[str], models: Mapping[str, Pairs], reference: Path | Items, fps: float
) -> dict[str, Pairs]:
    """Return {name: a clip of the baseline for each recording of the first model}.

    Args:
        names: names of `BASELINES`.
        models: clips of each model by label.
        reference: the recordings; a manifest with a training split gives the baselines' motion.
        fps: frame rate of the motion.

    Raises:
        EvaluationError: an unknown name or a model's label, or recordings from which a baseline
            cannot be made.
        CorpusError: a recording cannot be read.
    """
    unknown = [name for name in names if name not in BASELINES]
    if unknown:
        raise EvaluationError(f"baseline {unknown[0]!r}; expected one of {', '.join(BASELINES)}")
    taken = [name for name in names if name in models]
    if taken:
        raise EvaluationError(f"baseline {taken[0]!r} has the label of a model; rename its folder")
    every = recordings(reference)
    training = reference.training if isinstance(reference, Items) else ()
    source = {item.id: ItemInterval(item) for item in training} or every
    first = next(iter(models.values()))
    windows = {pair.of: pair for pair in first.pairs}
    made = {}
    for name in names:
        baseline = BASELINES[name].of(every, source, fps)
        items = [
            (pair, _BaselineItem(_name(pair), pair, fps, baseline)) for pair in windows.values()
        ]
        pairs = [replace(pair, name=item.id, generated=ItemInterval(item)) for pair, item in items]
        made[name] = Pairs(pairs)
    return made


def _name(pair: Pair) -> str:
    return pair.stem if pair.window is None else f"{pair.stem}_w{pair.window:03d}"


_Recordings = Mapping[str, Path | ItemInterval]


class Baseline(Protocol):
    """Makes motion from recordings; worker processes are handed a copy."""

    def __call__(self, pair: Pair, n_frames: int) -> Motion:
        """Return the motion for a recording, of a number of frames at most."""

    @classmethod
    def of(cls, every: _Recordings, source: _Recordings, fps: float) -> Baseline:
        """Return the baseline of all recordings; `source` are those that may be known."""


@dataclass(frozen=True, eq=False)
class _BaselineItem:
    """A baseline's clip, made when it is needed; a manifest item without files."""

    id: str
    pair: Pair
    fps: float
    make: Baseline
    take: str = ""
    speaker: str | None = None
    style: str | None = None
    audio: Path | None = None
    motion: Path | None = None
    split: str = ""
    motion_start: float = 0.0
    duration: float = math.inf

    def load_motion(self) -> Motion:
        pair = self.pair
        n_frames = load_recording(pair.reference, self.fps).n_frames
        if pair.window is not None:
            start = round(pair.window * WINDOW_SECONDS * self.fps)
            n_frames = min(round(WINDOW_SECONDS * self.fps), n_frames - start)
        if n_frames < 1:
            raise MotionError(f"{pair.stem} ends before its window {pair.window} begins")
        return self.make(pair, n_frames)

    def load_wave(self) -> Wave:
        raise EvaluationError(f"{self.id}: a baseline has no sound of its own")


@dataclass(frozen=True, eq=False)
class _MeanPose:
    """The mean pose of the recordings, held still."""

    pose: Motion

    @classmethod
    def of(cls, every: _Recordings, source: _Recordings, fps: float) -> _MeanPose:
        sample, rigs = MotionSample(seed=0), set()
        for path in source.values():
            sample.add(motion := load_recording(path, fps))
            rigs.add(motion.skeleton.names)
        if len(rigs) > 1:
            raise EvaluationError("baseline mean_pose needs recordings of one rig")
        return cls(mean_pose(sample.motions))

    def __call__(self, pair: Pair, n_frames: int) -> Motion:
        rig = load_recording(pair.reference, self.pose.fps).skeleton
        if rig.names != self.pose.skeleton.names:
            raise MotionError(f"{pair.stem}: its rig differs from that of the mean pose")
        return replace(held(self.pose, n_frames), skeleton=rig)


@dataclass(frozen=True, eq=False)
class _OtherUtterance:
    """The next recording, from its start; one of the training motion if there is only one."""

    others: _Recordings
    fps: float

    @classmethod
    def of(cls, every: _Recordings, source: _Recordings, fps: float) -> _OtherUtterance:
        if len({*every, *source}) < 2:
            raise EvaluationError(
                "baseline other_utterance needs a second recording; there is only "
                f"{next(iter(every))!r}"
            )
        return cls(every if len(every) > 1 else source, fps)

    def __call__(self, pair: Pair, n_frames: int) -> Motion:
        keys = list(self.others)
        after = (keys.index(pair.stem) + 1) % len(keys) if pair.stem in self.others else 0
        return load_recording(self.others[keys[after]], self.fps)[:n_frames]


def mean_pose(motions: Sequence[Motion]) -> Motion:
    """Return the mean pose of motions of one rig and frame rate, as one frame."""
    thinned = [slice(None, None, max(1, m.n_frames // _FRAMES)) for m in motions]
    rotations = np.concatenate([m.rotations[kept] for m, kept in zip(motions, thinned)])
    place = np.concatenate([m.translation[kept] for m, kept in zip(motions, thinned)])
    return Motion(
        motions[0].skeleton,
        np.stack([mean_quaternion(joint) for joint in rotations.swapaxes(0, 1)])[None],
        place.mean(axis=0)[None],
        motions[0].fps,
        joint_translations={
            name: np.concatenate([m.joint_translations[name] for m in motions]).mean(axis=0)[None]
            for name in motions[0].joint_translations
        },
    )


def held(pose: Motion, n_frames: int) -> Motion:
    """Return a motion of `n_frames` that repeats its only frame."""
    return replace(
        pose,
        rotations=np.repeat(pose.rotations, n_frames, axis=0),
        translation=np.repeat(pose.translation, n_frames, axis=0),
        joint_translations={
            name: np.repeat(place, n_frames, axis=0)
            for name, place in pose.joint_translations.items()
        },
    )


BASELINES: Mapping[str, type[Baseline]] = {
    "mean_pose": _MeanPose,
    "other_utterance": _OtherUtterance,
}
"""Baselines by name."""
