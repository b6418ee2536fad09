"""Body with which a motion is drawn in pages, videos and pictures."""

from __future__ import annotations

import os
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING

from gesturekit.errors import FormatError, GestureKitError
from gesturekit.formats.gltf.skin import Skin
from gesturekit.formats.smpl import fit_body
from gesturekit.motion.body_model import BodyModel
from gesturekit.viewer.avatars import load_avatar
from gesturekit.viewer.figure import Figure
from gesturekit.viewer.human.body import Fitting, Human

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
            UserWarning: the human body was not baked, or the motion cannot be retargeted to a body.
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
            avatar = None if body == "human" else load_avatar(body)[0]
            try:
                human = avatar or Human.load()
                fitting = Fitting(human, motion)
                moved = fitting.on_body(motion)
                return cls(moved, Figure.of(moved), human.skins, fitting.scale, fitting)
            except GestureKitError as error:
                warnings.warn(f"the mannequin is drawn instead of {body}: {error}", stacklevel=2)
        return cls(motion, Figure.of(motion, plain=body == "skeleton"))
