"""Axes and unit of a file, detected and converted, and values that are implausible.

If the rest pose (all rotations zero) stands upright, it shows the axes: up from legs and spine,
forward from hips and toes; without legs, both from spine, neck and shoulders. If it stands on four
legs, up comes from these and forward from pelvis to chest. The direction in which a body walks or
looks is no evidence of the axes. Many rigs have a rest pose that does not stand (bones along their
own x axes): up is then the axis along which the body stands in most frames, and forward the usual
axis for that up.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gesturekit.errors import FormatError, MotionError
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import BodyParts, find_legs, known_parts, leg_length
from gesturekit.motion.parts.body_size import body_height, first_fork, stature
from gesturekit.motion.resampling import COMMON_RATES
from gesturekit.motion.rotations import (
    IDENTITY,
    invert_quaternions,
    multiply_quaternions,
    quaternion_from_matrix,
    rotate_vectors,
)
from gesturekit.motion.skeleton import Skeleton, forward_kinematics
from gesturekit.wording import listed

AXES = ("x", "y", "z", "-x", "-y", "-z")
USUAL_FORWARD = {"y": "z", "z": "-y", "x": "z", "-y": "-z", "-z": "y", "-x": "z"}
"""Default forward axis for each up axis: that of BVH and glTF for "y", of Blender for "z", of a
camera for "-y"."""

UP_TO_Y = {
    "y": IDENTITY,
    "z": np.array([-np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]),
    "-y": np.array([1.0, 0.0, 0.0, 0.0]),
}
"""Turn (4,) about x from the up axis of an SMPL file to Y: (x, y, z) becomes (x, z, -y) for "z", as
in AMASS, and (x, -y, -z) for "-y", the axes of a camera."""

_STEEP = 0.7  # largest rise of a quadruped's trunk, as a share of its length
_MOST_FRAMES = 500  # frames, evenly spaced, from which the up axis is found


@dataclass(frozen=True)
class FileAxes:
    """Axes of a file.

    Attributes:
        up: axis of the world that points up.
        forward: axis of the world that a body at rest faces.
        rest: (up, forward) of the rest pose if they differ from the world's, because the root's
            rotation converts between two systems.
        guessed: those of "up" and "forward" without evidence.
    """

    up: str
    forward: str
    rest: tuple[str, str] | None = None
    guessed: tuple[str, ...] = ()


def check_choice(what: str, value: str, known: Collection[str]) -> None:
    """Raise FormatError for a value that is not known; `what` names it."""
    if value not in known:
        raise FormatError(f"{what} {value!r}; expected {', '.join(known)}")


def file_axes(motion: Motion, up: str = "auto", forward: str = "auto") -> FileAxes:
    """Return the axes of a motion, as given or, if "auto", as detected.

    Raises:
        FormatError: an unknown axis, or `forward` along `up`.
    """
    for name, axis in (("up", up), ("forward", forward)):
        check_choice(f"{name} axis", axis, ("auto", *AXES))
    rest, standing = _evidence(motion) if "auto" in (up, forward) else (None, None)
    if forward != "auto":
        likely = (up,) if up != "auto" else (rest and rest[0], standing, "y", "z")
        up = next((axis for axis in likely if axis and axis[-1] != forward[-1]), up)
        return FileAxes(up, forward)
    if up != "auto":
        if rest and rest[0] == up:
            return FileAxes(*rest)
        return FileAxes(up, USUAL_FORWARD[up], guessed=("forward",))
    if rest and standing in (None, rest[0]):
        return FileAxes(*rest)
    if standing:
        return FileAxes(standing, USUAL_FORWARD[standing], rest, ("forward",))
    return FileAxes("y", "z", guessed=("up", "forward"))


def standing_axis(motion: Motion) -> str | None:
    """Return the axis that the body stands along in most frames; None if that is not clear."""
    return _evidence(motion)[1]


def rotation_to_y_up(up: str, forward: str) -> np.ndarray:
    """(4,) rotation from axes `up` and `forward` to Y up, +Z forward.

    Raises:
        FormatError: `forward` lies along `up`.
    """
    if up[-1] == forward[-1]:
        raise FormatError(f"forward axis {forward!r} along the up axis {up!r}")
    y, z = _vector(up), _vector(forward)
    return quaternion_from_matrix(np.stack([np.cross(y, z), y, z]))


def turn_axes(motion: Motion, world: np.ndarray, rest: np.ndarray) -> Motion:
    """Return the motion in other axes.

    Args:
        motion: T frames.
        world: (4,) rotation of the world, in which the root moves.
        rest: (4,) rotation of the joints' frames, in which offsets are given; the same as `world`
            unless the rest pose has other axes.
    """
    if np.allclose(world, IDENTITY) and np.allclose(rest, IDENTITY):
        return motion
    skeleton = motion.skeleton
    back = invert_quaternions(rest)
    offsets = rotate_vectors(rest, skeleton.offsets)
    offsets[0] = rotate_vectors(world, skeleton.offsets[0])
    rotations = multiply_quaternions(multiply_quaternions(rest, motion.rotations), back)
    rotations[:, 0] = multiply_quaternions(
        multiply_quaternions(world, motion.rotations[:, 0]), back
    )
    ends = {
        name: tuple(rotate_vectors(rest, site) for site in sites)
        for name, sites in skeleton.end_sites.items()
    }
    return replace(
        motion,
        skeleton=replace(skeleton, offsets=offsets, end_sites=ends),
        rotations=rotations,
        translation=rotate_vectors(world, motion.translation),
        joint_translations={
            name: rotate_vectors(rest, places) for name, places in motion.joint_translations.items()
        },
    )


def with_y_up(motion: Motion, axes: FileAxes) -> Motion:
    """Return a motion that has these axes with Y up and +Z forward."""
    world = rotation_to_y_up(axes.up, axes.forward)
    return turn_axes(motion, world, rotation_to_y_up(*axes.rest) if axes.rest else world)


def _vector(axis: str) -> np.ndarray:
    """(3,) unit vector of an axis such as "-y"."""
    return np.eye(3)["xyz".index(axis[-1])] * (-1.0 if axis[0] == "-" else 1.0)


def _along(vectors: np.ndarray) -> np.ndarray:
    """(..., 6) bool, true if vectors (..., 3) are within 25 degrees of each of `AXES`."""
    signed = np.concatenate([vectors, -vectors], axis=-1)
    across = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return signed > 0.9 * np.maximum(across, 1e-9)


def _axis(vector: np.ndarray) -> str | None:
    """Return the axis nearest to a vector (3,); None if none is near."""
    hits = np.flatnonzero(_along(vector))
    return AXES[hits[0]] if len(hits) else None


def _evidence(motion: Motion) -> tuple[tuple[str, str] | None, str | None]:
    """Return (up, forward) of the rest pose, and the axis along which the body stands."""
    parts = known_parts(motion.skeleton)
    if parts is None:
        return None, None
    rest = _rest_axes(motion.skeleton, parts)
    return rest, _standing(motion, parts, rest and rest[0])


def _rest_axes(skeleton: Skeleton, parts: BodyParts) -> tuple[str, str] | None:
    """Return (up, forward) of the rest pose; None if it does not stand or is contradictory."""
    rest = np.broadcast_to(IDENTITY, (skeleton.n_joints, 4))
    at = dict(zip(skeleton.names, forward_kinematics(rest, np.zeros(3), skeleton)))
    arms, legs = list(parts.arms.values()), list(parts.legs.values())
    chest = at[parts.spine[-1]]
    if not legs:
        return _upper_body_axes(at, parts)
    up = _axis((at[parts.head] if parts.head else chest) - at[parts.pelvis])
    down = [at[leg.hip] - at[leg.ankle] for leg in legs]
    left = _axis(at[legs[0].hip] - at[legs[1].hip])
    # If all four limbs point the same way, perpendicular to the trunk, it is a quadruped.
    trunk = chest - at[parts.pelvis]
    fore = [at[arm.shoulder] - at[arm.wrist or arm.elbow] for arm in arms]
    risen = _axis(down[0] + down[1])
    if risen and all(_vector(risen) @ limb > 0.8 * np.linalg.norm(limb) for limb in down + fore):
        forward = _axis(trunk - (trunk @ _vector(risen)) * _vector(risen))
        steep = abs(trunk @ _vector(risen)) > _STEEP * np.linalg.norm(trunk)
        if forward and not steep:
            across = np.cross(_vector(risen), _vector(forward))
            return (risen, forward) if left and across @ _vector(left) > 0.5 else None
    if up is None or any(_vector(up) @ leg < 0.8 * np.linalg.norm(leg) for leg in down):
        return None
    if left is None or left[-1] == up[-1]:
        return None
    forward = _axis(np.cross(_vector(left), _vector(up)))
    toes = [at[leg.toe] - at[leg.ankle] for leg in legs if leg.toe]
    if forward is None or any(_vector(forward) @ toe < -1e-3 * np.linalg.norm(toe) for toe in toes):
        return None  # left and right may be named the wrong way round
    return up, forward


def _upper_body_axes(at: Mapping[str, np.ndarray], parts: BodyParts) -> tuple[str, str] | None:
    """Return (up, forward) of a rest pose without legs; None if spine, neck and arms disagree.

    `at` are the places (3,) of the joints.
    """
    left_arm, right_arm = parts.arms["left"], parts.arms["right"]
    left = _axis(at[left_arm.shoulder] - at[right_arm.shoulder])
    trunk = [parts.pelvis, parts.spine[-1], *([parts.head] if parts.head else [])]
    ups = {_axis(at[above] - at[below]) for below, above in zip(trunk, trunk[1:])}
    up = ups.pop()
    if ups or up is None or left is None or left[-1] == up[-1]:
        return None
    outward = [(at[arm.elbow] - at[arm.shoulder]) @ _vector(left) for arm in (left_arm, right_arm)]
    if outward[0] < 0 or outward[1] > 0:
        return None  # left and right may be named the wrong way round
    forward = _axis(np.cross(_vector(left), _vector(up)))
    return None if forward is None else (up, forward)


def _standing(motion: Motion, parts: BodyParts, rest_up: str | None) -> str | None:
    """Return the axis of the world along which the body stands in most frames.

    An axis other than that of the rest pose counts only if the feet are on a floor at zero, because
    the body may be lying down. A body without legs is captured sitting or standing.
    """
    frames = np.unique(np.linspace(0, motion.n_frames - 1, _MOST_FRAMES).astype(int))
    skeleton = motion.skeleton
    positions = forward_kinematics(
        motion.rotations[frames],
        motion.translation[frames],
        skeleton,
        {name: places[frames] for name, places in motion.joint_translations.items()},
    )
    ankles = positions[:, [skeleton.index(leg.ankle) for leg in parts.legs.values()]]
    low = ankles.mean(axis=1) if parts.legs else positions[:, skeleton.index(parts.pelvis)]
    body = positions[:, skeleton.index(parts.spine[-1])] - low
    share = _along(body).mean(axis=0)
    if share.max() <= 0.5:
        return None
    up = AXES[int(share.argmax())]
    if not parts.legs:
        return up
    height = np.median((ankles @ _vector(up)).min(axis=1))
    on_floor = abs(height) < 0.35 * leg_length(skeleton)
    return up if on_floor or rest_up in (None, up) else None


SLOWEST, FASTEST = 1.0, 1000.0
"""Range of plausible frame rates, frames per second."""
SMALLEST, TALLEST = 0.3, 5.0
"""Range of plausible body heights, metres."""


def plausibility_warnings(motion: Motion, reading: Mapping[str, Any]) -> list[str]:
    """Return a line for each implausible property, with the option that corrects it.

    Args:
        motion: the motion as read.
        reading: options it was read with, see `gesturekit.formats.sources.load`.
    """
    lines = []
    if "fps" not in reading and not SLOWEST <= motion.fps <= FASTEST:
        lines.append(_rate(motion))
    if keys := motion.info.get("unread_hands"):
        lines.append(
            f"fingers are still: {listed(keys, 4)} are not read; write them into 'poses' of SMPL-X "
            "as rotation vectors: PCA coefficients (T, N) of the left hand are poses[:, 75:120] = "
            "pca @ hands_componentsl[:N] + hands_meanl, with arrays of the SMPL-X model file; the "
            "right hand is poses[:, 120:165]"
        )
    bones = motion.skeleton.offsets[1:]
    if len(bones) and not bones.any():
        return [*lines, "all bones have length 0: there is no body to see or to measure"]
    named = [name for name in ("unit", "height") if name in reading]
    with suppress(MotionError):  # a rig without height
        if named and not SMALLEST <= (height := body_height(motion.skeleton)) <= TALLEST:
            option = {"unit": "--in-unit", "height": "--height"}[named[-1]]
            lines.append(f"{option} {reading[named[-1]]} makes the body {height:.2f} m tall")
    if "up" in reading and standing_axis(motion) not in (None, "y"):
        lines.append(
            f"--in-up {reading['up']} lays the body down; without it the file's own axis is found"
        )
    if _toes_point_backwards(motion):
        lines.append(
            "the toes point backwards, as left and right are named: did the export mirror the body "
            "(left-handed axes), or swap the names? Export it again"
        )
    return lines


def _toes_point_backwards(motion: Motion) -> bool:
    """Return whether both feet point backwards in the mean, seen from hips and joint names."""
    legs = find_legs(motion.skeleton)
    if legs is None or any(leg.toe is None for leg in legs.values()):
        return False
    positions = motion.positions()
    place = {
        side: [positions[:, motion.skeleton.index(j)] for j in (leg.hip, leg.ankle, leg.toe) if j]
        for side, leg in legs.items()
    }
    across = place["left"][0] - place["right"][0]
    forward = np.stack([-across[:, 2], across[:, 0]], axis=-1)[:, None]
    feet = np.stack([toe - ankle for _, ankle, toe in place.values()], axis=1)[..., ::2]
    along = (feet * forward).sum(axis=-1)
    lengths = np.linalg.norm(feet, axis=-1) * np.linalg.norm(forward, axis=-1)
    return bool((along.mean(axis=0) < -0.5 * lengths.mean(axis=0)).all())


def _rate(motion: Motion) -> str:
    """Return a question about an implausible frame rate, with a likely one."""
    period = 1 / motion.fps
    if motion.fps > FASTEST:
        question, likely = "is Frame Time 1000 times too small", motion.fps / 1000
    elif np.isclose(period, COMMON_RATES, rtol=1e-3).any():
        question, likely = "does Frame Time hold the rate", period
    else:
        question, likely = "is Frame Time in milliseconds", 1000 * motion.fps
    if "frame_time" not in motion.info:
        question = "is its rate right"
    nearest = min(COMMON_RATES, key=lambda rate: abs(rate - likely))
    likely = nearest if abs(nearest - likely) < 0.01 * likely else likely
    rate = f"{likely:.4g}" if likely >= SLOWEST else "RATE"
    here = f"{motion.fps:.2g}" if motion.fps < SLOWEST else f"{motion.fps:.0f}"
    return f"{here} fps: {question}? --in-fps {rate} sets the rate"


METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254, "cmu": 0.0254 / 0.45}
"""Metres in a unit of length; "cmu" is that of the CMU motion capture database, 5.64 cm."""

# Metres from ankle to head joint along the bones, 1.3 to 1.5 on adults. The ratio is small enough
# that "cm" and "inch" (2.54), or "inch" and "cmu" (2.22), do not overlap.
_SHORTEST, _TALLEST = 0.9, 2.1


def guess_unit(skeleton: Skeleton, rotations: np.ndarray) -> tuple[str, bool]:
    """Return the unit that gives the body the size of a person, and whether that is certain.

    Args:
        skeleton: rig in the file's unit, J joints.
        rotations: (J, 4) local quaternions of one pose; used only if the body parts cannot be
            identified.
    """
    try:
        height = stature(skeleton)
    except MotionError:
        # Joints above the first fork may lie anywhere between the origin and the body.
        positions = forward_kinematics(rotations, np.zeros(3), skeleton)
        fork = first_fork(skeleton)
        reach = np.ptp(positions[[fork, *skeleton.descendants(fork)]], axis=0).max()
        return "m" if reach < 8 else "cm" if reach < 500 else "mm", False
    for unit in ("m", "cm", "mm", "inch", "cmu"):
        if _SHORTEST <= height * METRES[unit] <= _TALLEST:
            return unit, True
    middle = np.log((_SHORTEST * _TALLEST) ** 0.5)
    usual = ("m", "cm", "mm")
    off = [abs(np.log(max(height, 1e-12) * METRES[unit]) - middle) for unit in usual]
    return usual[int(np.argmin(off))], False
