"""Windows of poses, invariant to the position and heading of the body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gesturekit.errors import EvaluationError
from gesturekit.evaluation.metrics.frame_rate import at_rate
from gesturekit.motion import Motion
from gesturekit.motion.parts import body_joints, find_parts, heading_joints, upper_body
from gesturekit.motion.parts.body_size import body_scale
from gesturekit.motion.rotations import quaternion_from_rotation_vector, rotate_vectors

_SMALLEST_SCALE = 1e-3
"""Lower bound of the standard deviation of a coordinate, metres on the reference body."""
_SHORTEST_BONE = 1e-4  # metres on the reference body
LEAST_FRAMES = 12
"""Fewest frames from which the autoencoder of `feature_model` has any left."""
MOST_FRAMES = 1000


@dataclass(frozen=True)
class _Variant:
    directions: bool
    joints: str
    fps: float
    n_frames: int
    stride: int  # frames between the starts of two windows; 0 is half a window


_VARIANTS = {
    # Joint positions, as in GENEA 2022 (genea_numerical_evaluations; 14 joints of its own rig).
    "genea": _Variant(False, "body", 30.0, 60, 0),
    # Bone directions of the upper body, as in Yoon et al. 2020 (nine bones).
    "yoon": _Variant(True, "upper", 15.0, 34, 10),
}


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
        _require_variant(self.variant)
        if not LEAST_FRAMES <= self.n_frames <= MOST_FRAMES:
            raise EvaluationError(
                f"windows of {self.n_frames} frames; {LEAST_FRAMES} to {MOST_FRAMES} can be"
            )
        if not (1 <= self.fps <= 1000 and 1 <= self.stride <= MOST_FRAMES):
            raise EvaluationError(f"windows at {self.fps!r} fps, every {self.stride!r} frames")
        for name in ("mean", "scale"):
            values = np.asarray(getattr(self, name), dtype=np.float64)
            if values.shape != (self.n_features,) or not np.isfinite(values).all():
                raise EvaluationError(f"{name} of poses: expected {self.n_features} finite numbers")
            object.__setattr__(self, name, values)
        if (self.scale <= 0).any() or not self.bones:
            raise EvaluationError("poses need bones, and scales above 0")

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
        _require_variant(variant)
        if not motions:
            raise EvaluationError("there is no motion to learn poses from")
        form = _VARIANTS[variant]
        n_frames = form.n_frames if n_frames is None else n_frames
        bones = _bones(motions[0], form, form.joints if joints is None else joints)
        width = 3 * len(bones)
        stride = form.stride or max(1, n_frames // 2)
        plain = cls(variant, bones, form.fps, n_frames, stride, np.zeros(width), np.ones(width))
        frames = np.concatenate([plain.frames(motion) for motion in motions])
        scale = np.ones(width)
        if not form.directions:
            smallest = _SMALLEST_SCALE * body_scale(motions[0].skeleton)
            scale = np.maximum(frames.std(axis=0), smallest)
        return cls(variant, bones, form.fps, n_frames, stride, frames.mean(axis=0), scale)

    def frames(self, motion: Motion) -> np.ndarray:
        """Return (T', 3 B) normalised poses of a motion at `fps`.

        Raises:
            EvaluationError: the motion lacks a joint, or a bone without length needs a direction.
        """
        skeleton = motion.skeleton
        require_joints(motion, sorted({name for bone in self.bones for name in bone}))
        motion = at_rate(motion, self.fps)
        positions = motion.positions()
        ends = np.array([[skeleton.index(name) for name in bone] for bone in self.bones])
        bones = positions[:, ends[:, 1]] - positions[:, ends[:, 0]]
        bones = rotate_vectors(_to_front(motion, positions)[:, None], bones)
        if _VARIANTS[self.variant].directions:
            lengths = np.linalg.norm(bones, axis=-1, keepdims=True)
            shortest = _SHORTEST_BONE * body_scale(skeleton)
            if (lengths < shortest).any():
                bad = self.bones[int(np.argwhere(lengths < shortest)[0][1])]
                raise EvaluationError(
                    f"{motion_name(motion)}: {bad[0]!r} and {bad[1]!r} are at the same position; "
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
        return {
            "variant": self.variant,
            "bones": [list(bone) for bone in self.bones],
            "fps": self.fps,
            "n_frames": self.n_frames,
            "stride": self.stride,
        }


def require_joints(motion: Motion, joints: Sequence[str]) -> None:
    """Check that a motion has all of the joints.

    Raises:
        EvaluationError: a joint is missing.
    """
    missing = sorted(set(joints) - set(motion.skeleton.names))
    if missing:
        raise EvaluationError(
            f"{motion_name(motion)} has no joint {', '.join(missing[:5])}"
            f"{', ...' if len(missing) > 5 else ''}, which the other motions have; "
            "give motions of one rig, or retarget them to it"
        )


def motion_name(motion: Motion) -> str:
    """Return the name of a motion for errors: its file, or its description."""
    return str(motion.info.get("source") or motion)


def _require_variant(variant: str) -> None:
    if variant not in _VARIANTS:
        raise EvaluationError(f"variant {variant!r}; expected {' or '.join(_VARIANTS)}")


def _bones(
    motion: Motion, form: _Variant, joints: str | Sequence[str]
) -> tuple[tuple[str, str], ...]:
    skeleton = motion.skeleton
    pelvis = find_parts(skeleton).pelvis
    if isinstance(joints, str):
        if joints not in ("body", "upper"):
            raise EvaluationError(f"joints: {joints!r}; expected body, upper, or joint names")
        chosen = set(body_joints(skeleton))
        if joints == "upper":
            chosen &= set(upper_body(skeleton))
    else:
        chosen = {skeleton.names[skeleton.index(name)] for name in joints}
    # A root above the pelvis would give the position of the body.
    below = skeleton.descendants(skeleton.index(pelvis))
    chosen &= {skeleton.names[j] for j in below} - {pelvis}
    bones = []
    for name in skeleton.names:
        if name not in chosen:
            continue
        start = pelvis
        if form.directions:
            j = skeleton.index(name)
            above = [skeleton.names[i] for i in skeleton.ancestors(j)]
            start = next((a for a in above if a in chosen), pelvis)
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
