"""Motion files of gesturekit, read with NumPy alone: metres, Y up, +Z forward."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

_MAX_JOINTS = 2000


@dataclass
class Clip:
    """Motion of T frames and J joints.

    Attributes:
        names, parents: of the joints; the root's parent is -1.
        offsets: (J, 3) from the parent at rest, metres.
        ends: offset of an end site or None, for each joint.
        rotations: (T, J, 4) local unit quaternions xyzw.
        places: joint -> (T, 3) offset from its parent in each frame; the root always has one.
        fps: frames per second.
    """

    names: list[str]
    parents: list[int]
    offsets: np.ndarray
    ends: list[np.ndarray | None]
    rotations: np.ndarray
    places: dict[int, np.ndarray]
    fps: float


def read_clip(path: str) -> Clip:
    """Read a .bvh (centimetres) or .npz file of gesturekit.

    Raises ValueError, with the file and the reason, if it is no such file.
    """
    try:
        clip = _read_npz(path) if Path(path).suffix.lower() == ".npz" else _read_bvh(path)
        shape = (len(clip.rotations), len(clip.names), 4)
        finite = all(np.isfinite(v).all() for v in (clip.rotations, *clip.places.values()))
        if clip.rotations.shape != shape or shape[0] == 0 or not finite or not 0 < clip.fps < 1e4:
            raise ValueError(f"{shape[0]} frames of {shape[1]} joints at {clip.fps} per second")
        return clip
    except (OSError, KeyError, IndexError, StopIteration, ValueError) as error:
        raise ValueError(
            f"{path}: not a motion file of gesturekit ({error}): "
            "write it again with gesturekit convert"
        ) from error


def _read_npz(path: str) -> Clip:
    with np.load(path, allow_pickle=False) as file:
        names = [str(name) for name in file["names"]]
        parents = [int(parent) for parent in file["parents"]]
        ends: list[np.ndarray | None] = [None] * len(names)
        if "end_site_joints" in file:
            for joint, end in zip(file["end_site_joints"], file["end_site_offsets"]):
                ends[int(joint)] = np.asarray(end, float)
        places = {0: np.asarray(file["translation"], float)}
        if "moving_joints" in file:
            for joint, place in zip(file["moving_joints"], file["joint_translations"]):
                places[int(joint)] = np.asarray(place, float)
        rotations = np.asarray(file["rotations"], float)
        offsets = np.asarray(file["offsets"], float)
        return Clip(names, parents, offsets, ends, rotations, places, float(file["fps"]))


@dataclass
class _Hierarchy:
    names: list[str] = field(default_factory=list)
    parents: list[int] = field(default_factory=list)
    offsets: list[list[float]] = field(default_factory=list)
    ends: list[np.ndarray | None] = field(default_factory=list)
    channels: list[list[str]] = field(default_factory=list)


def _read_bvh(path: str) -> Clip:
    head, mark, rest = Path(path).read_text(encoding="utf-8-sig").partition("MOTION")
    if not mark:
        raise ValueError("no MOTION")
    tree = _hierarchy(iter(head.splitlines()))
    frames, time, *rows = rest.strip().splitlines()
    n_frames, seconds = int(frames.split(":")[1]), float(time.split(":")[1])
    width = sum(map(len, tree.channels))
    values = np.array(" ".join(rows).split(), float).reshape(n_frames, width)
    offsets = np.array(tree.offsets) / 100
    rotations = np.zeros((n_frames, len(tree.names), 4))
    places = {0: np.broadcast_to(offsets[0], (n_frames, 3))}
    column = 0
    for joint, channels in enumerate(tree.channels):
        turn = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (n_frames, 4))
        moved = np.broadcast_to(offsets[joint], (n_frames, 3)).copy()
        for channel in channels:
            axis, value = "XYZ".index(channel[0].upper()), values[:, column]
            if channel[1:].lower() == "position":
                moved[:, axis] = value / 100
                places[joint] = moved
            else:
                turn = _product(turn, _about(axis, np.radians(value)))
            column += 1
        rotations[:, joint] = turn
    return Clip(tree.names, tree.parents, offsets, tree.ends, rotations, places, 1 / seconds)


def _hierarchy(lines: Iterator[str]) -> _Hierarchy:
    tree, stack, in_end = _Hierarchy(), [-1], False
    for line in lines:
        words = line.split()
        key = words[0].upper() if words else ""
        if key in ("ROOT", "JOINT"):
            if len(tree.names) == _MAX_JOINTS:
                raise ValueError(f"over {_MAX_JOINTS} joints")
            tree.names.append(line.split(None, 1)[1].strip())
            tree.parents.append(stack[-1])
            tree.ends.append(None)
            stack.append(len(tree.names) - 1)
        elif key == "END":
            in_end = True
        elif key == "OFFSET" and in_end:
            tree.ends[stack[-1]] = np.array(words[1:4], float) / 100
        elif key == "OFFSET":
            tree.offsets.append([float(word) for word in words[1:4]])
        elif key == "CHANNELS":
            tree.channels.append(words[2:])
        elif key == "}" and in_end:
            in_end = False
        elif key == "}":
            stack.pop()
    if not tree.names or not len(tree.names) == len(tree.offsets) == len(tree.channels):
        raise ValueError("a joint lacks its OFFSET or CHANNELS")
    return tree


def _about(axis: int, angle: np.ndarray) -> np.ndarray:
    turn = np.zeros((len(angle), 4))
    turn[:, axis], turn[:, 3] = np.sin(angle / 2), np.cos(angle / 2)
    return turn


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the quaternion product, first b, then a."""
    vector = a[:, 3:] * b[:, :3] + b[:, 3:] * a[:, :3] + np.cross(a[:, :3], b[:, :3])
    scalar = a[:, 3] * b[:, 3] - (a[:, :3] * b[:, :3]).sum(axis=1)
    return np.concatenate([vector, scalar[:, None]], axis=1)
