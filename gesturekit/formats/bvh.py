"""Biovision Hierarchy (BVH) files.

Conventions where programs differ: a joint's position channels replace its OFFSET (as in Blender;
three.js adds them); translation is applied before rotation, whatever the order of channels; Euler
angles are intrinsic, in degrees, in the order of the channels.

Files that we write contain their unit and axes (`UNIT_MARKS`) and their exact frame rate. Arguments
of the caller take precedence, then the mark, then detection.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from audio_features.atomic import atomic_write
from gesturekit.errors import FormatError, MotionError
from gesturekit.formats.bvh_parser import UNIT_MARKS, ParsedBvh, ParsedJoint, parse_bvh
from gesturekit.formats.conventions import METRES, check_choice, file_axes, guess_unit, with_y_up
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts.body_size import first_fork
from gesturekit.motion.rotations import euler_from_quaternion, quaternion_from_euler
from gesturekit.motion.skeleton import ROTATION_ORDERS, Skeleton
from gesturekit.wording import listed

STILL = 2.1e-6
"""Position channels that vary by no more than this, in the file's unit, are a constant OFFSET that
was written with six decimals."""

_FRAMES_AT_ONCE = 256


def read_bvh(
    path: str | os.PathLike[str],
    *,
    unit: str = "auto",
    up: str = "auto",
    forward: str = "auto",
    fps: float | None = None,
) -> Motion:
    """Read a BVH file.

    Args:
        path: the file.
        unit: unit of its lengths, one of `METRES`; "auto" uses that of our mark, or else the
            one that gives the body the size of a person.
        up: axis that points up, "x" to "z" or "-x" to "-z"; "auto" uses "y" in files that we
            wrote, otherwise the rest pose and the frames in which the body stands.
        forward: axis that a body at rest faces; "auto" uses the rest pose, or the usual axis for
            `up`. Only the axes are changed, to Y up, +Z forward; the heading in the world is kept.
        fps: true frames per second, which replace those of the file's `Frame Time`.

    Returns:
        The motion, metres, Y up, +Z forward. `info` has `source`, `unit`, `up`, `forward` (of the
        file), `guessed` (those of the three without evidence), `frame_time` (as written) and
        `renamed` (new name to name in the file, for joints with repeated names).

    Raises:
        FormatError: not a BVH file, or broken; the message names file and line. Decimal commas, a
            wrong `Frames:` and an end that was cut off are warnings; all complete frames are read.
    """
    path = Path(path)
    check_choice("unit", unit, ("auto", *METRES))
    parsed = parse_bvh(path, fps)
    if parsed.unit is not None:
        unit = parsed.unit if unit == "auto" else unit
        if up in ("auto", "y") and forward in ("auto", "z"):
            up, forward = "y", "z"
    try:
        motion = _to_motion(parsed, unit)
        axes = file_axes(motion, up, forward)
        motion.info.update(
            source=str(path),
            up=axes.up,
            forward=axes.forward,
            guessed=(*motion.info["guessed"], *axes.guessed),
        )
        return with_y_up(motion, axes)
    except MotionError as error:
        raise FormatError(f"{path}: {error}") from None


def write_bvh(
    motion: Motion, path: str | os.PathLike[str], *, unit: str = "cm", decimals: int = 6
) -> None:
    """Write a BVH file, Y up.

    The root and joints with joint translations have position channels. Their OFFSET is 0 0 0, so
    that programs that add positions to it and those that replace it agree. The root's OFFSET is
    also our mark, see `UNIT_MARKS`. Angles are unwrapped, so that curves do not jump by 360
    degrees.

    Args:
        motion: the motion to write.
        path: the file, written atomically.
        unit: unit of its lengths, one of `METRES`.
        decimals: decimals of offsets and channels (longer units get up to two more, millimetres
            one less).

    Warns:
        UserWarning: joint names with spaces, which some readers split.

    Raises:
        FormatError: a unit or a joint name that the format cannot hold.
    """
    check_choice("unit", unit, METRES)
    for name in motion.skeleton.names:
        if set("{}") & set(name) or name != " ".join(name.split()):
            raise FormatError(f"{path}: a BVH file cannot hold the joint name {name!r}")
    if split := [name for name in motion.skeleton.names if " " in name]:
        text = f"joint names with spaces ({listed(split, 3)}), which some readers, as bvhio, split"
        warnings.warn(text, stacklevel=2)
    places = decimals + int(np.ceil(np.log10(METRES[unit] / METRES["cm"])))
    hierarchy = _hierarchy(motion, unit, places)
    values, lengths = _channels(motion, METRES[unit])
    row = " ".join(f"%.{places if is_length else decimals}f" for is_length in lengths) + "\n"
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8") as out:
        out.write(f"{hierarchy}MOTION\nFrames: {motion.n_frames}\n")
        # All digits, so that the rate is read back exactly.
        frame_time = np.format_float_positional(1 / motion.fps, min_digits=10)
        out.write(f"Frame Time: {frame_time}\n")
        for frame in values:
            out.write(row % tuple(frame.tolist()))


# Reading


def _to_motion(parsed: ParsedBvh, unit: str) -> Motion:
    """Return the motion in metres, with the file's axes."""
    joints, n_frames = parsed.joints, len(parsed.frames)
    offsets = np.array([joint.offset for joint in joints])
    columns: dict[tuple[int, str], int] = {}
    for j, joint in enumerate(joints):
        for name in joint.channels:
            columns[j, name] = len(columns)
    rotations, places = _rotations(parsed, columns), _places(parsed, columns)
    skeleton = Skeleton(
        names=tuple(joint.name for joint in joints),
        parents=tuple(joint.parent for joint in joints),
        offsets=offsets,
        end_sites={j.name: tuple(np.array(end) for end in j.ends) for j in joints if j.ends},
        rotation_orders=tuple(_order(joint) for joint in joints),
    )
    is_sure = True
    if unit == "auto":
        first = offsets.copy()
        for j, values in places.items():
            first[j] = values[0]
        unit, is_sure = guess_unit(replace(skeleton, offsets=first), rotations[0])
    metres = METRES[unit]
    translation = places.pop(0, None)
    if translation is None:
        translation = np.tile(offsets[0], (n_frames, 1))
    moving = {}
    below_fork = skeleton.descendants(first_fork(skeleton))
    for j, values in places.items():
        low, high = values.min(axis=0), values.max(axis=0)
        if (high - low <= STILL).all():
            offsets[j] = (low + high) / 2
            continue
        moving[joints[j].name] = values * metres
        if not offsets[j].any() and j in below_fork:  # written by us: restore the bone length
            offsets[j] = values.mean(axis=0)
    motion = Motion(
        skeleton=replace(skeleton, offsets=offsets).scaled(metres),
        rotations=rotations,
        translation=translation * metres,
        fps=parsed.fps,
        joint_translations=moving,
    )
    guessed = () if is_sure else ("unit",)
    motion.info.update(unit=unit, guessed=guessed, frame_time=parsed.frame_time)
    if parsed.renamed:
        motion.info["renamed"] = parsed.renamed
    return motion


