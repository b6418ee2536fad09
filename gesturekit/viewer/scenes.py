"""Files of a moving body for 3D programs and engines: glTF, VRM animations, FBX by Blender."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from audio_features.atomic import atomic_write
from gesturekit.formats.fbx import write_by_blender
from gesturekit.formats.gltf.vrm import our_names
from gesturekit.formats.gltf.writing import animated_avatar, animated_skeleton
from gesturekit.motion.body_model import BodyModel
from gesturekit.viewer.avatars import load_avatar
from gesturekit.viewer.drawn_body import AVATARS, DrawnBody
from gesturekit.viewer.human.body import COLOURS, Human

if TYPE_CHECKING:
    from gesturekit.motion import Motion


def write_glb(
    motion: Motion,
    path: str | os.PathLike[str],
    *,
    body: str | None = None,
    body_model: BodyModel | str | os.PathLike[str] | None = None,
) -> None:
    """Write a binary glTF 2.0 file: skeleton, animation, and a mesh.

    Args:
        motion: the motion to write.
        path: the .glb file, written atomically.
        body: "human" or the path of a VRM avatar, which keeps its textures; the motion is put on
            its rig. "mannequin" (by default) and "skeleton" have bones on the motion's own rig.
        body_model: the skin of this body instead: a `BodyModel`, its .npz file or a folder.

    Raises:
        FormatError: an unknown body, or one that cannot be read.

    Warns:
        UserWarning: the motion cannot be put on the body: bones are written.
    """
    path = Path(path)
    drawn = DrawnBody.of(motion, body, body_model)
    if drawn.skins and body is not None and body.lower().endswith(AVATARS):
        content = animated_avatar(load_avatar(body)[1], drawn.motion, path.stem, drawn.scale)
    else:
        skin = drawn.skins[0] if drawn.skins else None
        has_regions = skin is not None and skin.regions is not None
        colours = COLOURS if has_regions else {"body": COLOURS["skin"]}
        content = animated_skeleton(drawn.motion, path.stem, skin, colours, drawn.scale)
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)


def write_vrma(motion: Motion, path: str | os.PathLike[str]) -> None:
    """Write a VRM animation 1.0, which VRM programs put on any avatar.

    Args:
        motion: the motion; it is put on the human body's bones, with fingers.
        path: the .vrma file, written atomically.

    Raises:
        FormatError: the human body was not baked.
        MotionError: body parts of the motion's rig cannot be found.
    """
    moved = Human.load().in_t_pose(motion)
    names = {bone: ours for bone, ours in our_names(True).items() if ours in moved.skeleton.names}
    bones = {bone: {"node": moved.skeleton.index(ours)} for bone, ours in names.items()}
    extension = {"specVersion": "1.0", "humanoid": {"humanBones": bones}}
    extensions = {"VRMC_vrm_animation": extension}
    with atomic_write(path) as temporary:
        name = Path(path).stem
        temporary.write_bytes(animated_skeleton(moved, name, None, extensions=extensions))


def write_fbx(
    motion: Motion,
    path: str | os.PathLike[str],
    *,
    body: str | None = None,
    body_model: BodyModel | str | os.PathLike[str] | None = None,
) -> None:
    """Write an FBX file, by Blender; arguments, errors and warnings as for `write_glb`.

    Raises:
        FormatError: Blender is not found, or it failed.
    """
    write = partial(write_glb, body=body, body_model=body_model)
    write_by_blender(path, motion, write)
