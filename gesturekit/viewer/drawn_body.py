"""Bodies with which motion is drawn, an avatar's among them, and files of a moving body."""

from __future__ import annotations

import os
import warnings
from bisect import bisect_left
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from audio_features.atomic import atomic_write
from gesturekit.errors import FormatError, GestureKitError, MotionError
from gesturekit.formats.fbx import write_by_blender
from gesturekit.formats.gltf.vrm import Avatar, read_avatar
from gesturekit.formats.gltf.writing import animated_avatar, animated_skeleton, vrm_animation
from gesturekit.formats.smpl import fit_body
from gesturekit.motion.body_model import BodyModel, Skin, unique_rows
from gesturekit.motion.face import FaceTrack, values_of
from gesturekit.viewer.figure import Figure
from gesturekit.viewer.human import COLOURS, Fitting, load_human

if TYPE_CHECKING:
    from gesturekit.motion import Motion

BODIES = ("mannequin", "human", "skeleton")
AVATARS = (".vrm", ".glb")
"""Suffixes of files of avatars."""


def is_body(name: str) -> bool:
    """Return whether a name is one of BODIES, or a path that ends as avatars' files do."""
    return name in BODIES or name.lower().endswith(AVATARS)


@dataclass(frozen=True, eq=False)
class DrawnBody:
    """A motion, retargeted to the body with which it is drawn.

    Attributes:
        motion: on the rig of the body.
        figure: its points, limbs and curves.
        skins: meshes drawn in place of limbs, from the finest to the coarsest; empty if the limbs
            are drawn.
        scale: factor on the skins' vertices and joints at rest.
        fitting: puts further motions of the same rig on the body; None if it is that rig.
    """

    motion: Motion
    figure: Figure
    skins: tuple[Skin, ...] = ()
    scale: float = 1.0
    fitting: Fitting | None = None

    @classmethod
    def of(
        cls,
        motion: Motion,
        body: str | None = None,
        body_model: BodyModel | str | os.PathLike[str] | None = None,
    ) -> DrawnBody:
        """Retarget a motion to a body.

        Args:
            motion: what to show.
            body: of BODIES, or the path of an avatar; "mannequin" by default. A mannequin and a
                skeleton have the joints of the motion's own rig; for "human" and avatars the motion
                is retargeted. If that is not possible, the mannequin is drawn.
            body_model: draw its skin instead: a model, its file, or a folder of models.

        Raises:
            FormatError: an unknown body, an avatar that cannot be read, or both a body and a model.

        Warns:
            UserWarning: the motion cannot be retargeted to a body.
        """
        if body is not None and not is_body(body):
            raise FormatError(f"body is {body!r}; expected {', '.join(BODIES)}, .vrm or .glb")
        if body_model is not None:
            if body is not None:
                raise FormatError("give either a body or a body model, not both")
            model = BodyModel.of(body_model, motion.skeleton)
            motion = fit_body(motion, model)
            skin = Skin.of(model, motion.skeleton.body_shape.betas)
            return cls(motion, Figure.of(motion), (skin,))
        if body not in (None, "mannequin", "skeleton"):
            avatar = None if body == "human" else load_avatar(body)
            try:
                rig, skins = (avatar[0].skeleton, avatar[1]) if avatar else load_human()
                fitting = Fitting(rig, motion)
                moved = fitting.on_body(motion)
                return cls(moved, Figure.of(moved), skins, fitting.scale, fitting)
            except GestureKitError as error:
                warnings.warn(f"the mannequin is drawn instead of {body}: {error}", stacklevel=2)
        return cls(motion, Figure.of(motion, plain=body == "skeleton"))

    @cached_property
    def face(self) -> FaceTrack | None:
        """Channels of the motion's face that move the finest skin; None if there are none."""
        face, morphs = self.motion.face, self.skins[0].morphs if self.skins else {}
        names = tuple(name for name in morphs if face and name in face.names)
        return replace(face, names=names, values=values_of(face, names)) if face and names else None


