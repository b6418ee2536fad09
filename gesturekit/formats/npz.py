"""Motion as numpy archives: our own keys for any rig, and those of AMASS and BEAT2 for SMPL's.

Native keys (format 1): `gk_version, names, parents, offsets, rotation_orders, end_site_joints,
end_site_offsets, rotations, translation, moving_joints, joint_translations, fps`. On a rig of the
SMPL family `poses, trans, betas, expressions, gender, model, mocap_frame_rate, mocap_framerate`
stand beside them, which PantoMatrix, the SMPL-X add-on of Blender and aitviewer read.
"""

from __future__ import annotations

import os
import warnings
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gesturekit.atomic import atomic_write
from gesturekit.errors import FormatError
from gesturekit.formats.smpl import N_JOINTS, is_smpl, model_pelvis, smpl_skeleton
from gesturekit.formats.up_axis import Z_TO_Y
from gesturekit.motion.motion import Motion
from gesturekit.motion.rotations import (
    invert_quaternions,
    multiply_quaternions,
    quaternion_from_rotation_vector,
    rotate_vectors,
    rotation_vector_from_quaternion,
)
from gesturekit.motion.skeleton import Skeleton

NPZ_FORMAT = 1
_MAX_BYTES = 8 << 30  # a file that unpacks to more than this is not read
# What zipfile, zlib and numpy raise on a file that is damaged or something else.
_UNREADABLE = (OSError, EOFError, ValueError, MemoryError, zipfile.BadZipFile, zlib.error)


def read_npz(path: str | os.PathLike[str], *, up: str = "auto") -> Motion:
    """Read a motion npz: ours, or one with the keys `poses` and `trans` of AMASS and BEAT2.

    Joints of an SMPL rig lie as on an average adult, since the file does not hold the body model.

    Args:
        path: the file.
        up: axis that points up in an AMASS-like file, "y" or "z"; "auto" looks where the pelvis'
            own up points in most frames. Ours are always Y up.

    Raises:
        FormatError: missing, damaged, of a newer format, or without the keys of a motion.
    """
    path = Path(path)
    if up not in ("auto", "y", "z"):
        raise FormatError(f"up axis {up!r}; expected auto, y or z")
    values = _load(path)
    try:
        motion = _from_native(values) if "gk_version" in values else _from_smpl(values, up)
    except KeyError as error:
        raise FormatError(f"{path}: no key {error} in the archive") from None
    except (TypeError, ValueError, IndexError) as error:
        raise FormatError(f"{path}: {error}") from None
    motion.info["source"] = str(path)
    return motion


def write_npz(motion: Motion, path: str | os.PathLike[str], *, up: str = "y") -> None:
    """Write a motion npz; on a rig of the SMPL family with the keys of BEAT2 and AMASS.

    Args:
        motion: what to write.
        path: the file; it appears whole or not at all.
        up: axis that points up in the SMPL keys: "y" as BEAT2 has it, "z" as AMASS has it. The
            native keys are always Y up.

    Warns:
        UserWarning: the SMPL-X add-on of Blender would refuse or misplay the frame rate.
    """
    if up not in ("y", "z"):
        raise FormatError(f"up axis {up!r}; expected y or z")
    values = _native(motion)
    if is_smpl(motion.skeleton):
        values |= _smpl(motion, up)
        if motion.fps % 30:
            fate = "refuses" if motion.fps < 30 else "plays at the wrong speed"
            warnings.warn(
                f"{path}: the SMPL-X add-on of Blender {fate} {motion.fps:g} fps; write a multiple "
                "of 30 (--fps 30)",
                stacklevel=2,
            )
    with atomic_write(path) as temporary, temporary.open("wb") as out:
        np.savez(out, **values)


def _load(path: Path) -> dict[str, np.ndarray]:
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > _MAX_BYTES:
            raise FormatError(f"{path}: unpacks to {size / 2**30:.1f} GiB; that is no motion")
        values = {}
        with np.load(path, allow_pickle=False) as archive:
            for key in archive.files:
                try:
                    values[key] = archive[key]
                except ValueError as error:
                    if "pickle" not in str(error).lower():
                        raise
                    # Some archives hold notes as pickled objects; a motion's arrays never are.
        return values
    except FormatError:
        raise
    except FileNotFoundError:
        raise FormatError(f"{path}: no such file") from None
    except _UNREADABLE as error:
        raise FormatError(f"{path}: not a readable npz file: {error}") from None


# Native keys


