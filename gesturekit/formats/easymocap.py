"""EasyMocap's folders of SMPL parameters: `smpl/000000.json`, one file a frame.

Each file is a list of people, `{"id", "Rh", "Th", "poses", "shapes"}`. EasyMocap turns the posed
body about the model's origin, V = R(Rh) X + Th (its `smplmodel/body_model.py`), not about the
pelvis as SMPL itself does, and leaves the first three numbers of `poses` at zero. The pelvis is
therefore at R(Rh) J + Th, where J is its place in the unmoved model.
"""

from __future__ import annotations

import os
import warnings
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from audio_features.archive import parse_json, read_bytes
from gesturekit.errors import FormatError, MotionError
from gesturekit.formats.amass import to_y_up
from gesturekit.formats.conventions import UP_TO_Y, check_choice
from gesturekit.formats.registry import json_in_words
from gesturekit.formats.smpl import fit_body, model_pelvis, smpl_skeleton
from gesturekit.motion.body_model import BodyModel
from gesturekit.motion.face import smplx_face
from gesturekit.motion.motion import Motion
from gesturekit.motion.rotations import (
    multiply_quaternions,
    quaternion_from_rotation_vector,
    rotate_vectors,
    slerp,
)
from gesturekit.motion.skeleton import BodyShape
from gesturekit.wording import counted

_MAX_BYTES = 16 << 20
"""Largest file of one frame; a person takes two or three thousand bytes."""
SUBFOLDERS = ("smpl", "smplh", "smplx")
"""Names of the folder of frames within EasyMocap's output."""
_DIGITS = 9  # most digits of a frame number
_LAYOUTS = {66: 22, 72: 24, 78: 52, 87: 55, 156: 52, 165: 55}
"""Length of `poses` to number of joints. 78 is a body of 22 joints and 6 PCA coefficients a hand;
87 has jaw and eyes after them; newer versions omit the root's three numbers."""
_OPTIONAL = ("shapes", "expression")
_KEYS = ("Rh", "Th", "poses", *_OPTIONAL)
"""Keys of a person."""
_BODY = 22
"""Joints of the body without hands and face."""
_FACE = slice(-9, None)
"""Columns of `poses` with the rotation vectors of jaw and eyes, if hands are PCA coefficients."""
_HANDS = "at rest: the file holds PCA coefficients, which need the hands of its model"


def read_easymocap(
    path: str | os.PathLike[str],
    *,
    person: int | None = None,
    fps: float = 30.0,
    max_gap: float = 0.5,
    up: str = "auto",
    body_model: BodyModel | str | os.PathLike[str] | None = None,
) -> Motion:
    """Read the output of EasyMocap.

    Files are ordered by the numbers in their names. A missing number, or a file without the
    person, is a missing frame. Missing frames are interpolated, and left out at both ends.

    Args:
        path: the folder `smpl`, the output folder that contains it, or the file of one frame.
        person: `id` of the person to read; by default the one in the most frames.
        fps: frame rate of the recording, which the files do not contain.
        max_gap: longest gap to interpolate, seconds.
        up: axis that points up, "y", "z" or "-y", as the cameras were calibrated; "auto" uses the
            direction of the pelvis in most frames.
        body_model: model of the SMPL family, its .npz file or folder, as in `read_npz`.

    Returns:
        The motion of a 22-, 24-, 52- or 55-joint rig. Hands given as PCA coefficients are at
        rest. `info` has `person`, `people`, `first_frame`, `filled_frames`, `up`, `hands`.

    Warns:
        UserWarning: several people and no `person`; frames were interpolated.

    Raises:
        FormatError: no such folder, a broken file, no person of that id, or too long a gap.
    """
    path = Path(path)
    check_choice("up axis", up, ("auto", *UP_TO_Y))
    frames = {number: _people(file) for number, file in _files(path).items()}
    seen = Counter(name for people in frames.values() for name in people)
    if not seen:
        raise FormatError(f"{path}: nobody in {counted(len(frames), 'frame')}")
    person = _chosen_person(path, seen, person)
    present = {number: people[person] for number, people in frames.items() if person in people}
    numbers = np.array(sorted(present))
    _check_gaps(path, numbers, fps, max_gap)
    try:
        motion = _to_motion([present[n] for n in numbers], numbers, fps, up, body_model)
    except MotionError as error:
        raise FormatError(f"{path}: {error}") from None
    filled = motion.n_frames - len(numbers)
    if filled:
        warnings.warn(f"{path}: {counted(filled, 'missing frame')} filled in", stacklevel=2)
    motion.info.update(
        source=str(path),
        person=person,
        people=dict(seen),
        first_frame=int(numbers[0]),
        filled_frames=filled,
    )
    return motion if body_model is None else fit_body(motion, body_model)


