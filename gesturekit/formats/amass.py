"""Keys of AMASS and BEAT2 in an npz file: a motion as pose vectors of an SMPL rig.

`poses` are (T, 3 J) rotation vectors, `trans` (T, 3) is added to the model's rest position of the
pelvis, then `betas`, `gender` and the frame rate, `mocap_frame_rate` or `mocap_framerate`. BEAT2
adds `expressions` and has Y up; AMASS has Z up. Fingers are relative to the flat hand; tools of
BEAT2 that add the model's mean hand curl them a little more.

The keys of Seamless Interaction, `smplh:…`, are SMPL-H in the axes of the camera, 30 fps.
"""

from __future__ import annotations

import re
import warnings
from dataclasses import replace
from operator import itemgetter
from typing import Any

import numpy as np

from audio_features.archive import Archive
from gesturekit.errors import FormatError
from gesturekit.formats.conventions import UP_TO_Y
from gesturekit.formats.smpl import N_JOINTS, model_pelvis, smpl_skeleton
from gesturekit.motion.face import MAX_CHANNELS, FaceTrack, is_smplx, smplx_face
from gesturekit.motion.motion import Motion
from gesturekit.motion.rotations import (
    invert_quaternions,
    multiply_quaternions,
    quaternion_from_rotation_vector,
    rotate_vectors,
    rotation_vector_from_quaternion,
)
from gesturekit.motion.skeleton import GENDERS, MAX_BETAS, BodyShape
from gesturekit.wording import listed

RATES = ("mocap_frame_rate", "mocap_framerate", "fps")
"""Keys of the frame rate."""
_MODELS = {24: "smpl", 52: "smplh", 55: "smplx"}
_FINGERS = {24: 72, 52: 66, 55: 75}
"""First column of the fingers in `poses`, by the number of joints."""
_OF_HANDS = re.compile("(left|right)_?hand", re.IGNORECASE)
_N_BETAS = {24: 10, 52: 16, 55: 300}
_N_EXPRESSIONS = 100


def from_amass(archive: Archive, up: str) -> Motion:
    """Return the motion in the keys of AMASS or BEAT2; `up` is "y", "z", "-y" or "auto".

    If the fingers are still, `info["unread_hands"]` has the other keys of the file on hands.

    Raises:
        FormatError: a key is missing, pickled, or of a wrong shape.
    """
    if lacking := [key for key in ("poses", "trans") if key not in archive]:
        held = listed([ascii(key)[1:-1][:40] for key in archive], 8) or "none"
        need = "an npz of motion has poses, trans and mocap_frame_rate (AMASS), or is gesturekit's"
        raise FormatError(f"{archive.path}: no key {lacking[0]!r}: {need}; this one has {held}")
    poses = archive.numbers("poses")
    if poses.ndim == 3:  # some keep the joints apart: (T, J, 3)
        poses = poses.reshape(len(poses), -1)
    trans = archive.numbers("trans")
    is_right = poses.ndim == 2 and poses.shape[1] in [3 * n for n in N_JOINTS]
    need = f"(frames, 3 x joints) with {', '.join(map(str, N_JOINTS))} joints"
    check_shape("poses", poses, is_right, need)
    check_shape("trans", trans, trans.shape == (len(poses), 3), f"({len(poses)}, 3)")
    n_joints = poses.shape[1] // 3
    rotations = quaternion_from_rotation_vector(poses.reshape(len(poses), n_joints, 3))
    rest = model_pelvis(n_joints)
    rotations, pelvis, up = to_y_up(rotations, trans + rest, up)
    skeleton = replace(smpl_skeleton(n_joints), body_shape=read_shape(archive, "betas", rest))
    motion = Motion(skeleton, rotations, pelvis, _rate(archive), info={"up": up})
    fingers = poses[:, _FINGERS.get(n_joints, poses.shape[1]) :]
    if not (fingers != fingers[:1]).any():
        motion.info["unread_hands"] = list(filter(_OF_HANDS.match, archive))
    return replace(motion, face=read_face(archive, motion.n_frames))


def to_amass(motion: Motion, up: str) -> dict[str, Any]:
    """Return the keys of AMASS and BEAT2 and their values, for a motion on a rig of `RIGS`.

    `up` is the axis that points up in `poses` and `trans`, "y" or "z".
    """
    n_joints, n_frames = motion.skeleton.n_joints, motion.n_frames
    rotations, pelvis = motion.rotations, motion.translation
    if up == "z":
        back = invert_quaternions(UP_TO_Y[up])
        rotations = rotations.copy()
        rotations[:, 0] = multiply_quaternions(back, rotations[:, 0])
        pelvis = rotate_vectors(back, pelvis)
    shape = motion.skeleton.body_shape
    rest = model_pelvis(n_joints) if shape.pelvis is None else np.array(shape.pelvis)
    rate = int(motion.fps) if motion.fps == int(motion.fps) else motion.fps
    values = {
        "poses": rotation_vector_from_quaternion(rotations).reshape(n_frames, -1),
        "trans": pelvis - rest,
        "betas": np.pad(shape.betas, (0, max(0, _N_BETAS[n_joints] - len(shape.betas)))),
        "gender": shape.gender or "neutral",
        "surface_model_type": _MODELS[n_joints],
        "mocap_frame_rate": rate,
        "mocap_framerate": rate,
    }
    if n_joints == 55:
        face = (
            motion.face.values if motion.face and is_smplx(motion.face) else np.empty((n_frames, 0))
        )
        lacking = max(0, _N_EXPRESSIONS - face.shape[1])
        values["expressions"] = np.pad(face, ((0, 0), (0, lacking)))
        values["model"] = shape.version or "smplx2020"
    elif n_joints == 52:
        values["dmpls"] = np.zeros((n_frames, 8))  # required by readers of AMASS
    return values