def _order(joint: ParsedJoint) -> str:
    """Return the order of the rotation channels; axes without a channel come last."""
    turning = "".join(name[0] for name in joint.channels if name[1] == "r")
    return next(order for order in ROTATION_ORDERS if order.startswith(turning))


def _rotations(parsed: ParsedBvh, columns: Mapping[tuple[int, str], int]) -> np.ndarray:
    """(T, J, 4) local quaternions; `columns` are those of frames by joint and channel."""
    frames, joints = parsed.frames, parsed.joints
    rotations = np.empty((len(frames), len(joints), 4))
    in_order: dict[str, list[int]] = {}
    for j, joint in enumerate(joints):
        in_order.setdefault(_order(joint), []).append(j)
    angles_at = {
        order: np.array([[columns.get((j, f"{axis}r"), -1) for axis in order] for j in js])
        for order, js in in_order.items()
    }
    for start in range(0, len(frames), _FRAMES_AT_ONCE):  # blocks that fit in the CPU cache
        block = slice(start, start + _FRAMES_AT_ONCE)
        for order, at in angles_at.items():
            angles = np.where(at >= 0, frames[block][:, at], 0.0)
            rotations[block, in_order[order]] = quaternion_from_euler(angles, order)
    return rotations


def _places(parsed: ParsedBvh, columns: Mapping[tuple[int, str], int]) -> dict[int, np.ndarray]:
    """Return joint to (T, 3) positions in its parent's frame, for joints with position channels."""
    places: dict[int, np.ndarray] = {}
    for (j, name), column in columns.items():
        if name[1] == "p":
            if j not in places:
                places[j] = np.tile(np.array(parsed.joints[j].offset), (len(parsed.frames), 1))
            places[j][:, "XYZ".index(name[0])] = parsed.frames[:, column]
    return places


