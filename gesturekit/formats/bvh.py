"""Biovision Hierarchy files.

How we read what writers disagree on: a joint's position channels replace its OFFSET (as in
Blender; three.js adds them); translation comes before rotation whatever the order of channels;
Euler angles are intrinsic, in degrees, in the order of the channels.
"""

from __future__ import annotations

import os
from dataclasses import replace
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from gesturekit.atomic import atomic_write
from gesturekit.errors import FormatError, MotionError
from gesturekit.formats.bvh_grammar import ParsedBvh, parse_bvh
from gesturekit.formats.up_axis import find_up_axis, z_up_to_y_up
from gesturekit.motion.kinematics import forward_kinematics
from gesturekit.motion.motion import Motion
from gesturekit.motion.rotations import euler_from_quaternion, quaternion_from_euler
from gesturekit.motion.skeleton import ROTATION_ORDERS, Skeleton

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""Metres in a unit of length."""

STILL = 2.5e-6
"""Position channels that vary by no more than this (metres) are an OFFSET: what is left of a
constant that was written with five or six decimals."""

_COMMON_RATES = (24, 25, 30, 48, 50, 60, 72, 90, 100, 120, 240)
_NTSC = Decimal("1.001")


def read_bvh(path: str | os.PathLike[str], *, unit: str = "auto", up: str = "auto") -> Motion:
    """Read a BVH file.

    Args:
        path: the file.
        unit: of its lengths, "cm", "m" or "mm"; "auto" guesses from the size of the body.
        up: its axis that points up, "y" or "z"; "auto" looks where the head is.

    Returns:
        The motion, metres and Y up. `info` tells `source`, `unit`, `up`, `frame_time` (as
        written) and `renamed` (joints whose names repeated: new name to the name in the file).

    Raises:
        FormatError: no BVH, broken, or cut short; the message names file and line.
    """
    path = Path(path)
    if unit != "auto" and unit not in METRES:
        raise FormatError(f"unit {unit!r}; expected auto, {', '.join(METRES)}")
    if up not in ("auto", "y", "z"):
        raise FormatError(f"up axis {up!r}; expected auto, y or z")
    parsed = parse_bvh(path)
    try:
        motion = _to_motion(parsed, unit, up)
    except MotionError as error:
        raise FormatError(f"{path}: {error}") from None
    motion.info["source"] = str(path)
    return motion


def write_bvh(
    motion: Motion, path: str | os.PathLike[str], *, unit: str = "cm", decimals: int = 6
) -> None:
    """Write a BVH file, Y up, the root's OFFSET 0 0 0.

    Position channels stand on the root, and on the joints that the motion moves. Angles are
    unwrapped, so that curves do not jump by 360 degrees.

    Args:
        motion: what to write.
        path: the file; it appears whole or not at all.
        unit: of its lengths, "cm", "m" or "mm".
        decimals: of offsets and channels (metres get two more, millimetres one less).

    Raises:
        FormatError: a unit or a joint name that the format cannot hold.
    """
    if unit not in METRES:
        raise FormatError(f"unit {unit!r}; expected {', '.join(METRES)}")
    for name in motion.skeleton.names:
        if set("{}") & set(name) or name != name.strip():
            raise FormatError(f"{path}: a BVH file cannot hold the joint name {name!r}")
    places = decimals + {"m": 2, "cm": 0, "mm": -1}[unit]
    hierarchy = _hierarchy(motion, METRES[unit], places)
    values, lengths = _channels(motion, METRES[unit])
    row = " ".join(f"%.{places if is_length else decimals}f" for is_length in lengths) + "\n"
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8") as out:
        out.write(f"{hierarchy}MOTION\nFrames: {motion.n_frames}\n")
        out.write(f"Frame Time: {1 / motion.fps:.10f}\n")
        for frame in values.tolist():
            out.write(row % tuple(frame))


# Reading


def _to_motion(parsed: ParsedBvh, unit: str, up: str) -> Motion:
    joints = parsed.joints
    n_frames = len(parsed.frames)
    offsets = np.array([joint.offset for joint in joints])
    rotations = np.empty((n_frames, len(joints), 4))
    places: dict[int, np.ndarray] = {}
    orders = []
    column = 0
    for j, joint in enumerate(joints):
        columns = {name: parsed.frames[:, column + i] for i, name in enumerate(joint.channels)}
        column += len(joint.channels)
        turning = "".join(name[0] for name in joint.channels if name[1] == "r")
        orders.append(next(order for order in ROTATION_ORDERS if order.startswith(turning)))
        angles = [columns.get(axis + "r", np.zeros(n_frames)) for axis in orders[j]]
        rotations[:, j] = quaternion_from_euler(np.stack(angles, axis=-1), orders[j])
        if any(name[1] == "p" for name in joint.channels):
            places[j] = np.tile(offsets[j], (n_frames, 1))
            for i, axis in enumerate("XYZ"):
                places[j][:, i] = columns.get(axis + "p", places[j][:, i])
    skeleton = Skeleton(
        names=tuple(joint.name for joint in joints),
        parents=tuple(joint.parent for joint in joints),
        offsets=offsets,
        end_sites={j.name: tuple(np.array(end) for end in j.ends) for j in joints if j.ends},
        rotation_orders=tuple(orders),
    )
    if unit == "auto":
        unit = _guess_unit(skeleton, rotations[:1], {j: p[:1] for j, p in places.items()})
    metres = METRES[unit]
    translation = places.pop(0, np.tile(offsets[0], (n_frames, 1)))
    moving = {}
    for j, values in places.items():
        low, high = values.min(axis=0), values.max(axis=0)
        if ((high - low) * metres <= STILL).all():
            offsets[j] = (low + high) / 2
        else:
            moving[joints[j].name] = values * metres
    motion = Motion(
        skeleton=replace(skeleton, offsets=offsets).scaled(metres),
        rotations=rotations,
        translation=translation * metres,
        fps=_frame_rate(parsed.frame_time),
        joint_translations=moving,
    )
    up = find_up_axis(motion) if up == "auto" else up
    motion.info.update(unit=unit, up=up, frame_time=parsed.frame_time)
    if parsed.renamed:
        motion.info["renamed"] = parsed.renamed
    return z_up_to_y_up(motion) if up == "z" else motion


def _guess_unit(skeleton: Skeleton, rotations: np.ndarray, places: dict[int, np.ndarray]) -> str:
    """From how far the body reaches in the first frame: people are 1 to 2.5 m tall."""
    moving = {skeleton.names[j]: values for j, values in places.items() if j}
    positions = forward_kinematics(rotations, np.zeros((1, 3)), skeleton, moving)[0]
    # Below the first fork: joints above it may lie anywhere between the origin and the body.
    fork = next((j for j in range(skeleton.n_joints) if len(skeleton.children(j)) > 1), 0)
    reach = np.ptp(positions[[fork, *skeleton.descendants(fork)]], axis=0).max()
    return "m" if reach < 8 else "cm" if reach < 500 else "mm"


def _frame_rate(text: str) -> float:
    """Frames per second of a `Frame Time`, which is often a rounded third or sixth."""
    try:
        seconds = Decimal(text)
    except InvalidOperation:
        raise MotionError(f"Frame Time: {text[:40]!r} is no number") from None
    if not seconds.is_finite() or not 1e-5 <= seconds <= 1e5:
        raise MotionError(f"Frame Time: {text[:40]} s; expected 0.00001 to 100000")
    whole = round(1 / seconds)
    common = min(_COMMON_RATES, key=lambda rate: abs(1 / Decimal(rate) - seconds))
    # The likeliest rate that what was written cannot be told from: less than its last digit away.
    digit = Decimal(1).scaleb(seconds.as_tuple().exponent)
    rates = ((whole, digit / 1000), (common, digit), (whole, digit), (whole / _NTSC, digit))
    for rate, tolerance in rates:
        if rate and abs(1 / Decimal(rate) - seconds) < tolerance:
            return float(rate)
    return float(1 / seconds)


# Writing


def _order(skeleton: Skeleton) -> list[int]:
    """Joints in the order that nested blocks stand in a file, which is that of the channels."""
    order, waiting = [], [0]
    while waiting:
        joint = waiting.pop()
        order.append(joint)
        waiting.extend(reversed(skeleton.children(joint)))
    return order


def _hierarchy(motion: Motion, metres: float, places: int) -> str:
    skeleton = motion.skeleton
    lines = ["HIERARCHY"]

    def offset(values: np.ndarray) -> str:
        return "OFFSET " + " ".join(f"{v:.{places}f}" for v in values / metres + 0.0)

    def close(depth: int, next_depth: int) -> None:
        lines.extend("\t" * d + "}" for d in range(depth, next_depth - 1, -1))

    before = -1
    for joint in _order(skeleton):
        name, depth = skeleton.names[joint], skeleton.depth[joint]
        close(before, depth)
        before = depth
        tabs = "\t" * depth
        turns = " ".join(f"{axis}rotation" for axis in skeleton.rotation_orders[joint])
        channels = f"CHANNELS 3 {turns}"
        if _has_positions(motion, joint):
            channels = f"CHANNELS 6 Xposition Yposition Zposition {turns}"
        lines += [
            f"{tabs}{'JOINT' if joint else 'ROOT'} {name}",
            f"{tabs}{{",
            f"{tabs}\t{offset(skeleton.offsets[joint] if joint else np.zeros(3))}",
            f"{tabs}\t{channels}",
        ]
        for site in skeleton.end_sites.get(name, ()):
            lines += [
                f"{tabs}\tEnd Site",
                f"{tabs}\t{{",
                f"{tabs}\t\t{offset(site)}",
                f"{tabs}\t}}",
            ]
    close(before, 0)
    return "\n".join(lines) + "\n"


def _has_positions(motion: Motion, joint: int) -> bool:
    return joint == 0 or motion.skeleton.names[joint] in motion.joint_translations


def _channels(motion: Motion, metres: float) -> tuple[np.ndarray, np.ndarray]:
    """Values (T, C) in the file's units, and which columns (C,) are lengths."""
    columns, lengths = [], []
    for joint in _order(motion.skeleton):
        if _has_positions(motion, joint):
            name = motion.skeleton.names[joint]
            columns.append(
                (motion.joint_translations[name] if joint else motion.translation) / metres
            )
            lengths += [True] * 3
        angles = euler_from_quaternion(
            motion.rotations[:, joint], motion.skeleton.rotation_orders[joint]
        )
        columns.append(np.unwrap(angles, axis=0, period=360.0))
        lengths += [False] * 3
    return np.concatenate(columns, axis=1), np.array(lengths)
