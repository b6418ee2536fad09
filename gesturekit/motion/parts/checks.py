"""Plausibility checks of identified limbs: tree structure, bone lengths, left and right."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.parts.joint_names import SIDES
from gesturekit.motion.skeleton import Skeleton

_CHAINS = (("clavicle", "shoulder", "elbow", "wrist"), ("hip", "knee", "ankle", "toe"))
_SIDES_DIFFER = 1.6
"""Largest plausible ratio of the lengths of a left and a right limb."""
_BONES_DIFFER = 3.5
"""Largest plausible ratio of thigh and shank, or of upper arm and forearm."""


def check_limbs(skeleton: Skeleton, limbs: Mapping[str, int | None], guessed: bool) -> None:
    """Check that limbs are connected and have the proportions of a person.

    Args:
        skeleton: the rig.
        limbs: "left_elbow", ... to joint; None if the rig has none.
        guessed: limbs come from shape or from the user, so that left and right are checked too.

    Raises:
        MotionError: implausible parts; the message names the joints.
    """
    known = {part: joint for part, joint in limbs.items() if joint is not None}
    taken: dict[int, str] = {}
    for part, joint in known.items():
        if joint in taken:
            raise MotionError(
                f"{skeleton.names[joint]!r} cannot be both {taken[joint]} and {part}; "
                f"name one of them by hand (parts: {part}: JOINT)"
            )
        taken[joint] = part
    for side in SIDES:
        for chain in _CHAINS:
            names = [f"{side}_{part}" for part in chain if f"{side}_{part}" in known]
            for above, below in zip(names, names[1:]):
                if known[above] not in skeleton.ancestors(known[below]):
                    raise _wrong(
                        skeleton, known, below, above, "the one does not hang on the other"
                    )
    for part, joint in known.items():
        for start in ("left_shoulder", "right_shoulder", "left_hip", "right_hip"):
            own = part.split("_")[0] == start.split("_")[0]
            if not own and known.get(start) in skeleton.ancestors(joint):
                raise _wrong(skeleton, known, part, start, "the one hangs on the other")
    _check_lengths(skeleton, known)
    if guessed:
        _check_sides(skeleton, known)


def _check_lengths(skeleton: Skeleton, known: Mapping[str, int]) -> None:
    """Raise MotionError for implausible bone lengths."""
    for chain, name in zip((_CHAINS[0][1:], _CHAINS[1][:3]), ("arm", "leg")):
        whole = {}
        for side in SIDES:
            parts = [f"{side}_{part}" for part in chain if f"{side}_{part}" in known]
            bones = [
                bone_length(skeleton, known[above], known[below])
                for above, below in zip(parts, parts[1:])
            ]
            whole[side] = sum(bones)
            if len(bones) == 2 and min(bones) > 0 and max(bones) > _BONES_DIFFER * min(bones):
                raise _wrong(
                    skeleton,
                    known,
                    parts[1],
                    parts[0],
                    f"bones of {bones[0]:.2f} and {bones[1]:.2f} m",
                )
        if min(whole.values()) > 0 and max(whole.values()) > _SIDES_DIFFER * min(whole.values()):
            raise MotionError(
                f"the left {name} would be {whole['left']:.2f} m long, the right one "
                f"{whole['right']:.2f} m; name its joints by hand "
                f"(parts: left_{chain[1]}: JOINT, ...)"
            )


def _check_sides(skeleton: Skeleton, known: Mapping[str, int]) -> None:
    """Raise MotionError if the toes of a rig that stands at rest contradict left and right."""
    if "left_hip" not in known:
        return
    places = skeleton.offsets.copy()
    for j, above in enumerate(skeleton.parents):
        places[j] = places[j] + places[above] if above >= 0 else 0.0
    at = {part: places[joint] for part, joint in known.items()}
    hips = at["left_hip"] - at["right_hip"]
    trunk = at["left_shoulder"] + at["right_shoulder"] - at["left_hip"] - at["right_hip"]
    legs = sum(at[f"{side}_ankle"] - at[f"{side}_hip"] for side in SIDES)
    if -(trunk @ legs) < 0.7 * np.linalg.norm(trunk) * np.linalg.norm(legs):
        return
    ahead = np.cross(hips, trunk)
    toes = [at[f"{s}_toe"] - at[f"{s}_ankle"] for s in SIDES if f"{s}_toe" in at]
    if not toes or not np.linalg.norm(ahead):
        return
    if all(toe @ ahead < -0.3 * np.linalg.norm(toe) * np.linalg.norm(ahead) for toe in toes):
        raise MotionError(
            f"left and right seem exchanged: with {skeleton.names[known['left_hip']]!r} as its "
            "left hip the rig's toes point backwards"
        )


def bone_length(skeleton: Skeleton, above: int, below: int) -> float:
    """Return metres along the bones from a joint to one of its descendants."""
    chain = [below, *skeleton.ancestors(below)]
    return float(np.linalg.norm(skeleton.offsets[chain[: chain.index(above)]], axis=1).sum())


def _wrong(
    skeleton: Skeleton, known: Mapping[str, int], a: str, b: str, reason: str
) -> MotionError:
    return MotionError(
        f"{skeleton.names[known[a]]!r} cannot be the {a.replace('_', ' ')} with "
        f"{skeleton.names[known[b]]!r} as the {b.replace('_', ' ')}: {reason}; "
        f"name them by hand (parts: {a}: JOINT, ...)"
    )