def _native(motion: Motion) -> dict[str, Any]:
    skeleton = motion.skeleton
    ends = [(skeleton.index(k), site) for k, sites in skeleton.end_sites.items() for site in sites]
    moving = motion.joint_translations
    return {
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


def _from_native(values: Mapping[str, np.ndarray]) -> Motion:
    version = values["gk_version"]
    if version.shape or version != NPZ_FORMAT:
        raise FormatError(f"motion format {version}; this version of gesturekit reads {NPZ_FORMAT}")
    names = tuple(str(name) for name in values["names"])
    ends: dict[str, tuple[np.ndarray, ...]] = {}
    for j, site in zip(values["end_site_joints"], values["end_site_offsets"]):
        ends[names[j]] = (*ends.get(names[j], ()), site)
    motion = Motion(
        skeleton=Skeleton(
            names=names,
            parents=tuple(values["parents"].tolist()),
            offsets=values["offsets"],
            end_sites=ends,
            rotation_orders=tuple(str(order) for order in values["rotation_orders"]),
        ),
        rotations=values["rotations"],
        translation=values["translation"],
        fps=values["fps"].item(),
        joint_translations={
            names[j]: places
            for j, places in zip(values["moving_joints"], values["joint_translations"])
        },
    )
    if "betas" in values:
        motion.info["betas"] = values["betas"]
    return motion


# SMPL keys


def _smpl(motion: Motion, up: str) -> dict[str, Any]:
    skeleton, n_frames = motion.skeleton, motion.n_frames
    rotations, pelvis = motion.rotations.copy(), motion.translation
    if up == "z":
        back = invert_quaternions(Z_TO_Y)
        rotations[:, 0] = multiply_quaternions(back, rotations[:, 0])
        pelvis = rotate_vectors(back, pelvis)
    poses = np.zeros((n_frames, 55, 3))
    whole = smpl_skeleton(55)
    for j, name in enumerate(skeleton.names):
        if name in whole.names:  # SMPL's hand stubs have no place in SMPL-X
            poses[:, whole.index(name)] = rotation_vector_from_quaternion(rotations[:, j])
    betas = np.zeros(300)
    if skeleton.n_joints == 55:  # the shapes of SMPL and SMPL-H mean nothing to SMPL-X
        known = np.asarray(motion.info.get("betas", ()), dtype=np.float64).ravel()[:300]
        betas[: len(known)] = known
    rate = int(motion.fps) if motion.fps == int(motion.fps) else motion.fps
    return {
        "poses": poses.reshape(n_frames, 165),
        "trans": pelvis - model_pelvis(55),
        "betas": betas,
        "expressions": np.zeros((n_frames, 100)),
        "gender": "neutral",
        "model": "smplx2020",
        "surface_model_type": "smplx",
        "mocap_frame_rate": rate,
        "mocap_framerate": rate,
    }


def _from_smpl(values: Mapping[str, np.ndarray], up: str) -> Motion:
    poses = np.asarray(values["poses"], dtype=np.float64)
    trans = np.asarray(values["trans"], dtype=np.float64)
    n_joints = poses.shape[1] // 3 if poses.ndim == 2 else 0
    if n_joints not in N_JOINTS or poses.shape[1] % 3:
        raise FormatError(
            f"poses have shape {poses.shape}; expected (frames, 3 x joints) with "
            f"{', '.join(map(str, N_JOINTS))} joints of an SMPL rig"
        )
    if trans.shape != (len(poses), 3):
        raise FormatError(f"trans has shape {trans.shape}; expected ({len(poses)}, 3)")
    rates = [values[key] for key in ("mocap_frame_rate", "mocap_framerate", "fps") if key in values]
    if not rates:
        raise FormatError("no key 'mocap_frame_rate' or 'mocap_framerate' in the archive")
    skeleton = smpl_skeleton(n_joints)
    rotations = quaternion_from_rotation_vector(poses.reshape(len(poses), n_joints, 3))
    pelvis = trans + model_pelvis(n_joints)
    if up == "auto":
        body = rotate_vectors(rotations[:, 0], np.array([0.0, 1.0, 0.0]))
        up = "z" if np.median(body[:, 2] - body[:, 1]) > 0 else "y"
    if up == "z":
        rotations[:, 0] = multiply_quaternions(Z_TO_Y, rotations[:, 0])
        pelvis = rotate_vectors(Z_TO_Y, pelvis)
    info = {"up": up, "betas": np.asarray(values.get("betas", ()))}
    return Motion(skeleton, rotations, pelvis, float(rates[0].item()), info=info)
