"""Problems of recordings, and checks that find them: T-poses, differing rigs.

Defects of the motion itself are in `gesturekit.motion.defects`; `recording` turns all of them into
problems.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.parts import known_parts
from gesturekit.motion.parts.body_size import body_scale
from gesturekit.motion.rotations import IDENTITY, rotation_angles
from gesturekit.wording import listed

SEVERITIES = ("error", "warning", "note")


@dataclass(frozen=True)
class Problem:
    """A problem of one file, or of the whole corpus (`file` is None).

    An ``"error"`` leaves the recording out; a ``"warning"`` keeps it and says what was done about
    it; a ``"note"`` is information only.
    """

    severity: str
    file: Path | None
    message: str

    def __str__(self) -> str:
        return f"{self.severity}: {self.text}"

    @property
    def text(self) -> str:
        """The message, preceded by its file unless it already names the file."""
        if self.file is None:
            return self.message
        # Match whole words: a folder "e" is not named by every word that contains an e.
        if re.search(rf"(?<!\w){re.escape(str(self.file))}(?!\w)", self.message):
            return self.message
        return f"{self.file}: {self.message}"


def printed(problems: Iterable[Problem]) -> list[str]:
    """Format problems as lines: errors first; equal notes or warnings on files share a line."""
    groups: dict[tuple[object, ...], list[Problem]] = {}
    for problem in sorted(problems, key=lambda problem: SEVERITIES.index(problem.severity)):
        together = problem.file if problem.severity == "error" else None
        groups.setdefault((problem.severity, problem.message, together), []).append(problem)
    lines = []
    for (severity, message, _), members in groups.items():
        shown = listed([str(member.file) for member in members], 3)
        several = f"{severity}: {len(members)} files: {message}: {shown}"
        lines.append(several if len(members) > 1 else str(members[0]))
    return lines


MAX_JUMP_SHARE = 0.05
"""Above this fraction of jumping frames, the warning suggests to check frame rate and unit."""

MAX_JITTER_SHARE = 0.1
"""Above this fraction of jittering frames, a recording gets a warning."""

# Tolerances of a T-pose held by an actor, who sways.
_ARM_ANGLE = np.deg2rad(25.0)
_SWAY = 0.10  # metres on the reference body
_REST_ANGLE = np.deg2rad(0.5)


def reference_pose(motion: Motion) -> tuple[int, int]:
    """Count the frames of T-pose or rest pose at the start and at the end of a motion.

    Exporters put the rest pose before a take, and actors hold a T-pose for calibration; neither is
    gesture. A frame is in rest pose if every joint except the root is within half a degree of it.
    It is in T-pose if both arms are straight out to the sides within 25° and every joint is within
    10 cm (on the reference body) of its position in the outermost frame. All frames between it and
    that end of the motion must qualify too. Without identified arms, only the rest pose counts.

    Returns:
        (frames at the start, frames at the end); both are all frames if all qualify.
    """
    positions = motion.positions()
    resting, arms_out = _in_rest_pose(motion), _arms_out(motion.skeleton, positions)
    positions = positions / body_scale(motion.skeleton)
    start = _leading(positions, resting, arms_out)
    return start, _leading(positions[::-1], resting[::-1], arms_out[::-1])


def first_difference(skeleton: Skeleton, usual: Skeleton) -> str | None:
    """Describe the first difference in joints or parents from the usual skeleton, or return None.

    Offsets may differ, as performers differ in size.
    """
    for i, (name, other) in enumerate(zip(skeleton.names, usual.names, strict=False)):
        if name != other:
            return f"joint {i} is {name!r} here and {other!r} in the others"
        parent, expected = skeleton.parents[i], usual.parents[i]
        if parent != expected:
            here = "the root" if parent < 0 else f"under {skeleton.names[parent]!r}"
            there = "the root" if expected < 0 else f"under {usual.names[expected]!r}"
            return f"joint {name!r} is {here} here and {there} in the others"
    if skeleton.n_joints != usual.n_joints:
        longer = max(skeleton.names, usual.names, key=len)
        both = f"{skeleton.n_joints} joints here and {usual.n_joints} in the others"
        first = longer[min(skeleton.n_joints, usual.n_joints)]
        return f"{both}; the first one more is {first!r}"
    return None


def usual_skeleton(skeletons: Sequence[Skeleton]) -> Skeleton:
    """Return the skeleton with the most common joints and parents; the first one of a tie."""
    counts = Counter((skeleton.names, skeleton.parents) for skeleton in skeletons)
    return max(skeletons, key=lambda skeleton: counts[skeleton.names, skeleton.parents])


def _in_rest_pose(motion: Motion) -> np.ndarray:
    """Return (T,) bool: every joint but the root is within half a degree of its rest rotation."""
    others = [j for j, parent in enumerate(motion.skeleton.parents) if parent >= 0]
    if not others:
        return np.zeros(motion.n_frames, dtype=bool)
    return rotation_angles(IDENTITY, motion.rotations[:, others]).max(axis=1) < _REST_ANGLE


def _arms_out(skeleton: Skeleton, positions: np.ndarray) -> np.ndarray:
    """Return (T,) bool: both arms are straight, level, and point away from each other.

    Positions are (T, J, 3).
    """
    parts = known_parts(skeleton)
    if parts is None:
        return np.zeros(len(positions), dtype=bool)
    upper, level, straight = {}, [], []
    for side, arm in parts.arms.items():
        names = [name for name in (arm.shoulder, arm.elbow, arm.wrist) if name is not None]
        steps = np.diff(positions[:, [skeleton.index(name) for name in names]], axis=1)
        bones = steps / np.maximum(np.linalg.norm(steps, axis=-1, keepdims=True), 1e-9)
        upper[side] = bones[:, 0]
        level.append((np.abs(bones[..., 1]) < np.sin(_ARM_ANGLE)).all(axis=1))
        # Without a wrist the upper arm is compared with itself.
        straight.append((bones[:, 0] * bones[:, -1]).sum(axis=-1) > np.cos(_ARM_ANGLE))
    opposite = -(upper["left"] * upper["right"]).sum(axis=-1) > np.cos(2 * _ARM_ANGLE)
    return np.all([*level, *straight, opposite], axis=0)


def _leading(positions: np.ndarray, resting: np.ndarray, arms_out: np.ndarray) -> int:
    """Count the reference poses from the first frame on.

    Positions (T, J, 3) are in metres of the reference body; `resting` and `arms_out` are (T,) bool.
    """
    if not (resting[0] or arms_out[0]):
        return 0
    near = np.linalg.norm(positions - positions[0], axis=-1).max(axis=1) < _SWAY
    pose = resting | (arms_out & near)
    return len(pose) if pose.all() else int(np.argmin(pose))