# Writing


def _nested(skeleton: Skeleton) -> list[int]:
    """Return the joints in depth-first order, which is the order of blocks and channels."""
    order, waiting = [], [0]
    while waiting:
        joint = waiting.pop()
        order.append(joint)
        waiting.extend(reversed(skeleton.children(joint)))
    return order


def _hierarchy(motion: Motion, unit: str, places: int) -> str:
    """Return the HIERARCHY section, with offsets rounded to `places` decimals."""
    skeleton, metres = motion.skeleton, METRES[unit]
    lines = ["HIERARCHY"]

    def offset(values: np.ndarray) -> str:
        return "OFFSET " + " ".join(f"{v:.{places}f}" for v in values / metres + 0.0)

    def close(depth: int, next_depth: int) -> None:
        lines.extend("\t" * d + "}" for d in range(depth, next_depth - 1, -1))

    before = -1
    for joint in _nested(skeleton):
        name, depth = skeleton.names[joint], skeleton.depth[joint]
        close(before, depth)
        before = depth
        tabs = "\t" * depth
        turns = " ".join(f"{axis}rotation" for axis in skeleton.rotation_orders[joint])
        channels = f"CHANNELS 3 {turns}"
        place = offset(skeleton.offsets[joint])
        if joint == 0 or name in motion.joint_translations:
            channels = f"CHANNELS 6 Xposition Yposition Zposition {turns}"
            place = offset(np.zeros(3)) if joint else f"OFFSET {UNIT_MARKS[unit]}"
        block = (f"{'JOINT' if joint else 'ROOT'} {name}", "{", f"\t{place}", f"\t{channels}")
        lines += [tabs + line for line in block]
        for site in skeleton.end_sites.get(name, ()):
            block = ("End Site", "{", f"\t{offset(site)}", "}")
            lines += [f"{tabs}\t{line}" for line in block]
    close(before, 0)
    return "\n".join(lines) + "\n"


def _channels(motion: Motion, metres: float) -> tuple[np.ndarray, np.ndarray]:
    """Return values (T, C) in the file's units, and (C,) bool, true for columns of lengths."""
    columns, lengths, skeleton = [], [], motion.skeleton
    places = {skeleton.names[0]: motion.translation, **motion.joint_translations}
    for joint in _nested(skeleton):
        if (name := skeleton.names[joint]) in places:
            columns.append(places[name] / metres)
            lengths += [True] * 3
        order = skeleton.rotation_orders[joint]
        angles = euler_from_quaternion(motion.rotations[:, joint], order)
        columns.append(np.unwrap(angles, axis=0, period=360.0))
        lengths += [False] * 3
    return np.concatenate(columns, axis=1), np.array(lengths)