def to_y_up(
    rotations: np.ndarray, pelvis: np.ndarray, up: str
) -> tuple[np.ndarray, np.ndarray, str]:
    """Return rotations (T, J, 4) and pelvis (T, 3) with Y up, and the axis that pointed up.

    If `up` is "auto", it is the one of UP_TO_Y that the pelvis points along in most frames.
    """
    if up == "auto" and len(rotations):
        body = rotate_vectors(rotations[:, 0], np.array([0.0, 1.0, 0.0]))
        y, z = np.median(body[:, 1:], axis=0)
        up = max(("y", y), ("z", z), ("-y", -y), key=itemgetter(1))[0]
    if up in ("z", "-y"):
        rotations = rotations.copy()
        rotations[:, 0] = multiply_quaternions(UP_TO_Y[up], rotations[:, 0])
        pelvis = rotate_vectors(UP_TO_Y[up], pelvis)
    return rotations, pelvis, up


def read_shape(archive: Archive, betas_key: str, pelvis: np.ndarray | None) -> BodyShape:
    """Return the body shape: `betas` under that key, `gender`, and `model`, the model's version.

    Betas of each frame (T, B) are averaged. An unknown gender is left out with a warning.
    """
    betas = archive.numbers(betas_key) if betas_key in archive else np.empty(0)
    if betas.ndim == 2:  # one row for each frame, although a body does not change
        betas = betas.mean(axis=0) if len(betas) else betas.ravel()
    is_right = betas.ndim == 1 and len(betas) <= MAX_BETAS and np.isfinite(betas).all()
    check_shape(betas_key, betas, is_right, f"up to {MAX_BETAS} finite coefficients")
    gender = _text(archive, "gender").lower()
    if gender and gender not in GENDERS:
        text = f"gender {gender!r} is none of {', '.join(GENDERS)}; it is left out"
        warnings.warn(f"{archive.path}: {text}", stacklevel=2)
    return BodyShape(
        betas=tuple(betas),
        gender=gender if gender in GENDERS else None,
        version=_text(archive, "model") or None,
        pelvis=None if pelvis is None else tuple(pelvis),
    )


def read_face(archive: Archive, n_frames: int) -> FaceTrack | None:
    """Return the face in native keys or `expressions`; None without, or if these are all zero.

    Values of another shape are left out with a warning.
    """
    key = "face_values" if "face_values" in archive else "expressions"
    if key not in archive:
        return None
    values = archive.numbers(key)
    if values.ndim != 2 or len(values) != n_frames or values.shape[1] > MAX_CHANNELS:
        text = f"shape {values.shape} for {n_frames} frames; they are left out"
        warnings.warn(f"{archive.path}: {key} have {text}", stacklevel=2)
        return None
    if key == "expressions":
        return smplx_face(values) if values.any() else None
    return FaceTrack(tuple(archive.texts("face_names", MAX_CHANNELS)), values)


def check_shape(key: str, values: np.ndarray, is_right: bool | np.bool_, need: str) -> None:
    """Raise FormatError for an array that is not right; `need` describes one that is."""
    if not is_right:
        raise FormatError(f"key {key!r} has shape {values.shape}; expected {need}")


def read_number(archive: Archive, key: str) -> float:
    """Return the only number under a key."""
    value = archive.numbers(key)
    check_shape(key, value, value.size == 1, "one number")
    return float(value.item())


def _rate(archive: Archive) -> float:
    """Return the frame rate; all of its keys must agree."""
    rates = {key: read_number(archive, key) for key in RATES if key in archive}
    if not rates:
        raise FormatError("no key 'mocap_frame_rate' or 'mocap_framerate' in the archive")
    if len(set(rates.values())) > 1:
        said = ", ".join(f"key {key!r} {value:g}" for key, value in rates.items())
        raise FormatError(f"the frame rates differ, {said}; keep only the right one in the file")
    return next(iter(rates.values()))


def _text(archive: Archive, key: str) -> str:
    """Return a short text; "" if the key is missing or is not a text."""
    if key not in archive:
        return ""
    try:
        texts = archive.texts(key)
    except FormatError as error:
        warnings.warn(f"{error}; it is ignored", stacklevel=2)
        return ""
    return texts[0] if texts and len(texts[0]) < 100 else ""


FPS = 30.0
_JOINTS = {"global_orient": 1, "body_pose": 21, "left_hand_pose": 15, "right_hand_pose": 15}


def from_seamless(archive: Archive) -> Motion:
    """Return the motion in the keys `smplh:…`; a body upside down, as in camera axes, is turned.

    Raises:
        FormatError: a key is missing or of a wrong shape.
    """
    parts = []
    for name, n_joints in _JOINTS.items():
        values = archive.numbers(f"smplh:{name}")
        n_frames = len(values)
        is_right = values.size == n_frames * n_joints * 3
        check_shape(f"smplh:{name}", values, is_right, f"(frames, {n_joints}, 3)")
        parts.append(values.reshape(n_frames, n_joints, 3))
    trans = archive.numbers("smplh:translation")
    if len({len(part) for part in parts}) > 1 or trans.shape != (len(parts[0]), 3):
        raise FormatError("keys 'smplh:…' differ in their numbers of frames")
    rotations = quaternion_from_rotation_vector(np.concatenate(parts, axis=1))
    n_joints = rotations.shape[1]
    rest = model_pelvis(n_joints)
    rotations, pelvis, up = to_y_up(rotations, trans + rest, "auto")
    skeleton = replace(smpl_skeleton(n_joints), body_shape=BodyShape(pelvis=tuple(rest)))
    return Motion(skeleton, rotations, pelvis, FPS, info={"up": up})
