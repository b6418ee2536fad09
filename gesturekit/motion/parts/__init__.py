"""Body parts of a rig, which joint is the head, a hand, a knee, by names and shape (`finder`)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress

import numpy as np

from gesturekit.errors import MotionError
from gesturekit.motion.parts.finder import (
    KNOWN_PARTS,
    Arm,
    BodyParts,
    Leg,
    PartFinder,
    bone_length,
    find_legs,
    find_parts,
    known_parts,
    named_pairs,
    require_legs,
)
from gesturekit.motion.parts.limbs import SIDES, Limbs
from gesturekit.motion.skeleton import Skeleton

__all__ = [
    "KNOWN_PARTS",
    "SIDES",
    "Arm",
    "BodyParts",
    "Leg",
    "ankle_joints",
    "arm_joints",
    "arm_length",
    "body_joints",
    "find_legs",
    "find_parts",
    "heading_joints",
    "is_upper_body",
    "known_part_labels",
    "known_parts",
    "left_right_pairs",
    "leg_joints",
    "leg_length",
    "parse_parts",
    "part_labels",
    "require_legs",
    "unidentified",
    "upper_body",
]


def left_right_pairs(skeleton: Skeleton) -> tuple[tuple[str, str], ...]:
    """Return (left, right) names of joints that are mirror images, in the order of left joints.

    They are found by name, or by the shape of the rig if no name has a side. Limbs specified by
    hand (`Skeleton.parts`) take precedence, together with their ancestors. A joint without a
    counterpart is in the middle of the body.
    """
    by_hand = dict(_pairs_by_hand(skeleton))
    specified = {*by_hand, *by_hand.values()}
    pairs = named_pairs(skeleton)
    if not pairs:
        with suppress(MotionError):
            shape = Limbs(skeleton).pairs
            pairs = tuple((skeleton.names[a], skeleton.names[b]) for a, b in shape)
    pairs = [*by_hand.items(), *(pair for pair in pairs if specified.isdisjoint(pair))]
    return tuple(sorted(pairs, key=lambda pair: skeleton.index(pair[0])))


def _pairs_by_hand(skeleton: Skeleton) -> Iterator[tuple[str, str]]:
    """Yield (left, right) of limbs specified by hand, and of their ancestors below a common one."""
    for part, name in skeleton.parts.items():
        side, _, kind = part.partition("_")
        if side != "left" or f"right_{kind}" not in skeleton.parts:
            continue
        left, right = skeleton.index(name), skeleton.index(skeleton.parts[f"right_{kind}"])
        chains = [[j, *skeleton.ancestors(j)] for j in (left, right)]
        sides = [[j for j in a if j not in b] for a, b in (chains, chains[::-1])]
        if len(sides[0]) == len(sides[1]):
            yield from ((skeleton.names[a], skeleton.names[b]) for a, b in zip(*sides))


def ankle_joints(skeleton: Skeleton) -> list[int]:
    """Return the joints of the left and right ankle; none without legs."""
    legs = find_legs(skeleton) or {}
    return [skeleton.index(leg.ankle) for leg in legs.values()]


def leg_joints(skeleton: Skeleton, legs: Mapping[str, Leg]) -> set[str]:
    """Return the names of all joints of these legs, from the hips down; none without legs."""
    hips = [skeleton.index(leg.hip) for leg in legs.values()]
    return {skeleton.names[j] for hip in hips for j in (hip, *skeleton.descendants(hip))}


def is_upper_body(skeleton: Skeleton) -> bool:
    """Return whether all parts of a rig can be identified, and it has no legs."""
    parts = known_parts(skeleton)
    return parts is not None and not parts.legs


def heading_joints(skeleton: Skeleton) -> tuple[str, str] | None:
    """Return the left and right joint whose line faces sideways: hips, or shoulders without legs.

    None if the rig has no legs that can be identified, and other parts that cannot either.
    """
    if legs := find_legs(skeleton):
        return legs["left"].hip, legs["right"].hip
    if parts := known_parts(skeleton):
        return parts.arms["left"].shoulder, parts.arms["right"].shoulder
    return None


def unidentified(skeleton: Skeleton) -> str:
    """Return the limbs that cannot be identified, in words; "" if all parts are found.

    A rig without legs lacks nothing.
    """
    if known_parts(skeleton):
        return ""
    return "arms or trunk" if find_legs(skeleton) else "legs, arms or trunk"


def parse_parts(texts: Iterable[str]) -> dict[str, str]:
    """Parse parts given on a command line: "left_elbow=Joint12" to {"left_elbow": "Joint12"}.

    Raises:
        MotionError: no such part, or no joint.
    """
    parts = {}
    for text in texts:
        part, _, joint = text.partition("=")
        if part not in KNOWN_PARTS or not joint:
            known = ", ".join(KNOWN_PARTS)
            raise MotionError(f"part {text!r}; expected PART=JOINT, PART of {known}")
        parts[part] = joint
    return parts


def part_labels(skeleton: Skeleton) -> dict[str, str]:
    """Return a map from each joint's name to its body part in words, in the order of joints.

    Labels are "pelvis", "spine", "neck", "head", "left elbow" and so on, "finger", "face", "end"
    (marks the end of a bone), "twist" (rotates about its bone), "root" (above the pelvis), "other".

    Raises:
        MotionError: see `find_parts`.
    """
    return _labels(PartFinder.complete(skeleton))


def known_part_labels(skeleton: Skeleton) -> tuple[dict[str, str], str]:
    """Return `part_labels` of the parts that can be identified, and a message about the others.

    If no part can be identified, the labels are empty; if all can, the message is empty.
    """
    try:
        return part_labels(skeleton), ""
    except MotionError as error:
        reason = str(error)
    finder = PartFinder.partial(skeleton)
    if finder.missing and not any(repr(name) in reason for name in skeleton.parts.values()):
        reason = (
            f"cannot identify the {finder.missing_limbs()}: specify them if the rig has them, as "
            f"in --part {finder.missing[0]}=JOINT; without them, losses and metrics of arms and "
            "feet are left out"
        )
    labels = _labels(finder)
    is_body = set(labels.values()) - {"other", "root", "end", "twist"}
    return (labels if is_body else {}), reason


def _labels(finder: PartFinder) -> dict[str, str]:
    """Return a map from joint names to body parts in words; later assignments override."""
    skeleton = finder.skeleton
    pelvis, head = ([] if j is None else [j] for j in (finder.pelvis, finder.head))
    labels = dict.fromkeys(range(skeleton.n_joints), "other")
    for joints, label in (
        ([j for joint in pelvis for j in skeleton.ancestors(joint)], "root"),
        (finder.helpers(), "twist"),
        (finder.fingers(), "finger"),
        ([j for joint in head for j in skeleton.descendants(joint)], "face"),
        (finder.ends, "end"),
        (pelvis, "pelvis"),
        (finder.spine, "spine"),
        (finder.neck, "neck"),
        (head, "head"),
    ):
        labels |= dict.fromkeys(joints, label)
    for part, joint in finder.limbs.items():
        if joint is not None:
            labels[joint] = part.replace("_", " ")
    return {name: labels[j] for j, name in enumerate(skeleton.names)}


def body_joints(skeleton: Skeleton) -> tuple[str, ...]:
    """Return the names of all joints except fingers, face and end joints, in order.

    A rig whose parts cannot be identified keeps all joints.
    """
    parts = known_parts(skeleton)
    left_out = {*parts.fingers, *parts.face, *parts.ends} if parts else set()
    return tuple(name for name in skeleton.names if name not in left_out)


def upper_body(skeleton: Skeleton) -> tuple[str, ...]:
    """Return the names of the first spine joint and its descendants: spine, neck, head, arms."""
    first = skeleton.index(find_parts(skeleton).spine[0])
    return tuple(skeleton.names[j] for j in (first, *skeleton.descendants(first)))


def leg_length(skeleton: Skeleton) -> float:
    """Return the length of thigh and shank, mean of both sides, metres.

    Raises:
        MotionError: two legs cannot be identified, or the rig has none.
    """
    legs = require_legs(skeleton)
    bones: list[int] = []
    for leg in legs.values():
        ankle, hip = skeleton.index(leg.ankle), skeleton.index(leg.hip)
        # Twist joints may split a bone, so add up all bones between hip and ankle.
        chain = [ankle, *skeleton.ancestors(ankle)]
        bones += chain[: chain.index(hip)]
    return float(np.linalg.norm(skeleton.offsets[bones], axis=1).sum() / 2)


def arm_length(skeleton: Skeleton) -> tuple[float, float]:
    """Return the lengths of upper arm and forearm, means of both sides, metres.

    The forearm has length 0 on a rig that lacks a wrist.

    Raises:
        MotionError: parts that cannot be identified; see `find_parts`.
    """
    arms = find_parts(skeleton).arms.values()

    def mean(bones: list[tuple[str, str]]) -> float:
        indexed = [(skeleton.index(above), skeleton.index(below)) for above, below in bones]
        return sum(bone_length(skeleton, *bone) for bone in indexed) / 2

    upper = mean([(arm.shoulder, arm.elbow) for arm in arms])
    lower = [(arm.elbow, arm.wrist) for arm in arms if arm.wrist is not None]
    return upper, mean(lower) if len(lower) == 2 else 0.0


def arm_joints(skeleton: Skeleton) -> tuple[str, str, str, str]:
    """Return the names of left shoulder, left elbow, right shoulder and right elbow."""
    arms = find_parts(skeleton).arms
    left, right = arms["left"], arms["right"]
    return left.shoulder, left.elbow, right.shoulder, right.elbow
