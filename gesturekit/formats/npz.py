"""Motion as npz files: native keys for any rig, and keys of AMASS and BEAT2 for SMPL rigs.

Native keys (format 1): `gk_version, names, parents, offsets, rotation_orders, end_site_joints,
end_site_offsets, rotations, translation, moving_joints, joint_translations, fps`, and if known
`parts_by_hand, part_joints, body_betas, body_pelvis, body_up, gender, model`. Faces of SMPL-X are
`expressions`, others `face_names` and `face_values`; `face` is "rules" if rules made them. Files of
SMPL rigs also have the keys of `amass`.

Compatibility: the defaults suit the SMPL-X add-on of Blender (format SMPL-X), PantoMatrix and the
tools around BEAT2. The add-on's format AMASS needs `up="z"`. aitviewer
(`SMPLSequence.from_amass`) and AMASS readers need `rig="smplh", up="z"`, because they expect the
finger joints in the order of SMPL-H.

A recording that did not end is a file of frames: a line of JSON with `format` (1), `fps`,
`skeleton` (as in a model folder) and `moving`, the joints with translations of their own, then one
row of float64, little endian, a frame: the root's position, the quaternions xyzw of all joints, and
the positions of the moving ones. It may end anywhere: whole rows are read.
"""

from __future__ import annotations

import json
import os
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from audio_features.archive import Archive, open_archive
from audio_features.atomic import atomic_write
from gesturekit.errors import FormatError, MotionError
from gesturekit.formats.amass import (
    check_shape,
    from_amass,
    from_seamless,
    read_face,
    read_number,
    read_shape,
    to_amass,
)
from gesturekit.formats.conventions import UP_TO_Y, check_choice
from gesturekit.formats.smpl import RIGS, as_smpl, fit_body, is_smpl
from gesturekit.motion.body_model import BodyModel
from gesturekit.motion.face import FaceTrack, is_smplx
from gesturekit.motion.motion import Motion
from gesturekit.motion.skeleton import Skeleton

NPZ_FORMAT = 1
_MAX_JOINTS = 2000
_NATIVE = (
    "'names', 'parents', 'offsets', 'rotation_orders', 'end_site_offsets', 'rotations', "
    "'translation', 'joint_translations', 'fps'"
)


def read_npz(
    path: str | os.PathLike[str],
    *,
    up: str = "auto",
    body_model: BodyModel | str | os.PathLike[str] | None = None,
) -> Motion:
    """Read a motion npz: native, or with the keys of AMASS, BEAT2 or Seamless Interaction.

    Without a body model, an SMPL rig has the proportions of an average adult. `betas` and `gender`
    are the skeleton's `body_shape`, and are written again.

    Args:
        path: the file.
        up: axis that points up in an AMASS-like file, "y", "z" or "-y" (a camera's); "auto" takes
            the one that the pelvis points to in most frames. Native files are always Y up.
        body_model: model of the SMPL family, its .npz file, or a folder of models (`BodyModel.of`):
            bones get their lengths from the file's `betas`, and feet get six vertices as end sites.

    Raises:
        FormatError: missing, damaged, of a newer format, or without the keys of a motion.
    """
    path = Path(path)
    check_choice("up axis", up, ("auto", *UP_TO_Y))
    with open_archive(path, FormatError) as archive:
        try:
            if "v_template" in archive and "poses" not in archive:
                raise FormatError(f"{path}: a body model, not a motion; give it as --body-model")
            if all(key in archive for key in ("values", "times", "spec")):
                raise FormatError(f"{path}: speech features (keys values, times), not a motion")
            keys = "'poses', 'trans', 'mocap_frame_rate'"
            if "gk_version" in archive:
                keys = _NATIVE
                motion = _from_native(archive)
            elif "smplh:body_pose" in archive:
                keys = "'smplh:…'"
                motion = from_seamless(archive)
            else:
                motion = from_amass(archive, up)
        except MotionError as error:
            raise FormatError(f"{path}: keys {keys}: {error}") from None
        except (TypeError, ValueError, IndexError, OverflowError) as error:
            text = str(error)
            raise FormatError(text if text.startswith(str(path)) else f"{path}: {text}") from None
    motion.info["source"] = str(path)
    return motion if body_model is None else fit_body(motion, body_model)


