"""Can these be the parts of a body? What no rig of a person contradicts, checked for each."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.parts.joint_names import SIDES
from gesturekit.motion.skeleton import Skeleton

_CHAINS = (("clavicle", "shoulder", "elbow", "wrist"), ("hip", "knee", "ankle", "toe"))
_SIDES_DIFFER = 1.6
"""No left limb is longer than the right one, or the other way round, by more than this factor."""
_BONES_DIFFER = 3.5
"""No thigh is longer than its shank, or the other way round, by more; nor upper and lower arms."""


def check_limbs(skeleton: Skeleton, limbs: Mapping[str, int | None], guessed: bool) -> None:
    """See whether limbs hang together and have lengths that people's have.

    Args:
        skeleton: the rig.
        limbs: "left_elbow", ... to joint, None where the rig has none.
        guessed: named by hand or told by shape: then left and right are checked, too.

    Raises:
        MotionError: names the joints that cannot be what they were taken for.
    """
    told = {part: joint for part, joint in limbs.items() if joint is not None}
    taken: dict[int, str] = {}
    for part, joint in told.items():
        if joint in taken:
            raise MotionError(
                f"{skeleton.names[joint]!r} cannot be both {taken[joint]} and {part}; "
                f"name one of them by hand (parts: {part}: JOINT)"
            )
        taken[joint] = part
    for side in SIDES:
        for chain in _CHAINS:
            names = [f"{side}_{part}" for part in chain if f"{side}_{part}" in told]
            for above, below in zip(names, names[1:]):
                if told[above] not in skeleton.ancestors(told[below]):
                    raise _wrong(skeleton, told, below, above, "the one does not hang on the other")
    for part, joint in told.items():
        for start in ("left_shoulder", "right_shoulder", "left_hip", "right_hip"):
            own = part.split("_")[0] == start.split("_")[0]
            if not own and told.get(start) in skeleton.ancestors(joint):
                raise _wrong(skeleton, told, part, start, "the one hangs on the other")
    _check_lengths(skeleton, told)
    if guessed:
        _check_sides(skeleton, told)


def _check_lengths(skeleton: Skeleton, told: Mapping[str, int]) -> None:
    for chain, name in zip((_CHAINS[0][1:], _CHAINS[1][:3]), ("arm", "leg")):
        whole = {}
        for side in SIDES:
            parts = [f"{side}_{part}" for part in chain if f"{side}_{part}" in told]
            bones = [
                _length(skeleton, told[above], told[below])
                for above, below in zip(parts, parts[1:])
            ]
            whole[side] = sum(bones)
            if len(bones) == 2 and min(bones) > 0 and max(bones) > _BONES_DIFFER * min(bones):
                raise _wrong(
                    skeleton,
                    told,
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


def _check_sides(skeleton: Skeleton, told: Mapping[str, int]) -> None:
    """Toes point forward; where a rig stands at rest, that tells left from right."""
    places = skeleton.offsets.copy()
    for j, above in enumerate(skeleton.parents):
        places[j] = places[j] + places[above] if above >= 0 else 0.0
    at = {part: places[joint] for part, joint in told.items()}
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
            f"left and right seem exchanged: with {skeleton.names[told['left_hip']]!r} as its left "
            "hip the rig's toes point backwards"
        )


def _length(skeleton: Skeleton, above: int, below: int) -> float:
    """Metres along the joints from one to another that hangs on it."""
    way = [below, *skeleton.ancestors(below)]
    return float(np.linalg.norm(skeleton.offsets[way[: way.index(above)]], axis=1).sum())


def _wrong(skeleton: Skeleton, told: Mapping[str, int], a: str, b: str, reason: str) -> MotionError:
    return MotionError(
        f"{skeleton.names[told[a]]!r} cannot be the {a.replace('_', ' ')} with "
        f"{skeleton.names[told[b]]!r} as the {b.replace('_', ' ')}: {reason}; "
        f"name them by hand (parts: {a}: JOINT, ...)"
    )
