"""Windows of poses, invariant to the position and heading of the body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

import numpy as np

from gesturekit.errors import EvaluationError
from gesturekit.evaluation.metrics.inputs import at_rate, check_choice, check_joints, motion_name
from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.parts import body_joints, find_parts, heading_joints, upper_body
from gesturekit.motion.parts.body_size import body_scale
from gesturekit.motion.rotations import quaternion_from_rotation_vector, rotate_vectors

_SMALLEST_SCALE = 1e-3
"""Lower bound of the standard deviation of a coordinate, metres on the reference body."""
_SHORTEST_BONE = 1e-4  # metres on the reference body
LEAST_FRAMES = 12
"""Fewest frames from which the autoencoder of `feature_model` has any left."""
MOST_FRAMES = 1000


_DEFAULTS = {
    # Joint positions, as in GENEA 2022 (genea_numerical_evaluations; 14 joints of its own rig).
    "genea": ("body", 30.0, 60),
    # Bone directions of the upper body, as in Yoon et al. 2020 (nine bones).
    "yoon": ("upper", 15.0, 34),
}
"""Joints, frame rate and frames of a window by variant."""


@dataclass(frozen=True, eq=False)
class PoseWindows:
    """Cuts motions of a rig into windows of normalised poses.

    Each frame is relative to the pelvis and turned about the vertical so that the hips face +Z. The
    variant "genea" takes joint positions, each coordinate with its mean removed and divided by its
    standard deviation; "yoon" takes unit bone vectors with their mean removed.

    Attributes:
        variant: "genea" or "yoon".
        bones: (from, to) joint names; positions all start at the pelvis.
        fps: frame rate that motions are resampled to.
        n_frames: frames of a window.
        stride: frames between the starts of two windows.
        mean: (3 B,) mean of the reference's frames.
        scale: (3 B,) divisor of the poses.

    Examples:
        Windows of 60 frames every 30, of a motion of 150:

        >>> motion = gk.load("demo").generate(seconds=5)
        >>> (clip,) = PoseWindows.fit([motion], joints=["LeftHand", "RightHand"]).cut([motion])
        >>> clip.shape
        (4, 60, 6)
    """

    variant: str
    bones: tuple[tuple[str, str], ...]
    fps: float
    n_frames: int
    stride: int
    mean: np.ndarray
    scale: np.ndarray

    def __post_init__(self) -> None:
        check_choice("variant", self.variant, _DEFAULTS)
        for name in ("mean", "scale"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64))
        numbers = np.concatenate([self.mean.ravel(), self.scale.ravel()])
        if not (
            LEAST_FRAMES <= self.n_frames <= MOST_FRAMES
            and 1 <= self.fps <= 1000
            and 1 <= self.stride <= MOST_FRAMES
            and self.mean.shape == self.scale.shape == (self.n_features,) != (0,)
            and np.isfinite(numbers).all()
            and (self.scale > 0).all()
        ):
            raise EvaluationError(
                f"windows of {self.n_frames} frames at {self.fps} fps, every {self.stride}, of "
                f"{len(self.bones)} bones; expected {LEAST_FRAMES} to {MOST_FRAMES} frames, 1 to "
                "1000 fps, and 3 finite means and scales above 0 of each bone"
            )

    @property
    def n_features(self) -> int:
        """3 B, the dimension of a pose."""
        return 3 * len(self.bones)

    @classmethod
    def fit(
        cls,
        motions: Sequence[Motion],
        variant: str = "genea",
        *,
        n_frames: int | None = None,
        joints: str | Sequence[str] | None = None,
    ) -> PoseWindows:
        """Choose joints and compute means and scales from a reference set.

        Args:
            motions: motions of one rig (joints are found by name).
            variant: "genea" (60 frames at 30 fps, every 30) or "yoon" (34 at 15 fps, every 10).
            n_frames: length of a window; by default that of the variant. GENEA also has 30 and 90.
            joints: "body" (no fingers, face, end joints), "upper" (those of spine, head and arms),
                or names; only those below the pelvis count. By default "body" for "genea",
                "upper" for "yoon".

        Raises:
            EvaluationError: no motions, no such variant, or joints that one of them lacks.
        """
        check_choice("variant", variant, _DEFAULTS)
        if not motions:
            raise EvaluationError("there is no motion to learn poses from")
        of_variant, fps, usual = _DEFAULTS[variant]
        n_frames = usual if n_frames is None else n_frames
        bones = _bones(motions[0].skeleton, variant, of_variant if joints is None else joints)
        stride = 10 if variant == "yoon" else max(1, n_frames // 2)
        width = 3 * len(bones)
        plain = cls(variant, bones, fps, n_frames, stride, np.zeros(width), np.ones(width))
        frames = np.concatenate([plain.frames(motion) for motion in motions])
        scale = plain.scale
        if variant == "genea":
            smallest = _SMALLEST_SCALE * body_scale(motions[0].skeleton)
            scale = np.maximum(frames.std(axis=0), smallest)
        return replace(plain, mean=frames.mean(axis=0), scale=scale)

    def frames(self, motion: Motion) -> np.ndarray:
        """Return (T', 3 B) normalised poses of a motion at `fps`.

        Raises:
            EvaluationError: the motion lacks a joint, or a bone without length needs a direction.
        """
        skeleton = motion.skeleton
        check_joints(motion, chain.from_iterable(self.bones))
        motion = at_rate(motion, self.fps)
        positions = motion.positions()
        starts, ends = ([skeleton.index(name) for name in side] for side in zip(*self.bones))
        bones = positions[:, ends] - positions[:, starts]
        bones = rotate_vectors(_to_front(motion, positions)[:, None], bones)
        if self.variant == "yoon":
            lengths = np.linalg.norm(bones, axis=-1, keepdims=True)
            if len(short := np.argwhere(lengths < _SHORTEST_BONE * body_scale(skeleton))):
                start, end = self.bones[short[0, 1]]
                raise EvaluationError(
                    f"{motion_name(motion)}: {start!r} and {end!r} are at the same position; "
                    "the direction between them is undefined"
                )
            bones = bones / lengths
        return (bones.reshape(len(bones), -1) - self.mean) / self.scale

    def cut(self, motions: Sequence[Motion]) -> list[np.ndarray]:
        """Return (W_i, n_frames, 3 B) windows of each motion; skip motions shorter than a window.

        Raises:
            EvaluationError: see `frames`; or no motion is as long as a window.
        """
        clips = []
        for motion in motions:
            frames = self.frames(motion)
            if len(frames) >= self.n_frames:
                windows = np.lib.stride_tricks.sliding_window_view(frames, self.n_frames, axis=0)
                clips.append(windows[:: self.stride].transpose(0, 2, 1))
        if not clips:
            raise EvaluationError(
                f"none of {len(motions)} motions is as long as a window of "
                f"{self.n_frames / self.fps:.3g} s ({self.n_frames} frames at {self.fps:g} fps)"
            )
        return clips

    def to_json(self) -> dict[str, Any]:
        """Return everything except mean and scale as plain values."""
        plain = {**vars(self), "bones": [list(bone) for bone in self.bones]}
        return {name: plain[name] for name in plain if name not in ("mean", "scale")}


def _bones(
    skeleton: Skeleton, variant: str, joints: str | Sequence[str]
) -> tuple[tuple[str, str], ...]:
    """Return (from, to) names of bones that end at the chosen joints below the pelvis."""
    pelvis = find_parts(skeleton).pelvis
    if isinstance(joints, str):
        check_choice("joints (a list of names, or a word):", joints, ("body", "upper"))
        chosen = set(body_joints(skeleton))
        if joints == "upper":
            chosen &= set(upper_body(skeleton))
    else:
        chosen = {skeleton.names[skeleton.index(name)] for name in joints}
    bones = []
    # A root above the pelvis would give the position of the body.
    for j in skeleton.descendants(skeleton.index(pelvis)):
        name, start = skeleton.names[j], pelvis
        if name not in chosen:
            continue
        if variant == "yoon":
            above = (skeleton.names[i] for i in skeleton.ancestors(j))
            start = next(a for a in above if a in chosen or a == pelvis)
            if np.linalg.norm(skeleton.offsets[j]) < _SHORTEST_BONE * body_scale(skeleton):
                continue  # a joint on top of its parent has no direction
        bones.append((start, name))
    return tuple(bones)


def _to_front(motion: Motion, positions: np.ndarray) -> np.ndarray:
    """Return (T, 4) turns about the vertical that put the left hip at +X of the right one.

    Shoulders stand in for the hips of a rig without legs. Raises EvaluationError without either.
    """
    names = heading_joints(motion.skeleton)
    if names is None:
        raise EvaluationError(f"{motion_name(motion)}: no hips or shoulders are found in the rig")
    left, right = map(motion.skeleton.index, names)
    across = positions[:, left] - positions[:, right]
    turn = np.zeros((len(across), 3))
    turn[:, 1] = np.arctan2(across[:, 2], across[:, 0])
    return quaternion_from_rotation_vector(turn)
