"""Motion made from recordings: a held pose, noise, less reach, known-bad motion, and baselines.

A baseline is an ordinary model of the report: a model that is not better than `other_utterance`
does not listen to the speech. `report.sanity` shows what metrics notice of known-bad motion.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from gesturekit.corpus.manifest import Item
from gesturekit.errors import EvaluationError, MotionError
from gesturekit.evaluation.measuring.clips import MotionSample, chosen_frames, load_recording
from gesturekit.evaluation.pairs import (
    WINDOW_SECONDS,
    BareItem,
    Items,
    Pair,
    Pairs,
)
from gesturekit.motion import Motion
from gesturekit.motion.parts import arm_joints
from gesturekit.motion.parts.body_size import body_scale
from gesturekit.motion.rotations import (
    mean_quaternion,
    multiply_quaternions,
    quaternion_from_rotation_vector,
    slerp,
)

_FRAMES = 500  # of each recording, evenly spaced, that the mean pose is taken of
NOISE, JITTER = 0.3, 0.05
"""Standard deviations of the rotations of every joint in every frame, rad."""
SWAY, SWAY_RATE = 0.2, 0.4
"""Amplitude of the foot slide on the reference body, metres, and its frequency, Hz."""

_Recordings = Mapping[str, Item]
MakeMotion = Callable[[Pair, int], Motion]
"""Makes the motion for a recording, of a number of frames; it can be handed to other processes."""


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
    """Return a motion of `n_frames` that repeats the first frame of a pose."""
    return chosen_frames(pose, np.zeros(n_frames, int))


def turned(motion: Motion, vectors: np.ndarray) -> Motion:
    """Return a motion with joints turned by rotation vectors (T, J, 3), rad."""
    turns = quaternion_from_rotation_vector(vectors)
    return replace(motion, rotations=multiply_quaternions(motion.rotations, turns))


def shaken(motion: Motion, deviation: float, seed: int) -> Motion:
    """Return a motion with every joint turned at random in every frame, rad."""
    shape = (*motion.rotations.shape[:2], 3)
    return turned(motion, np.random.default_rng(seed).normal(0.0, deviation, shape))


def halved(motion: Motion, joints: Sequence[str]) -> Motion:
    """Return a motion with the rotations of some joints halved about their mean."""
    rotations, at = motion.rotations.copy(), [motion.skeleton.index(name) for name in joints]
    middle = np.broadcast_to([mean_quaternion(rotations[:, j]) for j in at], rotations[:, at].shape)
    rotations[:, at] = slerp(middle, rotations[:, at], np.full(middle.shape[:-1], 0.5))
    return replace(motion, rotations=rotations)


def bad_motion(recording: Motion, other: Motion, training: Motion, seed: int) -> dict[str, Motion]:
    """Return {name: known-bad motion} made from recordings.

    Args:
        recording: the recording that a clip is evaluated with.
        other: another held-out recording.
        training: motion of the training set.
        seed: of noise.
    """
    n, still = recording.n_frames, held(mean_pose([recording]), recording.n_frames)
    sway = SWAY * body_scale(recording.skeleton) * np.sin(2 * np.pi * SWAY_RATE * recording.times)
    slid = recording.translation + sway[:, None] * (1.0, 0.0, 0.0)
    slow = replace(recording.resample(2.0 * recording.fps), fps=recording.fps)
    return {
        "frozen": chosen_frames(recording, np.full(n, n // 2)),
        "mean pose": still,
        "noise": shaken(still, NOISE, seed),
        "jitter": shaken(recording, JITTER, seed),
        "another utterance": other[:n],
        "reversed": chosen_frames(recording, np.arange(n)[::-1]),
        "half speed": slow[:n],
        "half reach": halved(recording, arm_joints(recording.skeleton)),
        "foot slide": replace(recording, translation=slid),
        "training recording": training[:n],
    }


def baseline_pairs(
    names: Sequence[str], models: Mapping[str, Pairs], reference: Items, fps: float
) -> dict[str, Pairs]:
    """Return {name: a clip of the baseline for each recording of the first model}.

    Args:
        names: names of `BASELINES`; labels of models that are baselines add nothing.
        models: clips of each model by label.
        reference: the recordings; a manifest with a training split gives the baselines' motion.
        fps: frame rate of the motion.

    Raises:
        EvaluationError: an unknown name or a model's label, or recordings from which a baseline
            cannot be made.
        CorpusError: a recording cannot be read.
    """
    known = f"expected one of {', '.join(BASELINES)}"
    wrong = [f"{n!r}; {known}" for n in names if n not in BASELINES and n not in models]
    label = "has the label of a model; rename its folder"
    wrong += [f"{n!r} {label}" for n in names if n in BASELINES and n in models]
    if wrong:
        raise EvaluationError(f"baseline {wrong[0]}")
    every = reference.recordings()
    source = {item.id: item for item in reference.training} or every
    windows = {pair.of: pair for pair in next(iter(models.values())).pairs}
    made: dict[str, Pairs] = {}
    for name in (name for name in names if name in BASELINES):
        make, made[name] = BASELINES[name](every, source, fps), Pairs()
        for pair in windows.values():
            clip = pair.stem if pair.window is None else f"{pair.stem}_w{pair.window:03d}"
            motion = BareItem(id=clip, make=partial(_made, pair, fps, make))
            made[name].pairs.append(replace(pair, name=clip, generated=motion))
    return made


def _made(pair: Pair, fps: float, make: MakeMotion) -> Motion:
    """Make a baseline's clip, as long as its recording or the window of it."""
    n_frames = load_recording(pair.reference, fps).n_frames
    if pair.window is not None:
        window = round(WINDOW_SECONDS * fps)
        n_frames = min(window, n_frames - round(pair.window * WINDOW_SECONDS * fps))
    return make(pair, max(n_frames, 2))  # a window after the end is refused with its clip


def _mean_pose(every: _Recordings, source: _Recordings, fps: float) -> MakeMotion:
    """Return a maker of the mean pose of the recordings in `source`, held still."""
    sample, rigs = MotionSample(seed=0), set()
    for item in source.values():
        sample.add(motion := load_recording(item, fps))
        rigs.add(motion.skeleton.names)
    if len(rigs) > 1:
        raise EvaluationError("baseline mean_pose needs recordings of one rig")
    return partial(_held_pose, mean_pose(sample.motions))


def _held_pose(pose: Motion, pair: Pair, n_frames: int) -> Motion:
    rig = load_recording(pair.reference, pose.fps).skeleton
    if rig.names != pose.skeleton.names:
        raise MotionError(f"{pair.stem}: its rig differs from that of the mean pose")
    return replace(held(pose, n_frames), skeleton=rig)


def _other_utterance(every: _Recordings, source: _Recordings, fps: float) -> MakeMotion:
    """Return a maker of the next recording, from its start; of `source` if there is only one."""
    if len({*every, *source}) < 2:
        raise EvaluationError(
            "baseline other_utterance needs a second recording; there is only "
            f"{next(iter(every))!r}"
        )
    return partial(_next_recording, every if len(every) > 1 else source, fps)


def _next_recording(others: _Recordings, fps: float, pair: Pair, n_frames: int) -> Motion:
    keys = list(others)
    after = (keys.index(pair.stem) + 1) % len(keys) if pair.stem in others else 0
    return load_recording(others[keys[after]], fps)[:n_frames]


BASELINES: Mapping[str, Callable[[_Recordings, _Recordings, float], MakeMotion]] = {
    "mean_pose": _mean_pose,
    "other_utterance": _other_utterance,
}
"""Baselines by name."""