def write_npz(
    motion: Motion,
    path: str | os.PathLike[str],
    *,
    rig: str | None = None,
    up: str = "y",
    fps: float | None = None,
) -> None:
    """Write a motion npz; SMPL rigs also with the keys of BEAT2 and AMASS.

    Args:
        motion: the motion to write.
        path: the file, written atomically.
        rig: rig to retarget to: "smplx", "smplh" or "smpl". By default the rig is kept, and
            the pose vectors of an SMPL rig are in the layout of its own model; 22 joints are
            written as SMPL, with its hand joints at rest.
        up: axis that points up in the SMPL keys: "y" as in BEAT2, "z" as in AMASS. Native keys are
            always Y up.
        fps: rate to resample to; by default the motion's own.

    Warns:
        UserWarning: the SMPL-X add-on of Blender would refuse or misplay the frame rate of a
            motion of SMPL-X, or the body's betas mean nothing in the rig (`as_smpl`).

    Raises:
        FormatError: an unknown rig or axis.
        MotionError: a rig that cannot be retargeted to the requested one.
    """
    check_choice("up axis", up, ("y", "z"))
    if rig is not None:
        check_choice("rig", rig, RIGS)
        motion = as_smpl(motion, RIGS[rig])
    if fps is not None and fps != motion.fps:
        motion = motion.resample(fps)
    values = _native(motion)
    if is_smpl(motion.skeleton):
        posed = as_smpl(motion, RIGS["smpl"]) if motion.skeleton.n_joints == 22 else motion
        values |= to_amass(posed, up)
        if posed.skeleton.n_joints == RIGS["smplx"] and motion.fps % 30:
            effect = "refuses" if motion.fps < 30 else "plays at the wrong speed"
            text = f"the SMPL-X add-on of Blender {effect} {motion.fps:g} fps"
            warnings.warn(f"{path}: {text}; write a multiple of 30 (--fps 30)", stacklevel=2)
    with atomic_write(path) as temporary, temporary.open("wb") as out:
        np.savez(out, **values)


def _native(motion: Motion) -> dict[str, Any]:
    """Return the arrays of the native keys."""
    skeleton = motion.skeleton
    ends = [(skeleton.index(k), site) for k, sites in skeleton.end_sites.items() for site in sites]
    moving = motion.joint_translations
    values = {
        "gk_version": NPZ_FORMAT,
        "names": np.array(skeleton.names),
        "parents": np.array(skeleton.parents),
        "offsets": skeleton.offsets,
        "rotation_orders": np.array(skeleton.rotation_orders),
        "end_site_joints": np.array([j for j, _ in ends], dtype=np.int64),
        "end_site_offsets": np.array([site for _, site in ends]).reshape(-1, 3),
        "rotations": motion.rotations,
        "translation": motion.translation,
        "moving_joints": np.array([skeleton.index(name) for name in moving], dtype=np.int64),
        "joint_translations": np.array(list(moving.values())).reshape(-1, motion.n_frames, 3),
        "fps": motion.fps,
    }
    if skeleton.parts:
        values["parts_by_hand"] = np.array(list(skeleton.parts))
        values["part_joints"] = np.array([skeleton.index(name) for name in skeleton.parts.values()])
    shape = skeleton.body_shape
    if shape.betas:
        values["body_betas"] = np.array(shape.betas)
    if shape.pelvis is not None:
        values["body_pelvis"] = np.array(shape.pelvis)
        values["body_up"] = motion.info.get("up", "y")  # up axis of the source file
    if (face := motion.face) is not None:
        if is_smplx(face):
            values["expressions"] = face.values
        else:
            values |= {"face_names": np.array(face.names), "face_values": face.values}
        if face.origin != "recorded":
            values["face"] = face.origin
    return values


