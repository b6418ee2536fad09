"""One rig for both motions of a clip: common joints by name, or retargeting to the recording's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion import Motion
from gesturekit.motion.parts import body_joints, find_legs, is_upper_body, leg_joints
from gesturekit.motion.parts.body_size import body_scale
from gesturekit.motion.retarget import retarget
from gesturekit.motion.rotations import IDENTITY
from gesturekit.motion.skeleton import Skeleton, forward_kinematics

MATCHED = 0.5
"""Rigs match if at least this fraction of the recording's body joints is found by name."""
SAME_BONES = 0.05
"""Largest relative difference of the bones of one body."""
RETARGETED = "another rig: retargeted to the recording's before it was measured"
"""Note on a clip."""

_SHORTEST = 0.01  # metres on the reference body; shorter bones differ by rounding


def matched(motion: Motion, recording: Motion) -> tuple[tuple[str, ...], Motion, list[str]]:
    """Return a generated motion on the rig of its recording.

    The legs of the recording are not compared with a motion that has none. A rig with joints of the
    same names (in any case, in any name space) and bones of the same
    lengths is cut to the common joints. Any other is retargeted or, where its body parts cannot be
    identified, compared by name.

    Returns:
        the common body joints, in the recording's order; the motion with the recording's joint
        names; notes.

    Raises:
        MotionError: neither joints of the same names nor body parts are found, or the recording has
            a single body joint.
    """
    rig = recording.skeleton
    names = body_joints(rig)
    if len(names) < 2:
        raise MotionError("the recording has 1 body joint; a motion to be measured has at least 2")
    legs = leg_joints(rig, find_legs(rig) or {}) if is_upper_body(motion.skeleton) else set()
    names = tuple(name for name in names if name not in legs)
    own = {without_namespace(name): name for name in reversed(motion.skeleton.names)}
    renamed = {
        own[without_namespace(name)]: name for name in names if without_namespace(name) in own
    }
    found = set(renamed.values())
    joints = tuple(name for name in names if name in found)
    by_name = len(joints) >= max(2, MATCHED * len(names))
    named = _renamed(motion, renamed) if by_name else motion
    notes = ["the generated rig has no legs"] if legs else []
    if not by_name or not _same_bones(named, recording, joints):
        try:
            moved = retarget(motion, rig)
            if legs:  # they would be measured as if they had been generated
                moved = moved.keep([name for name in rig.names if name not in legs])
            return names, moved, [RETARGETED, *notes]
        except MotionError as error:
            if not by_name:
                missing = [name for name in names if name not in found]
                raise MotionError(
                    f"rigs do not match: {len(joints)} of {len(names)} body joints of the "
                    f"recording are found by name (missing: {', '.join(missing[:5])} ...), and it "
                    f"cannot be retargeted: {error}"
                ) from None
            notes.append(f"another body, which cannot be retargeted ({error})")
    if len(joints) < len(names):
        notes.append(
            f"{len(names) - len(joints)} of {len(names)} body joints are not in the generated rig"
        )
    return joints, named, notes


def without_namespace(name: str) -> str:
    """Return a joint name in lower case without name space: `leftarm` for `mixamorig:LeftArm`."""
    return name.rpartition(":")[2].lower()


def _renamed(motion: Motion, renamed: dict[str, str]) -> Motion:
    """Return the motion with other joint names, {own name: new name}."""
    if all(old == new for old, new in renamed.items()):
        return motion
    skeleton = motion.skeleton
    rename = {name: renamed.get(name, name) for name in skeleton.names}
    rig = replace(
        skeleton,
        names=tuple(rename.values()),
        end_sites={rename[name]: sites for name, sites in skeleton.end_sites.items()},
    )
    moved = {rename[name]: places for name, places in motion.joint_translations.items()}
    return replace(motion, skeleton=rig, joint_translations=moved)


def _same_bones(motion: Motion, recording: Motion, joints: tuple[str, ...]) -> bool:
    """Return whether distances between neighbours among common joints agree, at rest."""
    one, other = motion.skeleton, recording.skeleton
    moving = {*motion.joint_translations, *recording.joint_translations}
    known = {other.index(name) for name in joints}
    pairs = []
    for j in known:
        above = next((a for a in other.ancestors(j) if a in known), None)
        if above is not None and other.names[j] not in moving:
            pairs.append((other.names[above], other.names[j]))
    own, wanted = _distances(one, pairs), _distances(other, pairs)
    rounding = _SHORTEST * body_scale(other)
    return bool(np.allclose(own, wanted, rtol=SAME_BONES, atol=rounding))


def _distances(rig: Skeleton, pairs: list[tuple[str, str]]) -> np.ndarray:
    rest = np.broadcast_to(IDENTITY, (rig.n_joints, 4))
    places = forward_kinematics(rest, np.zeros(3), rig)
    ends = np.array([[rig.index(name) for name in pair] for pair in pairs]).reshape(-1, 2)
    return np.linalg.norm(places[ends[:, 1]] - places[ends[:, 0]], axis=-1)
