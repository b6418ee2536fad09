"""Analytic two-bone inverse kinematics (law of cosines), vectorised over frames.

- If the end is already at its target, the rotations do not change.
- The middle joint keeps its bending direction. A straight limb has none; it bends along the pole.
- There is no pop at full extension: a target beyond reach is approached asymptotically, from a
  little before the limb is straight (the "soft" limit of animation rigs).

`reach_feet` bends both legs in this way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import require_legs
from gesturekit.motion.rotations import (
    invert_quaternions,
    multiply_quaternions,
    quaternion_from_matrix,
    rotate_vectors,
    shortest_arc,
)
from gesturekit.motion.skeleton import Skeleton, global_rotations

SOFTNESS = 0.03
"""Last share of the limb's length over which its extension is compressed."""
STRETCH = 0.995
"""Legs are not stretched beyond this share of their length, unless they were before."""
HIP_DROP_SECONDS = 0.2
"""Seconds before and after a foot out of reach over which the hips move down and up again."""
_TINY = 1e-9


def two_bone_ik(
    joints: np.ndarray,
    target: np.ndarray,
    rotations: np.ndarray,
    above: np.ndarray,
    *,
    pole: np.ndarray | None = None,
    hinge: bool = False,
) -> np.ndarray:
    """Rotate a limb of two bones so that its end reaches a target.

    Args:
        joints: (..., 3, 3) world positions of its three joints (hip, knee, ankle), metres.
        target: (..., 3) world position for the third joint, metres.
        rotations: (..., 2, 4) local rotations of the first two joints.
        above: (..., 2, 4) world rotations of the parents of the first two joints. The second is
            that of the first joint itself unless helper joints lie between.
        pole: (..., 3) direction, world, into which a straight limb bends. By default the mean
            direction of the middle joint over all frames, as the first joint sees it.
        hinge: bend towards the pole only. A limb bent the other way, such as a nearly straight
            knee with noise, is bent towards the pole by the same amount, so that it never flips.

    Returns:
        (..., 2, 4) local rotations of the first two joints. The third joint keeps its local
        rotation, so its world rotation changes.
    """
    start, middle, end = np.moveaxis(np.asarray(joints, dtype=np.float64), -2, 0)
    first, second = middle - start, end - middle
    a, b = _length(first), _length(second)
    now, wanted = _length(end - start), _length(target - start)
    along, toward = _unit(end - start), _unit(target - start)
    new = np.maximum(reachable(wanted, a + b, now), np.abs(a - b))
    bend = first - _dot(first, along) * along
    if pole is None:
        turned = multiply_quaternions(above[..., 0, :], rotations[..., 0, :])
        own = rotate_vectors(invert_quaternions(turned), bend).reshape(-1, 3)
        pole = rotate_vectors(turned, own.mean(axis=0))
    if hinge:
        forward = _perpendicular(pole, along)
        bend = bend - 2 * np.minimum(_dot(bend, forward), 0) * forward
    # Height of the triangle of both bones over the line from start to end.
    cosine = (a**2 + new**2 - b**2) / np.maximum(2 * a * new, _TINY)
    height = a * np.sqrt(np.maximum(1 - np.clip(cosine, -1, 1) ** 2, 0))
    # Existing bend, plus a bend along the pole if there was little.
    old = _length(bend)
    extra = np.maximum(height - old, 0) / (1 + (old / (0.1 * a + _TINY)) ** 2)
    side = _perpendicular(bend + extra * _perpendicular(pole, along), along)
    swing = shortest_arc(along, toward)
    toward_side = rotate_vectors(swing, side)
    reach = np.copysign(np.sqrt(np.maximum(a**2 - height**2, 0)), new**2 + a**2 - b**2)
    new_first = reach * toward + height * toward_side
    new_second = new * toward - new_first
    normal, new_normal = np.cross(along, side), np.cross(toward, toward_side)
    turn_first = _turn(first, normal, new_first, new_normal)
    turn_second = _turn(second, normal, new_second, new_normal)
    local_first = _conjugate(turn_first, above[..., 0, :], rotations[..., 0, :])
    # The second joint's parent has been turned by the first.
    turn_second = multiply_quaternions(invert_quaternions(turn_first), turn_second)
    local_second = _conjugate(turn_second, above[..., 1, :], rotations[..., 1, :])
    return np.stack([local_first, local_second], axis=-2)


def reachable(
    distance: np.ndarray, length: np.ndarray, now: np.ndarray, softness: float = SOFTNESS
) -> np.ndarray:
    """(...) soft limit of `distance` to `length`, metres.

    Distances up to `(1 - softness) length`, or up to `now` if that is larger, do not change; larger
    ones approach `length`. The function and its slope are continuous.
    """
    begin = np.minimum(np.maximum((1 - softness) * length, now), length)
    left = np.maximum(length - begin, _TINY)
    beyond = np.maximum(distance - begin, 0)
    return np.where(distance <= begin, distance, begin + left * -np.expm1(-beyond / left))


