"""Wavefront OBJ: the mesh of one frame."""

from __future__ import annotations

import os

import numpy as np

from audio_features.atomic import atomic_write
from gesturekit.errors import FormatError
from gesturekit.formats.smpl.skeleton import fit_body
from gesturekit.motion.body_model.model import BodyModel
from gesturekit.motion.motion import Motion


def write_obj(
    motion: Motion,
    path: str | os.PathLike[str],
    *,
    body_model: BodyModel | str | os.PathLike[str] | None = None,
    frame: int = 0,
) -> None:
    """Write the body mesh of one frame, metres, Y up.

    Args:
        motion: on a rig of the SMPL family, or one that can be retargeted to it.
        path: the file, written atomically.
        body_model: a `BodyModel`, its .npz file, or a folder of models (`BodyModel.of`).
        frame: frame index; a negative one counts from the end.

    Raises:
        FormatError: no body model, or no such frame.
    """
    if body_model is None:
        raise FormatError(
            f"{path}: an .obj file holds a body mesh, which a motion has not: name a body model "
            "(--body-model SMPLX_NEUTRAL.npz)"
        )
    if not -motion.n_frames <= frame < motion.n_frames:
        raise FormatError(f"{path}: frame {frame} of a motion of {motion.n_frames} frames")
    frame %= motion.n_frames
    body = BodyModel.of(body_model, motion.skeleton)
    (skin,) = body.vertices(fit_body(motion[frame : frame + 1], body))
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8") as out:
        np.savetxt(out, skin, fmt="v %.6f %.6f %.6f")
        np.savetxt(out, body.faces + 1, fmt="f %d %d %d")
