"""Body parts of a rig: which joint is the head, a hand, a knee."""

from gesturekit.motion.parts.body_parts import (
    Arm,
    BodyParts,
    Leg,
    arm_joints,
    arm_length,
    body_joints,
    find_legs,
    find_parts,
    heading_joints,
    is_upper_body,
    known_part_labels,
    left_right_pairs,
    leg_joints,
    leg_length,
    parse_parts,
    part_labels,
    require_legs,
    unidentified,
    upper_body,
)
from gesturekit.motion.parts.finder import KNOWN_PARTS
from gesturekit.motion.parts.joint_names import SIDES

__all__ = [
    "KNOWN_PARTS",
    "SIDES",
    "Arm",
    "BodyParts",
    "Leg",
    "arm_joints",
    "arm_length",
    "body_joints",
    "find_legs",
    "find_parts",
    "heading_joints",
    "is_upper_body",
    "known_part_labels",
    "left_right_pairs",
    "leg_joints",
    "leg_length",
    "parse_parts",
    "part_labels",
    "require_legs",
    "unidentified",
    "upper_body",
]