def too_high(away: np.ndarray, length: np.ndarray) -> np.ndarray:
    """(T,) metres by which hips are too high for legs of a length (T,) to reach the ankles.

    `away` (T, 3) are the vectors from the ankles to the hips, metres.
    """
    return away[:, 1] - np.sqrt(np.maximum(length**2 - away[:, 0] ** 2 - away[:, 2] ** 2, 0))


def smooth_upper_envelope(values: np.ndarray, frames: int) -> np.ndarray:
    """(T,) smooth curve that is nowhere below `values` (T,), which are not negative.

    It is a running maximum over `frames` before and after, smoothed by a Hann window.
    """
    if not values.any():
        return values
    around = np.pad(values, 2 * frames, mode="edge")
    highest = np.lib.stride_tricks.sliding_window_view(around, 2 * frames + 1).max(axis=1)
    window = np.hanning(2 * frames + 3)[1:-1]
    return np.convolve(highest, window / window.sum(), mode="valid")


def _turn(
    bone: np.ndarray, normal: np.ndarray, new_bone: np.ndarray, new_normal: np.ndarray
) -> np.ndarray:
    """(..., 4) world rotation of a bone and the normal of the limb's plane (..., 3) to new ones."""
    axes = []
    for along, across in ((bone, normal), (new_bone, new_normal)):
        x = _unit(along)
        y = _perpendicular(across, x)
        axes.append(np.stack([x, y, np.cross(x, y)], axis=-1))
    return quaternion_from_matrix(axes[1] @ np.swapaxes(axes[0], -1, -2))


def _conjugate(turn: np.ndarray, above: np.ndarray, local: np.ndarray) -> np.ndarray:
    """(..., 4) local rotation of a joint after a world rotation `turn`; `above` is its parent's."""
    turned = multiply_quaternions(multiply_quaternions(invert_quaternions(above), turn), above)
    return multiply_quaternions(turned, local)


def _perpendicular(v: np.ndarray, along: np.ndarray) -> np.ndarray:
    """(..., 3) unit vectors along the part of `v` perpendicular to unit `along`, or any if zero."""
    v = v - _dot(v, along) * along
    spare = np.eye(3)[np.abs(along).argmin(axis=-1)]
    spare = spare - _dot(spare, along) * along
    return _unit(np.where(_length(v) > 1e-7, v, spare))


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return (a * b).sum(axis=-1, keepdims=True)


def _length(v: np.ndarray) -> np.ndarray:
    return np.linalg.norm(v, axis=-1, keepdims=True)


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.maximum(_length(v), _TINY)


class Reach(NamedTuple):
    """A limb of two bones whose end is to be at a place.

    Attributes:
        bones: its first two joints.
        end: the joint at its end; None for a limb that ends without one.
        places: (T, 3, 3) world positions of its joints and its end, metres.
        target: (T, 3) world position for its end, metres.
        turn: (T, 4) world rotation for the joint at its end.
        pole: (T, 3) direction into which it bends if it is straight; see `two_bone_ik`.
    """

    bones: list[int]
    end: int | None
    places: np.ndarray
    target: np.ndarray
    turn: np.ndarray | None
    pole: np.ndarray | None = None


def bend_limbs(
    skeleton: Skeleton,
    rotations: np.ndarray,
    world: np.ndarray,
    limbs: Sequence[Reach],
    *,
    hinge: bool = False,
) -> np.ndarray:
    """(T, J, 4) local rotations with the ends of limbs at their targets, turned as requested.

    Args:
        skeleton: J joints.
        rotations: (T, J, 4) local rotations.
        world: (T, J, 4) their world rotations.
        limbs: which share no joints.
        hinge: see `two_bone_ik`.
    """
    rotations = rotations.copy()
    for limb in limbs:
        above = world[:, [skeleton.parents[j] for j in limb.bones]]
        rotations[:, limb.bones] = two_bone_ik(
            limb.places,
            limb.target,
            rotations[:, limb.bones],
            above,
            pole=limb.pole,
            hinge=hinge,
        )
    bent = global_rotations(rotations, skeleton)
    for limb in limbs:
        if limb.end is not None and limb.turn is not None:
            back = invert_quaternions(bent[:, skeleton.parents[limb.end]])
            rotations[:, limb.end] = multiply_quaternions(back, limb.turn)
    return rotations


def reach_feet(motion: Motion, ankles: np.ndarray, turns: np.ndarray) -> Motion:
    """Bend the legs so that the ankles are at given places, and turn the feet.

    A foot that is out of reach moves by as much as its leg is short.

    Args:
        motion: T frames of a rig with two legs.
        ankles: (T, 2, 3) world positions of the left and the right ankle, metres.
        turns: (T, 2, 4) world rotations of the ankle joints.
    """
    rig, positions = motion.skeleton, motion.positions()
    limbs = []
    for k, leg in enumerate(require_legs(rig).values()):
        joints = [rig.index(name) for name in (leg.hip, leg.knee, leg.ankle)]
        places = positions[:, joints]
        limbs.append(Reach(joints[:2], joints[2], places, ankles[:, k], turns[:, k]))
    rotations = bend_limbs(rig, motion.rotations, motion.global_rotations(), limbs)
    return replace(motion, rotations=rotations)
