"""Heading of a body, its root path on the ground, and motion that follows a path."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.ik import reach_feet
from gesturekit.motion.model_joints import first_moving_joint
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import ankle_joints, heading_joints
from gesturekit.motion.resampling import checked_fps
from gesturekit.motion.rotations import invert_quaternions, rotate_vectors
from gesturekit.motion.skeleton import GROUND, checked

_TOO_STEEP = 0.05
"""Horizontal share of the side axis below which it gives no heading."""


def heading(motion: Motion) -> float:
    """Return the mean direction the body faces, radians about Y; 0 is +Z, positive towards +X.

    A body that faces +Z has its left hip at +X of its right one. Shoulders count where there are
    no legs; a rig without either faces +Z.
    """
    across = _across(motion)
    if across is None:
        return 0.0
    across = across.mean(axis=0)
    return float(np.arctan2(-across[2], across[0]))


def side_axis(motions: Sequence[Motion], root: int) -> np.ndarray:
    """(3,) unit vector towards the body's left in the frame of joint `root`.

    It is the mean direction from the right hip to the left one in that frame, or between the
    shoulders of a rig without legs. A rig without either is assumed to face the joint's
    +Z; if that points up or down, the most horizontal axis is the side.

    Args:
        motions: motions of one rig.
        root: index of the joint that turns with the body.
    """
    # Copies, because a view would keep the rotations of all joints in memory.
    world = np.concatenate([motion.global_rotations()[:, root].copy() for motion in motions])
    hips = [vectors for motion in motions if (vectors := _across(motion)) is not None]
    if len(hips) < len(motions):
        flat = [np.hypot(*rotate_vectors(world, axis)[:, GROUND].T).mean() for axis in np.eye(3)]
        # If z points forward, the side is x.
        return np.eye(3)[0 if flat[2] > 0.5 and flat[0] > 0.5 else int(np.argmax(flat))]
    side = rotate_vectors(invert_quaternions(world), np.concatenate(hips)).mean(axis=0)
    length = np.linalg.norm(side)
    return side / length if length > 1e-9 else np.eye(3)[0]


def headings(world: np.ndarray, side: np.ndarray) -> np.ndarray:
    """(T,) direction the body faces in each frame, radians about Y, unwrapped.

    Forward is perpendicular to the side axis and to the world's Y. Frames whose side axis points
    up or down (the body lies on one side) are interpolated linearly.

    Args:
        world: (T, 4) world rotations of the root.
        side: (3,) from `side_axis`.
    """
    return headings_of_sides(rotate_vectors(world, side))


def headings_of_sides(across: np.ndarray) -> np.ndarray:
    """(T,) direction the body faces in each frame, radians about Y, unwrapped; see `headings`.

    Args:
        across: (T, 3) world vectors towards the body's left, of any length.
    """
    level, length = np.hypot(across[:, 0], across[:, 2]), np.linalg.norm(across, axis=1)
    defined = np.flatnonzero(level > _TOO_STEEP * length)
    if not len(defined):
        return np.zeros(len(across))
    angles = np.unwrap(np.arctan2(-across[defined, 2], across[defined, 0]))
    return np.interp(np.arange(len(across)), defined, angles)


def _across(motion: Motion) -> np.ndarray | None:
    """(T, 3) world vectors from the right of `heading_joints` to the left one, metres; or None."""
    joints = heading_joints(motion.skeleton)
    if joints is None:
        return None
    positions = motion.positions()
    left, right = (motion.skeleton.index(name) for name in joints)
    return positions[:, left] - positions[:, right]


STANDING = 0.05
"""m/s of the reference body; a slower path has no direction of travel."""
SMOOTHED_SECONDS = 1 / 3
"""Smoothing window: 10 frames at 30 fps (section 4.1 of Alexanderson et al. 2023)."""
_MOST_FRAMES = 50_000_000  # over two weeks at 30 fps


@dataclass(frozen=True, eq=False)
class RootPath:
    """Positions on the ground and headings; frame k is at k / fps seconds.

    Attributes:
        positions: (T, 2) float64, x and z in metres.
        headings: (T,) float64 radians about Y: 0 faces +Z, positive towards +X. They are unwrapped
            (a circle walked twice ends at 4 pi).
        fps: frames per second.

    Raises:
        MotionError: shapes that do not match, values that are not finite, or no frames.
    """

    positions: np.ndarray
    headings: np.ndarray
    fps: float

    def __post_init__(self) -> None:
        positions = np.array(self.positions, dtype=np.float64)
        angles = np.array(self.headings, dtype=np.float64)
        positions = checked("the path's position", positions, (None, 2), "frame")
        angles = checked("the path's heading", angles, (len(positions),), "frame")
        if not len(positions):
            raise MotionError(f"the path's positions have shape {positions.shape}: no frame")
        object.__setattr__(self, "positions", positions)
        object.__setattr__(self, "headings", np.unwrap(angles))
        object.__setattr__(self, "fps", checked_fps(self.fps))

    @classmethod
    def of(
        cls, motion: Motion, root: int | None = None, side: np.ndarray | None = None
    ) -> RootPath:
        """Return the path of a motion's root, with the heading of the hips.

        Args:
            motion: any rig.
            root: index of the joint to follow; by default the first one that moves.
            side: (3,) direction to the body's left in the frame of that joint; by default from
                `gesturekit.motion.root_path.side_axis`.
        """
        root = first_moving_joint([motion]) if root is None else root
        side = side_axis([motion], root) if side is None else side
        positions = motion.positions()[:, root][:, GROUND]
        return cls(positions, headings(motion.global_rotations()[:, root], side), motion.fps)

    @classmethod
    def looking_ahead(cls, positions: np.ndarray, fps: float, scale: float = 1.0) -> RootPath:
        """Return a path that faces its direction of travel, interpolated while it stands.

        Args:
            positions: (T, 2) x and z, metres.
            fps: frames per second.
            scale: `body_scale` of the body that follows it, to scale the speed of standing.
        """
        positions = np.asarray(positions, dtype=np.float64)
        step = np.gradient(positions, axis=0) * fps if len(positions) > 1 else 0 * positions
        goes = np.flatnonzero(np.hypot(*step.T) > STANDING * scale)
        if not len(goes):
            return cls(positions, np.zeros(len(positions)), fps)
        angles = np.unwrap(np.arctan2(step[goes, 0], step[goes, 1]))
        return cls(positions, np.interp(np.arange(len(positions)), goes, angles), fps)

    @classmethod
    def from_deltas(
        cls,
        deltas: np.ndarray,
        fps: float,
        start: tuple[float, float, float] = (0.0, 0.0, 0.0),
        *,
        turn_first: bool = False,
    ) -> RootPath:
        """Integrate `deltas` to a path.

        Args:
            deltas: (T, 3) turn, forward, lateral per frame; frame 0 is ignored.
            fps: frames per second.
            start: x and z in metres and heading in radians of frame 0.
            turn_first: see `deltas`.
        """
        turn, forward, lateral = np.array(deltas, dtype=np.float64)[1:].T
        x, z, heading = start
        angles = heading + np.concatenate([[0.0], np.cumsum(turn)])
        along = angles[1:] if turn_first else angles[1:] - turn / 2
        sine, cosine = np.sin(along), np.cos(along)
        step = np.stack(
            [forward * sine + lateral * cosine, forward * cosine - lateral * sine], axis=1
        )
        return cls(np.concatenate([[[x, z]], step]).cumsum(axis=0), angles, fps)

    @property
    def n_frames(self) -> int:
        """Number of frames T."""
        return len(self.positions)

    def frames_within(self, fps: float) -> int:
        """Return the number of frames at `fps` from the path's first to its last, both included.

        Positions one second apart from 0 to 10 s make a path of 10 s, not of 11.
        """
        last = (self.n_frames - 1) * Fraction(checked_fps(fps)) / Fraction(self.fps)
        # Rates such as 29.97 are rounded, so allow for a thousandth of a frame.
        return math.floor(last + Fraction(1, 1000)) + 1

    @property
    def speeds(self) -> np.ndarray:
        """(T,) speed over the ground from each frame to the next, m/s; the last is repeated."""
        if self.n_frames < 2:
            return np.zeros(self.n_frames)
        steps = np.linalg.norm(np.diff(self.positions, axis=0), axis=1) * self.fps
        return np.append(steps, steps[-1])

    def deltas(self, *, turn_first: bool = False) -> np.ndarray:
        """(T, 3) turn (radians), forward and lateral (metres, left is positive), each per frame.

        Entry k is the step from frame k - 1 to frame k, relative to the heading halfway between
        them, so that a step along a circle has no lateral component, or with `turn_first` to that
        of frame k. Entry 0 repeats entry 1; a single frame has zeros.
        """
        if self.n_frames < 2:
            return np.zeros((self.n_frames, 3))
        turn = np.diff(self.headings)
        along = self.headings[1:] if turn_first else self.headings[1:] - turn / 2
        dx, dz = np.diff(self.positions, axis=0).T
        sine, cosine = np.sin(along), np.cos(along)
        steps = np.stack([turn, dx * sine + dz * cosine, dx * cosine - dz * sine], axis=1)
        return np.concatenate([steps[:1], steps])

    def resample(self, fps: float, n_frames: int | None = None, *, start: float = 0.0) -> RootPath:
        """Return the path at another rate, linearly interpolated and constant beyond its ends.

        Args:
            fps: frames per second of the result.
            n_frames: number of frames; by default floor((duration - start) fps + 1/2).
            start: seconds at which the result begins; need not fall on a frame.

        Raises:
            MotionError: an invalid rate or number of frames.
        """
        fps = checked_fps(fps)
        if n_frames is None:
            exact = (self.n_frames / Fraction(self.fps) - Fraction(start)) * Fraction(fps)
            n_frames = max(1, math.floor(exact + Fraction(1, 2)))
        if not 1 <= n_frames <= _MOST_FRAMES:
            raise MotionError(f"{n_frames} frames of a path; expected 1 to {_MOST_FRAMES}")
        place = (start + np.arange(n_frames) / fps) * self.fps
        frames = np.arange(self.n_frames)
        x, z, angle = (
            np.interp(place, frames, values) for values in (*self.positions.T, self.headings)
        )
        return RootPath(np.stack([x, z], axis=1), angle, fps)

    def smoothed(self) -> RootPath:
        """Return the centred moving average over `SMOOTHED_SECONDS`.

        Both ends are padded by point reflection: they keep their positions, and a straight walk
        does not change.
        """
        frames = max(1, round(SMOOTHED_SECONDS * self.fps))
        # An even window has no central frame, so its two ends get half the weight.
        half = frames // 2
        weights = np.ones(2 * half + 1)
        if frames % 2 == 0:
            weights[[0, -1]] = 0.5
        weights /= weights.sum()
        if self.n_frames == 1:
            return self
        columns = np.column_stack([self.positions, self.headings])
        wide = np.pad(columns, [(half, half), (0, 0)], mode="reflect", reflect_type="odd")
        x, z, angle = (np.convolve(values, weights, mode="valid") for values in wide.T)
        return replace(self, positions=np.stack([x, z], axis=1), headings=angle)

    def scaled(self, factor: float) -> RootPath:
        """Return the path with its positions multiplied by `factor`."""
        return replace(self, positions=self.positions * factor)

    def mirror(self) -> RootPath:
        """Return the path with x reflected, as `Motion.mirror` does."""
        return replace(self, positions=self.positions * [-1.0, 1.0], headings=-self.headings)


def follow_path(motion: Motion, path: RootPath, root: int | None = None) -> Motion:
    """Move the root onto a nearby path; feet keep their positions and orientations.

    The root keeps its rotations. A foot that is out of reach moves by as much as its leg is short.

    Args:
        motion: T frames.
        path: T frames at the motion's rate, such as its own `RootPath.smoothed`.
        root: index of the joint to move; by default the first one that moves.

    Raises:
        MotionError: a path of another length or rate.
    """
    if (path.n_frames, path.fps) != (motion.n_frames, motion.fps):
        here = f"{path.n_frames} frames at {path.fps:g} fps"
        raise MotionError(f"the path has {here}; the motion {motion.n_frames} at {motion.fps:g}")
    root = first_moving_joint([motion]) if root is None else root
    positions, world = motion.positions(), motion.global_rotations()
    shift = np.zeros((motion.n_frames, 3))
    shift[:, GROUND] = path.positions - positions[:, root][:, GROUND]
    moved = motion.with_joint_at(root, positions[:, root] + shift)
    ankles = ankle_joints(motion.skeleton)
    return reach_feet(moved, positions[:, ankles], world[:, ankles]) if ankles else moved
