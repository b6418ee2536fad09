"""Rigs of the SMPL family: joint names, tree, and a rest pose that needs no body model.

The rest joints of the body models depend on `betas` and come with files that may not be
redistributed. Without them, joints are placed as on an adult of average build, 1.7 m tall, not
taken from any model; rotations are exact. With a body model, `fit_body` uses its joints.

The performer's body is the skeleton's `body_shape`; its betas are of the rig's shape space.

A rig of the family, or that of a file, is a target of retargeting (`Rig`).
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from audio_features.atomic import atomic_write
from gesturekit.errors import FormatError, MotionError
from gesturekit.formats.conventions import UP_TO_Y
from gesturekit.formats.gltf.scene import NoAnimationWarning
from gesturekit.motion.body_model import BodyModel
from gesturekit.motion.motion import Motion
from gesturekit.motion.retarget import retarget
from gesturekit.motion.retarget.body_frames import standing_pose
from gesturekit.motion.rotations import IDENTITY, rotate_vectors
from gesturekit.motion.skeleton import BodyShape, Skeleton

_BODY = (  # name, parent, offset (m): x to the left, Y up, +Z forward; right joints are mirrored
    ("pelvis", "", (0.0, 0.93, 0.0)),
    ("left_hip", "pelvis", (0.06, -0.09, -0.005)),
    ("spine1", "pelvis", (0.0, 0.11, -0.025)),
    ("left_knee", "left_hip", (0.045, -0.38, 0.0)),
    ("spine2", "spine1", (0.0, 0.135, 0.015)),
    ("left_ankle", "left_knee", (-0.015, -0.4, -0.035)),
    ("spine3", "spine2", (0.0, 0.055, 0.02)),
    ("left_foot", "left_ankle", (0.04, -0.06, 0.12)),
    ("neck", "spine3", (0.0, 0.215, -0.045)),
    ("left_collar", "spine3", (0.075, 0.115, -0.025)),
    ("head", "neck", (0.0, 0.09, 0.05)),
    ("left_shoulder", "left_collar", (0.1, 0.045, -0.015)),
    ("left_elbow", "left_shoulder", (0.26, -0.015, -0.025)),
    ("left_wrist", "left_elbow", (0.25, 0.01, 0.0)),
)
_HANDS = (("left_hand", "left_wrist", (0.085, -0.01, -0.015)),)
_FACE = (
    ("jaw", "head", (0.0, 0.005, 0.02)),
    ("left_eye_smplhf", "head", (0.032, 0.07, 0.075)),
)
_FINGERS = {  # place of the first joint and lengths of the next two steps (m)
    "index": ((0.1, 0.0, 0.025), (0.032, 0.022)),
    "middle": ((0.105, 0.005, 0.0), (0.031, 0.024)),
    "pinky": ((0.085, -0.01, -0.04), (0.02, 0.018)),
    "ring": ((0.095, 0.0, -0.022), (0.029, 0.024)),
    "thumb": ((0.03, -0.015, 0.03), (0.03, 0.025)),
}
N_JOINTS = (22, 24, 52, 55)
"""Sizes of rigs: body, SMPL (with hand stubs), SMPL-H (with fingers), SMPL-X (with face too)."""

RIGS = {"smpl": 24, "smplh": 52, "smplx": 55}
"""Joints of the rigs in which a file can be requested."""


def model_pelvis(n_joints: int) -> np.ndarray:
    """(3,) rest position of the pelvis in the model with that many joints, to a centimetre, metres.

    The origin of the models is in the chest. A file's `trans` is added to this position, whatever
    the root's rotation and the up axis.
    """
    return np.array((0.0, -0.35, 0.01) if n_joints == 55 else (0.0, -0.22, 0.03))


@cache
def smpl_skeleton(n_joints: int) -> Skeleton:
    """The rig of 22, 24, 52 or 55 joints, in the order of its pose vectors."""
    table = [*_BODY, *(_HANDS if n_joints == 24 else ()), *(_FACE if n_joints == 55 else ())]
    joints = [joint for left in table for joint in _both(*left)]
    if n_joints >= 52:
        for side in (0, 1):
            for finger, (first, steps) in _FINGERS.items():
                parent = "left_wrist"
                for n, offset in enumerate((first, *((step, 0.0, 0.0) for step in steps)), start=1):
                    joints.append(_both(f"left_{finger}{n}", parent, offset)[side])
                    parent = f"left_{finger}{n}"
    names = [name for name, _, _ in joints]
    return Skeleton(
        names=tuple(names),
        parents=tuple(names.index(parent) if parent else -1 for _, parent, _ in joints),
        offsets=np.array([offset for _, _, offset in joints]),
    )


def _both(name: str, parent: str, offset: Sequence[float]) -> list[tuple[str, str, Any]]:
    """Return a joint, and that of the right side if it is one of the left."""
    right = (name.replace("left", "right"), parent.replace("left", "right"))
    mirrored = np.array([-1.0, 1.0, 1.0]) * offset
    return [(name, parent, offset)] + [(*right, mirrored)] * name.startswith("left")


def is_smpl(skeleton: Skeleton) -> bool:
    """Return whether a rig has the joints and names of the SMPL family."""
    n = skeleton.n_joints
    if n not in N_JOINTS:
        return False
    rig = smpl_skeleton(n)
    return (skeleton.names, skeleton.parents) == (rig.names, rig.parents)


def as_smpl(motion: Motion, n_joints: int) -> Motion:
    """Return the motion on the SMPL rig with that many joints.

    From another rig of the family, shared joints keep their rotations, the pelvis keeps its
    position, and new joints (fingers, face, SMPL's hand stubs) stay at rest. SMPL and SMPL-H share
    one shape space; SMPL-X has another, so `betas` are dropped on conversion to or from it. Any
    other rig is retargeted.

    Warns:
        UserWarning: betas are dropped.

    Raises:
        MotionError: a rig that cannot be retargeted.
    """
    if motion.skeleton.n_joints == n_joints and is_smpl(motion.skeleton):
        return motion
    rig = smpl_skeleton(n_joints)
    if not is_smpl(motion.skeleton):
        return retarget(motion, rig)
    rotations = np.tile(IDENTITY, (motion.n_frames, n_joints, 1))
    old = motion.skeleton
    for j, name in enumerate(rig.names):
        if name in old.names:
            rotations[:, j] = motion.rotations[:, old.index(name)]
    shape = old.body_shape
    if (old.n_joints == 55) != (n_joints == 55):
        if shape.betas:
            text = "betas of SMPL and SMPL-H mean nothing in SMPL-X, nor its betas in theirs"
            warnings.warn(f"{text}: left out (--rig smpl, smplh or smplx)", stacklevel=2)
        shape = BodyShape(gender=shape.gender)
    rig = replace(rig, body_shape=shape)
    info = dict(motion.info)
    return replace(motion, skeleton=rig, rotations=rotations, info=info)


def fit_body(motion: Motion, body_model: BodyModel | str | os.PathLike[str]) -> Motion:
    """Return the motion on the rig of a body model, with its joints for the motion's `betas`.

    Six vertices of the feet become end sites of the foot joints, for `foot_points`.

    Args:
        motion: on a rig of the SMPL family, or one that can be retargeted to it.
        body_model: a model, its .npz file, or a folder of models (`BodyModel.of`).

    Warns:
        UserWarning: the model has fewer betas than the body.

    Raises:
        FormatError: a model of another family.
    """
    body = BodyModel.of(body_model, motion.skeleton)
    if body.n_joints not in N_JOINTS or body.parents != smpl_skeleton(body.n_joints).parents:
        raise FormatError(f"{body.source}: {body.n_joints} joints, not of the SMPL family")
    motion = as_smpl(motion, body.n_joints)
    known, had = body.shapes.shape[-1], len(motion.skeleton.body_shape.betas)
    if had > known:
        text = f"a model of {known} betas for a body of {had}; the others are ignored"
        warnings.warn(f"{body.source}: {text}", stacklevel=2)
    return on_body(motion, body.rig(motion.skeleton))


def on_body(motion: Motion, skeleton: Skeleton) -> Motion:
    """Return the motion on the body of another skeleton of its rig.

    The pelvis is moved to that body's rest position, so that a file's `trans` keeps its meaning.
    """
    shift, own, other = np.zeros(3), motion.skeleton.body_shape.pelvis, skeleton.body_shape.pelvis
    if own is not None and other is not None:
        turn = UP_TO_Y[motion.info.get("up", "y")]
        shift = rotate_vectors(turn, np.subtract(other, own))
    return replace(motion, skeleton=skeleton, translation=motion.translation + shift)


def mean_body(skeletons: Sequence[Skeleton]) -> Skeleton:
    """Return the body with the mean betas of several recordings of one person on one rig.

    A body model's joints and vertices at rest are affine in betas (Loper et al. 2015, eqs. 8 and
    10), so that the mean of bones is the exact bones of the mean betas. Recordings of another
    gender than most are left out, because their betas belong to another model.
    """
    genders = [skeleton.body_shape.gender for skeleton in skeletons]
    usual = max(genders, key=genders.count)
    bodies = [rig for rig in skeletons if rig.body_shape.gender == usual]
    shapes = [body.body_shape for body in bodies]
    longest = max(len(shape.betas) for shape in shapes)
    betas = [np.pad(shape.betas, (0, longest - len(shape.betas))) for shape in shapes]
    pelvises = [shape.pelvis for shape in shapes if shape.pelvis is not None]
    shape = replace(
        shapes[0],
        betas=tuple(np.mean(betas, axis=0)),
        pelvis=tuple(np.mean(pelvises, axis=0)) if pelvises else None,
    )
    ends = {
        name: tuple(np.mean([body.end_sites[name] for body in bodies], axis=0))
        for name in bodies[0].end_sites
    }
    offsets = np.mean([body.offsets for body in bodies], axis=0)
    return replace(bodies[0], offsets=offsets, end_sites=ends, body_shape=shape)


@dataclass(frozen=True, eq=False)
class Rig:
    """Target rig of retargeting.

    Attributes:
        name: a file, or smpl, smplh or smplx.
        skeleton: its J joints.
        pose: (J, 4) local rotations in which it stands; None for a rig of the SMPL family.
    """

    name: str
    skeleton: Skeleton
    pose: np.ndarray | None = None

    @classmethod
    def load(cls, name: str | os.PathLike[str], parts: Mapping[str, str] | None = None) -> Rig:
        """Load the rig of a motion file, or one of the SMPL family by name.

        Args:
            name: the file, or smpl, smplh or smplx.
            parts: joints of the file specified by hand, see `Skeleton.parts`.

        Raises:
            FormatError: there is no such file, or it cannot be read.
            MotionError: the file's parts cannot be identified, it never stands, or `parts` are
                given for an SMPL rig, whose parts are known.
        """
        name, parts = os.fspath(name), parts or {}
        if name in RIGS:
            if parts:
                raise MotionError(f"the parts of {name} are fixed; leave out {', '.join(parts)}")
            return cls(name, smpl_skeleton(RIGS[name]))
        if not Path(name).exists():
            raise FormatError(f"rig {name!r}: no such file; expected one, or {', '.join(RIGS)}")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NoAnimationWarning)  # a rest pose is enough
            motion = Motion.load(name)
        try:
            motion = motion.with_parts(parts)
            return cls(Path(name).name, motion.skeleton, standing_pose(motion))
        except MotionError as error:
            raise MotionError(f"{name}: {error}") from None

    @property
    def options(self) -> dict[str, dict[str, str]]:
        """Options of writers by suffix: an npz file has the pose vectors of the chosen SMPL rig."""
        return {".npz": {"rig": self.name}} if self.pose is None else {}

    def put(self, motion: Motion) -> Motion:
        """Retarget a motion to this rig; within the SMPL family, copy joints by name.

        Raises:
            MotionError: parts of the motion's rig cannot be identified, or it never stands.
        """
        if self.pose is None and is_smpl(motion.skeleton):
            return as_smpl(motion, self.skeleton.n_joints)
        return retarget(motion, self.skeleton, pose=self.pose)


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
        raise FormatError(f"{path}: an obj needs a body model (--body-model SMPLX_NEUTRAL.npz)")
    if not -motion.n_frames <= frame < motion.n_frames:
        raise FormatError(f"{path}: frame {frame} of a motion of {motion.n_frames} frames")
    frame %= motion.n_frames
    body = BodyModel.of(body_model, motion.skeleton)
    (skin,) = body.vertices(fit_body(motion[frame : frame + 1], body))
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8") as out:
        np.savetxt(out, skin, fmt="v %.6f %.6f %.6f")
        np.savetxt(out, body.faces + 1, fmt="f %d %d %d")
