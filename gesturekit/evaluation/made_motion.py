"""Motion made from recordings: a held pose, chosen frames, noise, less reach, and known-bad motion.

`measuring.baselines` compares models with some of it, `report.sanity` shows what metrics notice.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

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


def chosen_frames(motion: Motion, frames: np.ndarray) -> Motion:
    """Return chosen frames (T,) of a motion, in that order, at its frame rate."""
    return replace(
        motion,
        rotations=motion.rotations[frames],
        translation=motion.translation[frames],
        joint_translations={name: v[frames] for name, v in motion.joint_translations.items()},
        face=None,
    )


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
