"""Motion that is known to be bad, made from a recording."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gesturekit.motion import Motion
from gesturekit.motion.body_size import body_scale
from gesturekit.motion.parts import arm_joints
from gesturekit.motion.rotations import (
    mean_quaternion,
    multiply_quaternions,
    quaternion_from_rotation_vector,
    slerp,
)

NOISE, JITTER = 0.3, 0.05
"""Standard deviations of the rotations of every joint in every frame, rad."""
SWAY, SWAY_RATE = 0.2, 0.4
"""Amplitude of the foot slide on the reference body, metres, and its frequency, Hz."""


@dataclass(frozen=True)
class Source:
    """Recordings from which bad motion is made.

    Attributes:
        recording: the recording that a clip is evaluated with.
        other: another held-out recording.
        training: motion of the training set.
        seed: of noise.
    """

    recording: Motion
    other: Motion
    training: Motion
    seed: int


def frozen(source: Source) -> Motion:
    """Hold the pose in the middle of the recording."""
    motion = source.recording
    return _frames(motion, np.full(motion.n_frames, motion.n_frames // 2))


def mean_pose(source: Source) -> Motion:
    """Hold the mean pose of the recording."""
    motion = source.recording
    held = frozen(source)
    return replace(
        held,
        rotations=np.tile(_mean_rotations(motion), (motion.n_frames, 1, 1)),
        translation=np.tile(motion.translation.mean(axis=0), (motion.n_frames, 1)),
    )


def noise(source: Source) -> Motion:
    """Turn every joint of the mean pose at random in every frame."""
    return _shaken(mean_pose(source), NOISE, source.seed)


def jitter(source: Source) -> Motion:
    """Add noise to the rotations of the recording."""
    return _shaken(source.recording, JITTER, source.seed)


def another_utterance(source: Source) -> Motion:
    """Take the motion of another held-out recording."""
    return _cut(source.other, source.recording)


def backwards(source: Source) -> Motion:
    """Play the recording backwards."""
    motion = source.recording
    return _frames(motion, np.arange(motion.n_frames)[::-1])


def half_speed(source: Source) -> Motion:
    """Play the first half of the recording at half the speed."""
    motion = source.recording
    slow = replace(motion.resample(2.0 * motion.fps), fps=motion.fps)
    return _cut(slow, motion)


def half_reach(source: Source) -> Motion:
    """Halve the rotations of the arms about their mean."""
    motion = source.recording
    rotations = motion.rotations.copy()
    arms = [motion.skeleton.index(name) for name in arm_joints(motion.skeleton)]
    mean = np.broadcast_to(_mean_rotations(motion)[arms], rotations[:, arms].shape)
    rotations[:, arms] = slerp(mean, rotations[:, arms], np.full(mean.shape[:-1], 0.5))
    return replace(motion, rotations=rotations)


def foot_slide(source: Source) -> Motion:
    """Sway the whole body sideways, so that the feet slide."""
    motion = source.recording
    sway = SWAY * body_scale(motion.skeleton) * np.sin(2 * np.pi * SWAY_RATE * motion.times)
    return replace(motion, translation=motion.translation + sway[:, None] * (1.0, 0.0, 0.0))


def training_recording(source: Source) -> Motion:
    """Take motion of the training set."""
    return _cut(source.training, source.recording)


BAD_MOTION: Mapping[str, Callable[[Source], Motion]] = {
    "frozen": frozen,
    "mean pose": mean_pose,
    "noise": noise,
    "jitter": jitter,
    "another utterance": another_utterance,
    "reversed": backwards,
    "half speed": half_speed,
    "half reach": half_reach,
    "foot slide": foot_slide,
    "training recording": training_recording,
}
"""Functions that make bad motion, by name."""


def _frames(motion: Motion, frames: Sequence[int] | np.ndarray) -> Motion:
    """Return chosen frames of a motion, in that order."""
    return replace(
        motion,
        rotations=motion.rotations[frames],
        translation=motion.translation[frames],
        joint_translations={name: v[frames] for name, v in motion.joint_translations.items()},
    )


def _cut(motion: Motion, length: Motion) -> Motion:
    return motion.slice(0, min(motion.n_frames, length.n_frames))


def _mean_rotations(motion: Motion) -> np.ndarray:
    """Return (J, 4) mean quaternions."""
    return np.stack(
        [mean_quaternion(motion.rotations[:, j]) for j in range(motion.skeleton.n_joints)]
    )


def _shaken(motion: Motion, deviation: float, seed: int) -> Motion:
    rng = np.random.default_rng(seed)
    vectors = rng.normal(0.0, deviation, (*motion.rotations.shape[:2], 3))
    shaken = multiply_quaternions(motion.rotations, quaternion_from_rotation_vector(vectors))
    return replace(motion, rotations=shaken)
