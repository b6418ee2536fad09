"""Frames of a recording that did not end: a line of JSON, then one row of numbers a frame.

The line has `format` (1), `fps`, `skeleton` (as in a model folder) and `moving`, the joints with
translations of their own. A row is float64, little endian: the root's position, the quaternions
xyzw of all joints, and the positions of the moving ones. A file may end anywhere: whole rows are
read.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np

from gesturekit.errors import FormatError
from gesturekit.motion.motion import Motion
from gesturekit.motion.skeleton import Skeleton

_FORMAT = 1
_LONGEST_HEADER = 1 << 22
_MOST_JOINTS = 2000


def frames_header(motion: Motion) -> bytes:
    """Return the first line of a file of such motion."""
    about = {"format": _FORMAT, "fps": motion.fps, "skeleton": motion.skeleton.to_json()}
    return json.dumps({**about, "moving": list(motion.joint_translations)}).encode() + b"\n"


def frames_rows(motion: Motion) -> bytes:
    """Return a motion's numbers as rows (T, D), one a frame."""
    turns = motion.rotations.reshape(motion.n_frames, -1)
    columns = [motion.translation, turns, *motion.joint_translations.values()]
    return np.concatenate(columns, axis=1).astype("<f8").tobytes()


def read_frames(path: str | os.PathLike[str]) -> Motion:
    """Read what a recording has written so far; its numbers stay on disk.

    Raises:
        FormatError: no such file, a damaged one, of a newer format, or without a whole frame.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            about = json.loads(line := file.readline(_LONGEST_HEADER))
            if (version := about["format"]) != _FORMAT:
                raise FormatError(f"format {version!r}; this version of gesturekit reads {_FORMAT}")
            if len(about["skeleton"]["names"]) > _MOST_JOINTS:
                raise FormatError(f"over {_MOST_JOINTS} joints")
            skeleton, moving = Skeleton.from_json(about["skeleton"]), list(about["moving"])
            ends = 3 + 4 * skeleton.n_joints
            width = ends + 3 * len(moving)
            n_frames = (os.fstat(file.fileno()).st_size - len(line)) // (8 * width)
            if not n_frames:
                raise FormatError("no whole frame")
            rows = np.memmap(file, "<f8", "r", len(line), (n_frames, width))
        turns = rows[:, 3:ends].reshape(n_frames, -1, 4)
        starts = range(ends, width, 3)
        places = {name: rows[:, at : at + 3] for name, at in zip(moving, starts)}
        motion = Motion(skeleton, turns, rows[:, :3], about["fps"], places)
    except KeyError as error:
        raise FormatError(f"{path}: the frames of a recording lack the field {error}") from None
    except (OSError, ValueError, TypeError, RecursionError, OverflowError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise FormatError(f"{path}: not the frames of a recording: {reason}") from None
    motion.info["source"] = str(path)
    return motion