def _chosen_person(path: Path, seen: Counter[int], person: int | None) -> int:
    """Return the id of the person to read, from the number of frames of each id."""
    listing = ", ".join(
        f"{name} ({counted(count, 'frame')})" for name, count in sorted(seen.items())
    )
    if person is None:
        person = min(seen, key=lambda name: (-seen[name], name))
        if len(seen) > 1:
            text = f"{path}: several people, {listing}; {person} is read (--person chooses)"
            warnings.warn(text, stacklevel=3)
    if person not in seen:
        raise FormatError(f"{path}: no person {person}; it has {listing}")
    return person


def _files(path: Path) -> dict[int, Path]:
    """Return frame number to file."""
    if path.is_file():
        return {0: path}
    for folder in (path, *(path / name for name in SUBFOLDERS)):
        numbered = [file for file in folder.glob("*.json") if file.stem.isdecimal()]
        if files := {int(f.stem): f for f in numbered if len(f.stem) <= _DIGITS}:
            return files
    there = "no frames of EasyMocap (smpl/000000.json, ...) in it"
    raise FormatError(f"{path}: {there if path.exists() else 'no such file or folder'}")


def _people(file: Path) -> dict[int, dict[str, np.ndarray]]:
    """Return the people in one frame: id to the values (N,) of each key."""
    content = parse_json(read_bytes(file, _MAX_BYTES, FormatError), str(file), FormatError)
    entries = content.get("annots") if isinstance(content, dict) else content
    if not isinstance(entries, list):
        raise FormatError(f"{file}: {json_in_words(content)}; expected EasyMocap's list of people")
    people = {}
    for place, entry in enumerate(entries):
        name = entry.get("id", entry.get("personID")) if isinstance(entry, dict) else None
        if not isinstance(name, int):
            raise FormatError(f"{file}: entry {place} is no person with a whole number as id")
        people[name] = {key: _numbers(f"{file}: person {name}", entry, key) for key in _KEYS}
        people[name]["has_hands"] = np.array("handl" in entry)
    return people


def _numbers(who: str, entry: dict[str, Any], key: str) -> np.ndarray:
    """Return the values (N,) of one key of a person, after checking them; `who` is for messages."""
    if key not in entry and key in _OPTIONAL:
        return np.empty(0)
    if key not in entry:
        raise FormatError(f"{who} has no {key!r}")
    try:
        values = np.array(entry[key], dtype=np.float64).ravel()
    except (TypeError, ValueError, OverflowError):
        values = np.array([np.nan])
    if len(values) > 1000 or not np.isfinite(values).all():
        raise FormatError(f"{who}: {key!r} is no table of finite numbers, or too large")
    n = len(values)
    is_right = n in _LAYOUTS or n + 3 in _LAYOUTS if key == "poses" else n == 3
    if key not in _OPTIONAL and not is_right:
        expected = f"{', '.join(map(str, _LAYOUTS))}, or three less without the root"
        expected = expected if key == "poses" else "3"
        raise FormatError(f"{who}: {key!r} has {n} numbers; expected {expected}")
    return values


