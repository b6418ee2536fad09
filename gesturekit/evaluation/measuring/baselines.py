"""Baselines: motion made from recordings alone, which a model is compared with.

Each is an ordinary model of the report. A model that is not better than `other_utterance` does not
listen to the speech.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

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
    windows = {(pair.stem, pair.window): pair for pair in first.pairs}
    made = {}
    for name in names:
        load = BASELINES[name](every, source, fps)
        made[name] = Pairs([_pair(pair, load, fps) for pair in windows.values()])
    return made


@dataclass(frozen=True, eq=False)
class _BaselineItem:
    """A baseline's clip, made when it is needed; a manifest item without files."""

    id: str
    load_motion: Callable[[], Motion]
    take: str = ""
    speaker: str | None = None
    style: str | None = None
    audio: Path | None = None
    motion: Path | None = None
    split: str = ""
    motion_start: float = 0.0
    duration: float = math.inf

    def load_wave(self) -> Wave:
        raise EvaluationError(f"{self.id}: a baseline has no sound of its own")


Loader = Callable[[Pair, int], Motion]
"""Function of a pair and a number of frames that makes the baseline's motion."""
_Recordings = Mapping[str, Path | ItemInterval]


def _mean_pose(every: _Recordings, source: _Recordings, fps: float) -> Loader:
    """Return a loader of the mean pose of the recordings in `source`, held still."""
    sample, rigs = MotionSample(seed=0), set()
    for path in source.values():
        sample.add(motion := load_recording(path, fps))
        rigs.add(motion.skeleton.names)
    if len(rigs) > 1:
        raise EvaluationError("baseline mean_pose needs recordings of one rig")
    (rig,), pose = rigs, mean_pose(sample.motions)

    def load(pair: Pair, n_frames: int) -> Motion:
        recording = load_recording(pair.reference, fps)
        if recording.skeleton.names != rig:
            raise MotionError(f"{pair.stem}: its rig differs from that of the mean pose")
        return replace(held(pose, n_frames), skeleton=recording.skeleton)

    return load


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


def _other_utterance(every: _Recordings, source: _Recordings, fps: float) -> Loader:
    """Return a loader of the next recording, from its start; of `source` if there is only one."""
    if len({*every, *source}) < 2:
        raise EvaluationError(
            "baseline other_utterance needs a second recording; there is only "
            f"{next(iter(every))!r}"
        )

    def load(pair: Pair, n_frames: int) -> Motion:
        others = every if len(every) > 1 else source
        keys = list(others)
        after = (keys.index(pair.stem) + 1) % len(keys) if pair.stem in others else 0
        motion = load_recording(others[keys[after]], fps)
        return motion[:n_frames]

    return load


BASELINES: Mapping[str, Callable[[_Recordings, _Recordings, float], Loader]] = {
    "mean_pose": _mean_pose,
    "other_utterance": _other_utterance,
}
"""Baselines by name."""


def _pair(pair: Pair, load: Loader, fps: float) -> Pair:
    """Return the pair with the baseline's motion instead of the model's."""
    name = pair.stem if pair.window is None else f"{pair.stem}_w{pair.window:03d}"

    def made() -> Motion:
        n_frames = load_recording(pair.reference, fps).n_frames
        if pair.window is not None:
            start = round(pair.window * WINDOW_SECONDS * fps)
            n_frames = min(round(WINDOW_SECONDS * fps), n_frames - start)
        if n_frames < 1:
            raise MotionError(f"{pair.stem} ends before its window {pair.window} begins")
        return load(pair, n_frames)

    return replace(pair, name=name, generated=ItemInterval(_BaselineItem(name, made)))
