"""Placement of a generated motion: first and last pose, heading, and standing in place.

- In place: the stance is the rigid place and heading of both feet on the ground. What it does
  slowly is wandering, and is removed; what the body does above it is a weight shift, and stays.
- A pose is put onto the body, and the motion onto the feet of the pose. The difference between them
  decays (`gesturekit.motion.concatenation.eased`).
- Feet do not slide from the pose's stance to the motion's: a foot that is near stays where the pose
  has it until the motion itself moves it; any other foot makes a step, one after the other.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter1d

from gesturekit.motion.concatenation import carried, eased
from gesturekit.motion.contacts import CONTACT_SPEED, floor_height, foot_positions
from gesturekit.motion.ik import reach_feet
from gesturekit.motion.model_joints import first_moving_joint
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import ankle_joints, leg_length
from gesturekit.motion.parts.body_size import body_scale
from gesturekit.motion.resampling import smoothstep
from gesturekit.motion.root_path import heading, headings, side_axis
from gesturekit.motion.rotations import (
    invert_quaternions,
    multiply_quaternions,
    quaternion_from_rotation_vector,
    rotation_vector_from_quaternion,
)
from gesturekit.motion.skeleton import GROUND
from gesturekit.postprocess.foot_lock import lock_feet

BLEND_SECONDS = 0.5
"""Seconds from a pose to the motion; a second foot steps as long after the first."""
_SLOW_SECONDS = 0.5
"""Standard deviation of the Gaussian that separates wandering from single steps."""
_TWIST = np.radians(15)
"""Largest angle between pelvis and feet by which the stance decides the heading."""
_NEAR = 0.1
"""Share of the leg length; a foot farther from its place steps at once, as in foot locking."""
_FOOT = 0.2
"""Length of a foot of the reference body, metres; its turning counts as movement of the toes."""
_LIFT = 0.03
"""Metres on the reference body that a long step is lifted, beside a tenth of its length."""

Read = Callable[[int], tuple[Motion, int]]


@dataclass(frozen=True, eq=False, kw_only=True)
class Placement:
    """Poses in which a motion begins and ends, its heading, and whether it stays in place.

    Attributes:
        start: one frame on the motion's rig, in which it begins; its bones may be another
            performer's. `info["floor"]` is the height of its floor in metres, if that may be
            another than the motion's.
        end: the same for the last frame; its place and heading do not count.
        facing: heading of the first frame, radians; None for that of `start`, or as generated.
        in_place: whether to remove wandering.
        on_path: whether the motion stays on its path, and `start` is put there.
        foot_lock: whether planted feet are locked.
    """

    start: Motion | None = None
    end: Motion | None = None
    facing: float | None = None
    in_place: bool = False
    on_path: bool = False
    foot_lock: bool = True

    @classmethod
    def of(
        cls, controls: Mapping[str, Any], read_pose: Callable[[Read, int], Motion], *, on_path: bool
    ) -> Placement:
        """Return what the controls of `generate` ask for.

        Args:
            controls: any system's.
            read_pose: function that puts a pose on the model's rig; it gets `PoseSource.read` and
                the index of the frame to take without seconds.
            on_path: see the class.
        """
        start, end, facing = (controls[key] for key in ("start_pose", "end_pose", "facing"))
        return cls(
            start=None if start is None else read_pose(start.read, 0),
            end=None if end is None else read_pose(end.read, -1),
            facing=None if facing is None else np.radians(facing),
            in_place=controls["in_place"],
            on_path=on_path,
            foot_lock=controls["foot_lock"],
        )

    def applied(self, motion: Motion) -> Motion:
        """Return the finished motion, placed; the same object if nothing is asked for."""
        if not (self.in_place or self.start or self.end) and self.facing is None:
            return motion
        root = first_moving_joint([motion])
        if self.in_place:
            motion = _in_place(motion, root)
            motion = lock_feet(motion, keep_path=True) if self.foot_lock else motion
        start, end = (
            None if pose is None else _on_body(pose, motion, root)
            for pose in (self.start, self.end)
        )
        # Two steps at either end fit into the motion.
        count = max(1, min(round(BLEND_SECONDS * motion.fps), motion.n_frames // 4))
        if start is None and self.facing is not None:
            motion = _facing(motion, root, self.facing)
        if start is not None and self.on_path:
            motion = _begun(motion, _onto(start, motion[:1], root), count, True)
        elif start is not None:
            start = start if self.facing is None else _facing(start, root, self.facing)
            motion = _begun(_onto(motion, start, root), start, count, True)
        if end is not None:
            end = _onto(end, motion[-1:], root)
            motion = _reversed(_begun(_reversed(motion), end, count, start is None))
        return motion


def _in_place(motion: Motion, root: int) -> Motion:
    """Return the motion without the slow part of its stance's path and turning."""
    world = motion.global_rotations()
    if ankles := ankle_joints(motion.skeleton):
        angle = np.unwrap(_turn_between(world[:1, ankles], world[:, ankles]))
    else:
        angle = headings(world[:, root], side_axis([motion], root))
    path = np.column_stack([_stance(motion, root), angle])
    slow = gaussian_filter1d(path, _SLOW_SECONDS * motion.fps, axis=0, mode="nearest")
    return carried(motion, root, slow[0, 2] - slow[:, 2], slow[:, :2], slow[0, :2])