def _check_gaps(path: Path, numbers: np.ndarray, fps: float, max_gap: float) -> None:
    """Raise FormatError if frame numbers (N,) have a gap of more than `max_gap` seconds."""
    if not (np.isfinite(fps) and fps > 0):
        raise FormatError(f"{path}: fps is {fps!r}; expected a positive number")
    missing = np.diff(numbers, append=numbers[-1] + 1) - 1
    widest = int(missing.argmax())
    if missing[widest] > max_gap * fps:
        first, last = numbers[widest] + 1, numbers[widest + 1] - 1
        gap = f"{(last - first + 1) / fps:.2f} s; cut it there, or raise max_gap ({max_gap:g} s)"
        raise FormatError(f"{path}: frames {first} to {last} are missing, {gap}")


def _to_motion(
    people: list[dict[str, np.ndarray]],
    numbers: np.ndarray,
    fps: float,
    up: str,
    body_model: BodyModel | str | os.PathLike[str] | None,
) -> Motion:
    """Return the motion of one person, interpolated between frame `numbers` (N,)."""

    def table(key: str) -> np.ndarray:
        rows = [person[key] for person in people]
        if len({len(row) for row in rows}) > 1:
            raise MotionError(f"{key!r} has more numbers in some frames than in others")
        return np.stack(rows)

    vectors, info = _joints(table("poses"), any(person["has_hands"] for person in people))
    n_joints = vectors.shape[1]
    rotations = quaternion_from_rotation_vector(vectors)
    turn = quaternion_from_rotation_vector(table("Rh"))
    betas = table("shapes").mean(axis=0)  # as EasyMocap itself does
    skeleton = replace(smpl_skeleton(n_joints), body_shape=BodyShape(tuple(betas)))
    pelvis = model_pelvis(n_joints)
    if body_model is not None:
        body = BodyModel.of(body_model, skeleton)
        if (body.n_joints == 55) == (n_joints == 55):  # otherwise the shape spaces differ
            pelvis = body.joints_at_rest(betas)[0]
    rotations[:, 0] = multiply_quaternions(turn, rotations[:, 0])
    places = rotate_vectors(turn, pelvis) + table("Th")
    rotations, places, info["up"] = to_y_up(rotations, places, up)
    # Interpolate the missing frames.
    frames = np.arange(numbers[0], numbers[-1] + 1)
    place = np.interp(frames, numbers, np.arange(len(numbers)))
    low, high = np.floor(place).astype(int), np.ceil(place).astype(int)
    weight = place - low

    def between(values: np.ndarray) -> np.ndarray:
        return values[low] + weight[:, None] * (values[high] - values[low])

    face = table("expression")
    return Motion(
        skeleton=skeleton,
        rotations=slerp(rotations[low], rotations[high], weight[:, None]),
        translation=between(places),
        fps=fps,
        info=info,
        face=smplx_face(between(face)) if face.any() else None,
    )


def _joints(poses: np.ndarray, has_hands: bool) -> tuple[np.ndarray, dict[str, Any]]:
    """Return (T, J, 3) rotation vectors of all joints, from `poses` (T, N), and `info` on hands."""
    if poses.shape[1] not in _LAYOUTS:
        poses = np.pad(poses, ((0, 0), (3, 0)))
    width = poses.shape[1]
    n_joints = _LAYOUTS[width]
    if n_joints == _BODY and has_hands:
        n_joints = 52
    if width == 3 * n_joints:
        return poses.reshape(len(poses), n_joints, 3), {}
    vectors = np.zeros((len(poses), n_joints, 3))
    vectors[:, :_BODY] = poses[:, : 3 * _BODY].reshape(len(poses), _BODY, 3)
    if n_joints == 55:
        vectors[:, _BODY : _BODY + 3] = poses[:, _FACE].reshape(len(poses), 3, 3)
    return vectors, {"hands": _HANDS}