def drawn_bodies(
    motion: Motion | Mapping[str, Motion],
    body: str | None,
    body_model: BodyModel | str | os.PathLike[str] | None = None,
) -> dict[str, DrawnBody]:
    """Return the `DrawnBody` of each motion by its label, that of a single one by "".

    Raises:
        MotionError: no motion.
    """
    motions = motion if isinstance(motion, Mapping) else {"": motion}
    if not motions:
        raise MotionError("no motion to show: the mapping of motions is empty")
    return {label: DrawnBody.of(each, body, body_model) for label, each in motions.items()}


def write_glb(
    motion: Motion,
    path: str | os.PathLike[str],
    *,
    body: str | None = None,
    body_model: BodyModel | str | os.PathLike[str] | None = None,
) -> None:
    """Write a binary glTF 2.0 file: skeleton, animation, a mesh, and the face as morph targets.

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
        content = animated_avatar(load_avatar(body)[0], drawn.motion, path.stem, drawn.scale)
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
        motion: the motion; it is put on the human body's bones, with fingers. Its face becomes
            expressions: VRM's vowels and blinks, and ARKit's names as custom ones.
        path: the .vrma file, written atomically.

    Raises:
        MotionError: body parts of the motion's rig cannot be found.
    """
    moved = Fitting(load_human()[0], motion).in_t_pose(motion)
    with atomic_write(path) as temporary:
        temporary.write_bytes(vrm_animation(moved, Path(path).stem))


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


_FINEST, _COARSE = 65_535, 5_000
"""Most vertices of the mesh in pages and videos, and of the one for slow machines."""


def load_avatar(path: str | os.PathLike[str]) -> tuple[Avatar, tuple[Skin, ...]]:
    """Read an avatar, with a fine and a coarse skin; the last ones are cached.

    Warns:
        UserWarning: a texture that cannot be read.

    Raises:
        FormatError: as `read_avatar` does.
    """
    path = Path(path)
    try:
        status = path.stat()
        version = status.st_mtime_ns, status.st_size
    except OSError:
        version = 0, 0  # the reader says what is wrong
    return _loaded(path.resolve(), version)


@lru_cache(maxsize=2)
def _loaded(path: Path, version: tuple[int, int]) -> tuple[Avatar, tuple[Skin, ...]]:
    avatar, mesh = read_avatar(path)
    assert mesh.regions is not None
    # Vertices of one place and colour become one, so that no seam is seen.
    welded = _clustered(mesh, _SAME * avatar.height, mesh.regions[:, None])
    finest = simplified(welded, _FINEST, avatar.height)
    return avatar, (finest, simplified(finest, _COARSE, avatar.height))


_FIRST, _GROWTH = 1 / 800, 1.25
"""Size of the first grid's cells by the body's height, and by which each next one is larger."""
_ROUNDS = 100
_SAME = 1e-5
"""Distance of vertices at one place, by the body's height."""


def simplified(skin: Skin, most: int, height: float) -> Skin:
    """Return a mesh of at most `most` vertices, of a body of this height in metres.

    Vertices of one cell of a grid that move with the same joint become one, so that fingers stay
    apart. The last of the grids has one cell a joint at most.
    """
    if len(skin.vertices) <= most:
        return skin
    cells = _FIRST * height * _GROWTH ** np.arange(_ROUNDS)
    apart = skin.joints[:, :1]
    k = bisect_left(cells[:-1], True, key=lambda cell: len(_groups(skin, cell, apart)[0]) <= most)
    return _clustered(skin, cells[k], apart)


def _groups(skin: Skin, cell: float, apart: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first vertex of each cell with the same numbers `apart`, and groups (V,)."""
    keys = np.floor(skin.vertices / cell).astype(np.int64)
    return unique_rows(np.concatenate([keys, apart], axis=1))


def _clustered(skin: Skin, cell: float, apart: np.ndarray) -> Skin:
    """Return the mesh with one vertex for those of a cell with the same numbers `apart` (V, N)."""
    first, groups = _groups(skin, cell, apart)
    counts = np.bincount(groups)
    vertices = np.stack(
        [np.bincount(groups, skin.vertices[:, axis]) / counts for axis in range(3)], axis=1
    )
    faces = groups[skin.faces]
    whole = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    return replace(
        skin,
        vertices=vertices,
        faces=faces[whole].astype(np.uint32),
        joints=skin.joints[first],
        weights=skin.weights[first],
        regions=None if skin.regions is None else skin.regions[first],
    )