def _stance(motion: Motion, root: int) -> np.ndarray:
    """(T, 2) middle of the feet on the ground, or place of the root without legs, metres."""
    feet = foot_positions(motion)
    points = feet if feet.shape[1] else motion.positions()[:, [root]]
    return points[..., GROUND].mean(axis=1)


def _turn_between(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """(T,) mean radians about Y from rotations `before` (T, 2, 4) of both feet to `after`."""
    turn = multiply_quaternions(after, invert_quaternions(before))
    angles = 2 * np.arctan2(turn[..., 1], turn[..., 3])
    return np.arctan2(np.sin(angles).sum(axis=1), np.cos(angles).sum(axis=1))


def _on_body(pose: Motion, motion: Motion, root: int) -> Motion:
    """Return a pose (one frame) on the body of a motion, at its own place."""
    still = motion.skeleton.ancestors(root)
    rotations, place = pose.rotations.copy(), pose.positions()[:, root]
    rotations[:, list(still)] = motion.rotations[:1, list(still)]
    floor = pose.info.get("floor", 0.0)
    place[:, 1] = (place[:, 1] - floor) * body_scale(motion.skeleton) / body_scale(pose.skeleton)
    place[:, 1] += floor_height(motion) if "floor" in pose.info else 0.0
    made = replace(motion[:1], rotations=rotations)
    return made.with_joint_at(root, place, pose.global_rotations()[:, root])


def _facing(motion: Motion, root: int, angle: float) -> Motion:
    """Return the motion turned where it begins, so that its first frame has this heading."""
    place = motion[:1].positions()[0, root, GROUND]
    return carried(motion, root, angle - heading(motion[:1]), place, place)


def _onto(motion: Motion, pose: Motion, root: int) -> Motion:
    """Return the motion carried to where its first frame stands on the feet of a pose."""
    first = motion[:1]
    angle = heading(pose) - heading(first)
    if ankles := ankle_joints(motion.skeleton):
        turn = _turn_between(*(one.global_rotations()[:, ankles] for one in (first, pose)))[0]
        # The pelvis may be twisted on feet that stand alike, but a foot in the air is no stance.
        twist = (turn - angle + np.pi) % (2 * np.pi) - np.pi
        angle += np.clip(twist, -_TWIST, _TWIST)
    return carried(motion, root, angle, _stance(first, root)[0], _stance(pose, root)[0])


def _begun(motion: Motion, pose: Motion, count: int, may_stay: bool) -> Motion:
    """Return the motion from a pose that decays within `count` frames, with feet that step.

    Args:
        motion: T frames, in place.
        pose: one frame on its body.
        count: frames.
        may_stay: whether feet that the motion does not move may stay as in the pose to its end.
    """
    made, ankles = eased(pose, motion, count), ankle_joints(motion.skeleton)
    if not ankles:
        return made
    places, turns = motion.positions()[:, ankles], motion.global_rotations()[:, ankles]
    apart = pose.positions()[0, ankles] - places[0]
    turned = rotation_vector_from_quaternion(
        multiply_quaternions(pose.global_rotations()[0, ankles], invert_quaternions(turns[0]))
    )
    scale = body_scale(motion.skeleton)
    length = np.linalg.norm(apart[:, GROUND], axis=1)
    far = length + _FOOT * scale * np.abs(turned[:, 1])
    speed = np.linalg.norm(np.diff(places, axis=0), axis=2) * motion.fps
    # A raised foot steps first, then the one that is farther away.
    first = int(np.argmax(far + 10 * np.abs(apart[:, 1])))
    weights, now = np.empty((motion.n_frames, 2, 3)), 0
    weights[..., 1] = _released(motion.n_frames, 0, count)[:, None]
    for foot in (first, 1 - first):
        moves = np.flatnonzero(speed[:, foot] > CONTACT_SPEED * scale)
        begin, lift = int(moves[0]) if len(moves) else motion.n_frames, 0.0
        is_near = far[foot] <= _NEAR * leg_length(motion.skeleton)
        if not is_near or not (may_stay or begin + count < motion.n_frames):
            begin, now = now, now + count
            lift = min(length[foot], _LIFT * scale + 0.1 * length[foot])
        rising = _released(motion.n_frames, begin, count)
        places[:, foot, 1] += 4 * lift * rising * (1 - rising)
        # A foot hardly moves forward before it is lifted.
        weights[:, foot, 0] = weights[:, foot, 2] = smoothstep(rising)
    # A foot turns as it moves over the ground; its tilt goes with its height.
    turn = quaternion_from_rotation_vector(weights[..., [1, 0, 1]] * turned)
    return reach_feet(made, places + weights * apart, multiply_quaternions(turn, turns))


def _released(n_frames: int, begin: int, count: int) -> np.ndarray:
    """(T,) weights: 1 up to frame `begin`, falling smoothly to 0 within `count` frames."""
    s = np.clip((np.arange(n_frames) - begin) / count, 0, 1)
    return 1 - smoothstep(s)


def _reversed(motion: Motion) -> Motion:
    """Return the motion with its joints backwards in time."""
    return replace(
        motion,
        rotations=motion.rotations[::-1],
        translation=motion.translation[::-1],
        joint_translations={k: v[::-1] for k, v in motion.joint_translations.items()},
    )
