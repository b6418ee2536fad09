"""Motions one after another, without seams."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.face import joined_faces
from gesturekit.motion.model_joints import first_moving_joint
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts.body_size import body_scale
from gesturekit.motion.root_path import heading
from gesturekit.motion.rotations import (
    invert_quaternions,
    multiply_quaternions,
    quaternion_from_rotation_vector,
    rotate_vectors,
    rotation_vector_from_quaternion,
)
from gesturekit.motion.skeleton import GROUND

_SAME_OFFSET = 1e-3
"""Metres on the reference body; files round offsets."""
_REMEDY = "retarget it first: gesturekit convert --rig, or gesturekit.motion.retarget.retarget"


def concatenate(motions: Sequence[Motion], blend: float = 0.3) -> Motion:
    """Return motions of one rig one after another; no frame is left out.

    Each motion is turned about Y and moved on the ground to begin where the previous one ends,
    with the same heading. It begins with the pose and the speed with which the previous one ends;
    the difference from its own decays within `blend` seconds (a cubic Hermite curve of the
    rotation vectors; inertialisation, Bollo 2018). All motions get the frame rate of the first.

    Args:
        motions: of rigs with the same joints and bone lengths.
        blend: seconds; 0 places the motions, and leaves poses as they are.

    Raises:
        MotionError: no list of motions, rigs that differ, or an invalid `blend`.

    Examples:
        >>> rig = gk.Skeleton(("hips",), (-1,), [[0, 1, 0]])
        >>> walk = gk.Motion(rig, [[[0, 0, 0, 1]]] * 3, [[0, 1, 0], [0, 1, 1], [0, 1, 2]], 30)
        >>> gk.concatenate([walk, walk]).translation[:, 2].tolist()
        [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    """
    if isinstance(motions, Motion):
        raise MotionError("give the motions as a list: concatenate([a, b])")
    if not motions:
        raise MotionError("no motions to concatenate")
    if not 0 <= blend < math.inf:
        raise MotionError(f"blend is {blend!r}; expected seconds, 0 or more")
    first = motions[0]
    pieces = [first]
    for number, motion in enumerate(motions[1:], start=2):
        _check_rig(first, motion, number)
        motion = motion if motion.fps == first.fps else motion.resample(first.fps)
        pieces.append(_continued(pieces[-1], motion, blend))
    return stacked(pieces)


def stacked(pieces: Sequence[Motion]) -> Motion:
    """Return the frames of motions of one rig and frame rate, at least one, as they are."""
    first = pieces[0]
    moving = {name for piece in pieces for name in piece.joint_translations}
    return replace(
        first,
        rotations=np.concatenate([piece.rotations for piece in pieces]),
        translation=np.concatenate([piece.translation for piece in pieces]),
        joint_translations={
            name: np.concatenate([piece.local_positions(name) for piece in pieces])
            for name in moving
        },
        face=joined_faces([piece.face for piece in pieces]),
        info=dict(first.info),
    )


def _check_rig(first: Motion, motion: Motion, number: int) -> None:
    """Raise MotionError if motion `number` is of another rig than the first one."""
    rig, other = first.skeleton, motion.skeleton
    if (rig.names, rig.parents) != (other.names, other.parents):
        strange = [
            n for n in (*rig.names, *other.names) if n not in rig.names or n not in other.names
        ]
        what = f"{strange[0]!r} is a joint of one only" if strange else "their parents differ"
        joints = f"{other.n_joints} and {rig.n_joints} joints, {what}"
        raise MotionError(f"motion {number} has another rig than the first ({joints}); {_REMEDY}")
    apart = np.abs(rig.offsets - other.offsets).max(axis=1)
    apart[0] = 0.0  # replaced by the translation
    worst = int(apart.argmax())
    if apart[worst] > _SAME_OFFSET * body_scale(rig):
        differs = f"the offset of {rig.names[worst]!r} differs by {apart[worst]:.3g} m"
        raise MotionError(f"motion {number} has other bones than the first: {differs}; {_REMEDY}")


def _continued(before: Motion, after: Motion, blend: float) -> Motion:
    """Return `after` from the place, heading, pose and speed with which `before` ends."""
    last = before[-2:]
    after = _placed_behind(last, after)
    count = min(round(blend * after.fps), after.n_frames)
    return eased(last, after, count) if count >= 1 else after


def eased(last: Motion, after: Motion, count: int) -> Motion:
    """Return `after` with the difference from the end of `last` decaying over its first frames.

    Args:
        last: of the same rig; its last two frames give pose and speed, a single one the pose.
        after: T frames, already in place.
        count: frames over which the difference decays, 1 to T.
    """
    s = np.arange(count)[:, None] / count
    # Cubic Hermite curves that end at 0 without speed, from a value and from a speed.
    from_value, from_speed = 1 - 3 * s**2 + 2 * s**3, count * (s - 2 * s**2 + s**3)

    def decayed(ended: np.ndarray, values: np.ndarray) -> np.ndarray:
        speed = ended[-1] - ended[0]
        lost = speed - (values[min(1, len(values) - 1)] - values[0])
        values = values.copy()
        values[:count] += from_value * (ended[-1] + speed - values[0]) + from_speed * lost
        return values

    names = {*last.joint_translations, *after.joint_translations}
    rotations = after.rotations.copy()
    speed, own_turn = (_turn(q[0], q[min(1, len(q) - 1)]) for q in (last.rotations[-2:], rotations))
    start = multiply_quaternions(quaternion_from_rotation_vector(speed), last.rotations[-1])
    offset = _turn(rotations[0], start)
    carried = rotate_vectors(quaternion_from_rotation_vector(offset), own_turn)
    s = s[..., None]
    turns = from_value[..., None] * offset + from_speed[..., None] * (speed - carried)
    rotations[:count] = multiply_quaternions(
        quaternion_from_rotation_vector(turns), rotations[:count]
    )
    return replace(
        after,
        rotations=rotations,
        translation=decayed(last.translation, after.translation),
        joint_translations={
            name: decayed(last.local_positions(name), after.local_positions(name)) for name in names
        },
    )


def _placed_behind(last: Motion, after: Motion) -> Motion:
    """Turn `after` about Y and move it on the ground to go on from the end of `last`."""
    root = first_moving_joint([last, after])
    angle = heading(last[-1:]) - heading(after[:1])
    ended, begins = last.positions()[:, root], after[:1].positions()[0, root]
    move = 2 * ended[-1] - ended[0]  # a step on, which a single frame does not have
    return carried(after, root, angle, begins[GROUND], move[GROUND])


def carried(
    motion: Motion, root: int, angle: float | np.ndarray, pivot: np.ndarray, goal: np.ndarray
) -> Motion:
    """Turn a motion about the vertical through `pivot`, and move that point to `goal`.

    Joints above the root stay as they are.

    Args:
        motion: T frames.
        root: index of the joint that carries the body.
        angle: radians about Y, or (T,).
        pivot: (2,) or (T, 2) x and z, metres.
        goal: (2,) or (T, 2) x and z, metres.
    """
    turns = np.zeros((motion.n_frames, 3))
    turns[:, 1] = angle
    turn = quaternion_from_rotation_vector(turns)
    place = motion.positions()[:, root]
    place[:, GROUND] -= pivot
    place = rotate_vectors(turn, place)
    place[:, GROUND] += goal
    world = multiply_quaternions(turn, motion.global_rotations()[:, root])
    return motion.with_joint_at(root, place, world)


def _turn(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """(J, 3) rotation vectors from quaternions `before` to `after`, in the parents' frames."""
    return rotation_vector_from_quaternion(multiply_quaternions(after, invert_quaternions(before)))
