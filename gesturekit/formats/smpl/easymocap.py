"""EasyMocap's folders of SMPL parameters: `smpl/000000.json`, one file a frame.

Each file is a list of people, `{"id", "Rh", "Th", "poses", "shapes"}`. EasyMocap turns the posed
body about the model's origin, V = R(Rh) X + Th (its `smplmodel/body_model.py`), not about the
pelvis as SMPL itself does, and leaves the first three numbers of `poses` at zero. The pelvis is
therefore at R(Rh) J + Th, where J is its place in the unmoved model.
"""

from __future__ import annotations

import json
import os
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from gesturekit.errors import FormatError, MotionError
from gesturekit.formats.signatures import json_in_words
from gesturekit.formats.smpl.amass import to_y_up
from gesturekit.formats.smpl.skeleton import fit_body, model_pelvis, smpl_skeleton
from gesturekit.motion.body_model.model import BodyModel
from gesturekit.motion.motion import Motion
from gesturekit.motion.rotations import (
    multiply_quaternions,
    quaternion_from_rotation_vector,
    rotate_vectors,
    slerp,
)
from gesturekit.wording import counted

_MAX_BYTES = 16 << 20
"""Of one frame's file; a person takes two or three thousand."""
SUBFOLDERS = ("smpl", "smplh", "smplx")
"""Names of the folder that holds the frames, within EasyMocap's output."""
_DIGITS = 9  # of a frame's number
_LAYOUTS = {66: 22, 72: 24, 78: 52, 87: 55, 156: 52, 165: 55}
"""Joints by the length of `poses`. 78 is a body of 22 joints with 6 PCA coefficients a hand, 87
has jaw and eyes after them; newer versions leave out the root's three numbers."""
_BODY = 22
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
    """Read what EasyMocap made of a recording.

    Files are put in order by the numbers in their names; a number that is left out, or a file
    without the person, is a missing frame. Stretches of missing frames are filled in between
    their neighbours; what is missing at either end is left out.

    Args:
        path: the folder `smpl`, the output folder that holds it, or one frame's file.
        person: `id` of whom to read; by default whoever is in the most frames.
        fps: of the recording, which the files do not tell.
        max_gap: seconds; the longest stretch to fill in.
        up: axis that points up, "y" or "z", as the cameras were calibrated; "auto" looks where
            the pelvis' own up points in most frames.
        body_model: of the SMPL family, or its .npz file, as in `read_npz`.

    Returns:
        The motion of a 22-, 24-, 52- or 55-joint rig. Hands given as PCA coefficients are at
        rest. `info` tells `person`, `people`, `first_frame`, `filled_frames`, `up`, `hands`.

    Warns:
        UserWarning: several people and none was named; frames were filled in.

    Raises:
        FormatError: no such folder, a broken file, nobody of that id, or a gap that is too long.
    """
    path = Path(path)
    if up not in ("auto", "y", "z"):
        raise FormatError(f"up axis {up!r}; expected auto, y or z")
    frames = {number: _people(file) for number, file in _files(path).items()}
    seen = Counter(name for people in frames.values() for name in people)
    if not seen:
        raise FormatError(f"{path}: nobody in {counted(len(frames), 'frame')}")
    listing = ", ".join(
        f"{name} ({counted(count, 'frame')})" for name, count in sorted(seen.items())
    )
    if person is None:
        person = min(seen, key=lambda name: (-seen[name], name))
        if len(seen) > 1:
            warnings.warn(
                f"{path}: several people, {listing}; {person} is read (--person chooses)",
                stacklevel=2,
            )
    if person not in seen:
        raise FormatError(f"{path}: no person {person}; it has {listing}")
    there = {number: people[person] for number, people in frames.items() if person in people}
    numbers = np.array(sorted(there))
    _check_gaps(path, numbers, fps, max_gap)
    try:
        motion = _to_motion([there[n] for n in numbers], numbers, fps, up, body_model)
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


def _files(path: Path) -> dict[int, Path]:
    """Frame number to file."""
    if path.is_file():
        return {0: path}
    for folder in (path, *(path / name for name in SUBFOLDERS)):
        files = {int(f.stem): f for f in folder.glob("*.json") if f.stem.isdecimal()}
        if files:
            if max(files) >= 10**_DIGITS:
                raise FormatError(
                    f"{files[max(files)]}: a frame's number of over {_DIGITS} digits; rename it"
                )
            return files
    if not path.exists():
        raise FormatError(f"{path}: no such file or folder")
    raise FormatError(
        f"{path}: no frames of EasyMocap (smpl/000000.json, ...); to read a folder of motions, "
        "name its files"
    )