def _from_native(archive: Archive) -> Motion:
    """Return the motion in the native keys."""
    version = archive["gk_version"]
    if version.shape or version.dtype.kind not in "iu" or version != NPZ_FORMAT:
        shown = version if not version.shape else f"an array of shape {version.shape}"
        raise FormatError(f"key 'gk_version' is {shown}; this gesturekit reads {NPZ_FORMAT}")
    names = tuple(archive.texts("names", _MAX_JOINTS))

    def by_joint(joints_key: str, key: str, values: Any) -> list[tuple[str, Any]]:
        """Return (joint name, value); the array `joints_key` has the joint index of each value."""
        joints = _indices(archive, joints_key, 0, len(names))
        if not np.ndim(values) or len(values) != len(joints):
            shape = np.shape(values)
            raise FormatError(f"key {key!r} has shape {shape}, but {joints_key!r} {len(joints)}")
        return [(names[joint], value) for joint, value in zip(joints, values)]

    ends: dict[str, list[np.ndarray]] = {}
    sites = archive.numbers("end_site_offsets")
    for name, site in by_joint("end_site_joints", "end_site_offsets", sites):
        ends.setdefault(name, []).append(site)
    parts: dict[str, str] = {}
    if "parts_by_hand" in archive:
        by_hand = archive.texts("parts_by_hand", _MAX_JOINTS)
        parts = {part: name for name, part in by_joint("part_joints", "parts_by_hand", by_hand)}
    pelvis = archive.numbers("body_pelvis") if "body_pelvis" in archive else None
    if pelvis is not None:
        is_right = pelvis.shape == (3,) and np.isfinite(pelvis).all()
        check_shape("body_pelvis", pelvis, is_right, "three numbers")
    skeleton = Skeleton(
        names=names,
        parents=tuple(_indices(archive, "parents", -1, len(names))),
        offsets=archive.numbers("offsets"),
        end_sites=ends,
        rotation_orders=tuple(archive.texts("rotation_orders", _MAX_JOINTS)),
        parts=parts,
        body_shape=read_shape(archive, "body_betas", pelvis),
    )
    places = archive.numbers("joint_translations")
    moving = dict(by_joint("moving_joints", "joint_translations", places))
    motion = Motion(
        skeleton=skeleton,
        rotations=archive.numbers("rotations"),
        translation=archive.numbers("translation"),
        fps=read_number(archive, "fps"),
        joint_translations=moving,
    )
    if pelvis is not None:
        (up,) = archive.texts("body_up") or ["y"]
        motion.info["up"] = up if up in UP_TO_Y else "y"
    face = read_face(archive, motion.n_frames)
    if face is not None and "face" in archive:
        face = replace(face, origin=",".join(archive.texts("face")))
    return replace(motion, face=face)


def _indices(archive: Archive, key: str, lowest: int, stop: int) -> list[int]:
    """Return the joint indices in the array `key`, each at least `lowest` and below `stop`."""
    values = archive[key]
    is_list = values.dtype.kind in "iu" and values.ndim == 1 and len(values) <= _MAX_JOINTS
    if not is_list or not all(lowest <= index < stop for index in values.tolist()):
        held = f"shape {values.shape} of {values.dtype}"
        raise FormatError(f"key {key!r} has {held}; expected indices {lowest} to {stop - 1}")
    return values.tolist()


_FORMAT = 1
_LONGEST_HEADER = 1 << 22


def frames_header(motion: Motion) -> bytes:
    """Return the first line of a file of such motion."""
    about = {"format": _FORMAT, "fps": motion.fps, "skeleton": motion.skeleton.to_json()}
    face = [list(motion.face.names), motion.face.origin] if motion.face else [[], ""]
    moving = list(motion.joint_translations)
    return json.dumps({**about, "moving": moving, "face": face}).encode() + b"\n"


def frames_rows(motion: Motion) -> bytes:
    """Return a motion's numbers as rows (T, D), one a frame."""
    turns = motion.rotations.reshape(motion.n_frames, -1)
    columns = [motion.translation, turns, *motion.joint_translations.values()]
    columns += [motion.face.values] if motion.face else []
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
            if len(about["skeleton"]["names"]) > _MAX_JOINTS:
                raise FormatError(f"over {_MAX_JOINTS} joints")
            skeleton, moving = Skeleton.from_json(about["skeleton"]), list(about["moving"])
            ends = 3 + 4 * skeleton.n_joints
            (names, origin), faces = about["face"], ends + 3 * len(moving)
            width = faces + len(names)
            n_frames = (os.fstat(file.fileno()).st_size - len(line)) // (8 * width)
            if not n_frames:
                raise FormatError("no whole frame")
            rows = np.memmap(file, "<f8", "r", len(line), (n_frames, width))
        turns = rows[:, 3:ends].reshape(n_frames, -1, 4)
        starts = range(ends, faces, 3)
        places = {name: rows[:, at : at + 3] for name, at in zip(moving, starts)}
        face = FaceTrack(tuple(names), rows[:, faces:], origin) if names else None
        motion = Motion(skeleton, turns, rows[:, :3], about["fps"], places, face=face)
    except KeyError as error:
        raise FormatError(f"{path}: the frames of a recording lack the field {error}") from None
    except (OSError, ValueError, TypeError, RecursionError, OverflowError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise FormatError(f"{path}: not the frames of a recording: {reason}") from None
    motion.info["source"] = str(path)
    return motion