def _people(file: Path) -> dict[int, dict[str, np.ndarray]]:
    """The people in one frame: id to the numbers of each key."""
    try:
        if file.stat().st_size > _MAX_BYTES:
            raise FormatError(f"{file}: larger than {_MAX_BYTES >> 20} MiB; that is no frame")
        content = json.loads(file.read_bytes())
    except FormatError:
        raise
    except (OSError, ValueError, RecursionError) as error:
        raise FormatError(f"{file}: not a readable JSON file: {error}") from None
    people = content.get("annots") if isinstance(content, dict) else content
    if not isinstance(people, list):
        raise FormatError(
            f"{file}: {json_in_words(content)}; of JSON, motion is read from EasyMocap's lists of "
            "people"
        )
    content = people
    people = {}
    for place, entry in enumerate(content):
        if not isinstance(entry, dict):
            raise FormatError(f"{file}: entry {place} is no person")
        name = entry.get("id", entry.get("personID"))
        if not isinstance(name, int):
            raise FormatError(f"{file}: entry {place} has id {name!r}; expected a whole number")
        people[name] = {
            "Rh": _numbers(file, name, entry, "Rh", 3),
            "Th": _numbers(file, name, entry, "Th", 3),
            "poses": _numbers(file, name, entry, "poses"),
            "shapes": _numbers(file, name, entry, "shapes", optional=True),
            "expression": _numbers(file, name, entry, "expression", optional=True),
            "has_hands": np.array("handl" in entry),
        }
    return people


def _numbers(
    file: Path,
    person: int,
    entry: dict[str, Any],
    key: str,
    count: int | None = None,
    *,
    optional: bool = False,
) -> np.ndarray:
    if key not in entry:
        if optional:
            return np.zeros(0)
        raise FormatError(f"{file}: person {person} has no {key!r}")
    try:
        values = np.array(entry[key], dtype=np.float64).ravel()
    except (TypeError, ValueError, OverflowError):
        raise FormatError(f"{file}: {key!r} of person {person} is no table of numbers") from None
    if count is not None and len(values) != count:
        raise FormatError(
            f"{file}: {key!r} of person {person} has {len(values)} numbers; expected {count}"
        )
    if len(values) > 1000 or not np.isfinite(values).all():
        raise FormatError(
            f"{file}: {key!r} of person {person} holds no finite numbers, or too many"
        )
    if key == "poses" and len(values) not in _LAYOUTS and len(values) + 3 not in _LAYOUTS:
        raise FormatError(
            f"{file}: 'poses' of person {person} has {len(values)} numbers; expected "
            f"{', '.join(map(str, _LAYOUTS))}, or three less without the root"
        )
    return values


def _check_gaps(path: Path, numbers: np.ndarray, fps: float, max_gap: float) -> None:
    if not (np.isfinite(fps) and fps > 0):
        raise FormatError(f"{path}: fps is {fps!r}; expected a positive number")
    missing = np.diff(numbers) - 1
    widest = int(missing.argmax()) if len(missing) else 0
    if len(missing) and missing[widest] > max_gap * fps:
        first, last = numbers[widest] + 1, numbers[widest + 1] - 1
        raise FormatError(
            f"{path}: frames {first} to {last} are missing, {(last - first + 1) / fps:.2f} s; cut "
            f"the recording there, or allow longer gaps (max_gap, now {max_gap:g} s)"
        )


def _to_motion(
    people: list[dict[str, np.ndarray]],
    numbers: np.ndarray,
    fps: float,
    up: str,
    body_model: BodyModel | str | os.PathLike[str] | None,
) -> Motion:
    def table(key: str) -> np.ndarray:
        rows = [person[key] for person in people]
        if len({len(row) for row in rows}) > 1:
            raise MotionError(f"{key!r} has more numbers in some frames than in others")
        return np.stack(rows)

    vectors, info = _joints(table("poses"), any(person["has_hands"] for person in people))
    n_joints = vectors.shape[1]
    rotations = quaternion_from_rotation_vector(vectors)
    turn = quaternion_from_rotation_vector(table("Rh"))
    betas = table("shapes").mean(axis=0)  # as EasyMocap itself takes them for one person
    if betas.any():
        info["betas"] = betas
    pelvis = model_pelvis(n_joints)
    if body_model is not None:
        body = BodyModel.of(body_model)
        if (body.n_joints == 55) == (n_joints == 55):  # else its shapes are others
            pelvis = body.joints_at_rest(betas)[0]
    rotations[:, 0] = multiply_quaternions(turn, rotations[:, 0])
    places = rotate_vectors(turn, pelvis) + table("Th")
    rotations, places, info["up"] = to_y_up(rotations, places, up)
    # Between the frames that are there.
    frames = np.arange(numbers[0], numbers[-1] + 1)
    low = np.searchsorted(numbers, frames, side="right") - 1
    high = np.minimum(low + 1, len(numbers) - 1)
    weight = (frames - numbers[low]) / np.maximum(numbers[high] - numbers[low], 1)

    def between(values: np.ndarray) -> np.ndarray:
        return values[low] + weight[:, None] * (values[high] - values[low])

    face = table("expression")
    return Motion(
        skeleton=smpl_skeleton(n_joints),
        rotations=slerp(rotations[low], rotations[high], weight[:, None]),
        translation=between(places),
        fps=fps,
        info=info,
        expressions=between(face) if face.any() else None,
    )


def _joints(poses: np.ndarray, has_hands: bool) -> tuple[np.ndarray, dict[str, Any]]:
    """(T, J, 3) rotation vectors of all joints, and what there is to say of the hands."""
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
        vectors[:, _BODY : _BODY + 3] = poses[:, -9:].reshape(len(poses), 3, 3)
    return vectors, {"hands": _HANDS}
