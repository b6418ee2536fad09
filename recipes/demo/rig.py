"""The demo's body: a humanoid of 1.70 m, with or without fingers, and the inverse kinematics.

T-pose, Y up, facing +Z, its left along +X, metres. A stroke of the hand is planned where it is
seen, as a path of the wrist in front of the chest; two-bone inverse kinematics turns it into
shoulder and elbow rotations that keep anatomy: the elbow is a hinge, pronation turns the
forearm about its own length. The legs hang between a moving pelvis and feet that stand still.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from gesturekit.motion.motion import Motion
from gesturekit.motion.skeleton import Skeleton

# name, parent, offset from the parent in metres (left side; the right is mirrored)
_JOINTS = (
    ("Hips", None, (0.0, 0.0, 0.0)),
    ("Spine", "Hips", (0.0, 0.09, 0.0)),
    ("Spine1", "Spine", (0.0, 0.12, 0.0)),
    ("Spine2", "Spine1", (0.0, 0.13, 0.0)),
    ("Neck", "Spine2", (0.0, 0.17, 0.0)),
    ("Head", "Neck", (0.0, 0.09, 0.01)),
    ("LeftShoulder", "Spine2", (0.05, 0.12, 0.0)),
    ("LeftArm", "LeftShoulder", (0.13, 0.0, 0.0)),
    ("LeftForeArm", "LeftArm", (0.28, 0.0, 0.0)),
    ("LeftHand", "LeftForeArm", (0.25, 0.0, 0.0)),
    ("RightShoulder", "Spine2", (-0.05, 0.12, 0.0)),
    ("RightArm", "RightShoulder", (-0.13, 0.0, 0.0)),
    ("RightForeArm", "RightArm", (-0.28, 0.0, 0.0)),
    ("RightHand", "RightForeArm", (-0.25, 0.0, 0.0)),
    ("LeftUpLeg", "Hips", (0.09, -0.04, 0.0)),
    ("LeftLeg", "LeftUpLeg", (0.0, -0.42, 0.0)),
    ("LeftFoot", "LeftLeg", (0.0, -0.40, 0.0)),
    ("LeftToeBase", "LeftFoot", (0.0, -0.06, 0.13)),
    ("RightUpLeg", "Hips", (-0.09, -0.04, 0.0)),
    ("RightLeg", "RightUpLeg", (0.0, -0.42, 0.0)),
    ("RightFoot", "RightLeg", (0.0, -0.40, 0.0)),
    ("RightToeBase", "RightFoot", (0.0, -0.06, 0.13)),
)
_END_SITES = {
    "Head": (0.0, 0.16, 0.0),
    "LeftHand": (0.17, 0.0, 0.0),
    "RightHand": (-0.17, 0.0, 0.0),
    "LeftToeBase": (0.0, 0.0, 0.07),
    "RightToeBase": (0.0, 0.0, 0.07),
}
_FINGERS = {
    "Thumb": ((0.026, -0.010, 0.026), (0.040, 0.031, 0.024)),
    "Index": ((0.086, 0.002, 0.024), (0.040, 0.024, 0.019)),
    "Middle": ((0.088, 0.004, 0.003), (0.043, 0.027, 0.020)),
    "Ring": ((0.083, 0.002, -0.016), (0.040, 0.026, 0.020)),
    "Pinky": ((0.077, -0.002, -0.034), (0.031, 0.019, 0.018)),
}
"""Left knuckles from the wrist, and the lengths of the bones from there to the tip, metres."""
_THUMB = np.array([0.66, -0.22, 0.72])
"""Direction of the left thumb; other fingers lie along +X."""
_UPPER_ARM, _FOREARM, _THIGH, _SHIN = 0.28, 0.25, 0.42, 0.40

HAND_SHAPES = {
    "relaxed": (0.30, 0.20, 0.26, 0.34, 0.40, 0.44, 0.25),
    "open": (0.05, 0.02, 0.02, 0.03, 0.05, 0.07, 0.9),
    "pointing": (0.60, 0.75, 0.02, 0.82, 0.90, 0.92, 0.0),
    "precision": (0.95, 0.30, 0.50, 0.40, 0.34, 0.30, 0.35),
    "fist": (0.80, 0.80, 0.92, 0.95, 0.97, 0.98, 0.0),
}
"""Hand shapes: opposition of the thumb, flexion of thumb, index, middle, ring and little finger,
and spread. 0 to 1 is the range that a hand has without force."""
_OPPOSITION, _SPREAD = np.radians(50.0), np.radians([9.0, 1.0, -7.0, -15.0])
_FLEXION = np.radians([[20.0, 45.0, 60.0], *[[80.0, 100.0, 62.0]] * 4])
"""Angles of a finger's three joints at full flexion: thumb first."""

SHOULDER = np.array([0.18, 0.12, 0.0])
"""The left shoulder joint seen from the chest (Spine2), at rest."""
STANDING_HEIGHT = 0.936
"""Height of the hips: 4 mm below a straight-legged stand, which leaves the knees soft."""
_ANKLE = np.array([0.11, 0.08, 0.0])
_TOES_OUT = np.radians(8.0)
ELBOW_POLE = np.array([0.30, -0.60, -0.74])
"""Direction of the left elbow of a hand at the waist: down and back, a little outward."""


@dataclass
class Arm:
    """One arm over T frames, described as a left arm; a right arm is its mirror image.

    wrist: (T, 3) m in the chest's frame; twist: (T,) rad of the forearm, negative turns the
    palm up; extension: (T,) rad of the wrist, positive lifts the hand; lift: (T,) rad of the
    shoulder girdle, positive is a shrug; pole: (3,) or (T, 3) direction in the chest's frame
    towards which the elbow points, as far as the wrist leaves it free; fingers: (T, 7), see
    `HAND_SHAPES`, or None for a rig without fingers.
    """

    wrist: np.ndarray
    twist: np.ndarray
    extension: np.ndarray
    lift: np.ndarray
    pole: np.ndarray = field(default_factory=ELBOW_POLE.copy)
    fingers: np.ndarray | None = None


def skeleton(fingers: bool = False) -> Skeleton:
    """The rig: 22 joints, or 52 with fingers, 1.70 m from the floor to the top of the head."""
    joints, ends = list(_JOINTS), dict(_END_SITES)
    for side, mirror in (("Left", 1.0), ("Right", np.array([-1.0, 1.0, 1.0]))) if fingers else ():
        del ends[f"{side}Hand"]
        for finger, (knuckle, lengths) in _FINGERS.items():
            along = _unit(_THUMB) if finger == "Thumb" else np.array([1.0, 0.0, 0.0])
            parent, offset = f"{side}Hand", np.array(knuckle)
            for k, length in enumerate(lengths, start=1):
                joints.append((f"{side}Hand{finger}{k}", parent, mirror * offset))
                parent, offset = joints[-1][0], length * along
            ends[parent] = mirror * offset
    names = tuple(name for name, _, _ in joints)
    return Skeleton(
        names=names,
        parents=tuple(-1 if parent is None else names.index(parent) for _, parent, _ in joints),
        offsets=np.array([offset for _, _, offset in joints]),
        end_sites={name: (np.array(offset),) for name, offset in ends.items()},
        rotation_orders=("ZXY",) * len(names),
    )


def pose(
    fps: float,
    hips: np.ndarray,
    pelvis: Rotation,
    spine: np.ndarray,
    head: np.ndarray,
    left: Arm,
    right: Arm,
) -> Motion:
    """A motion of T frames from what the talker plans.

    hips: (T, 3) m in the world; pelvis: T rotations; spine, head: (T, 3) rad of pitch (forward
    is positive), yaw (to its left) and roll, shared out over three spine joints and over neck
    and head; left, right: the arms.
    """
    rig = skeleton(fingers=left.fingers is not None)
    quaternions = np.zeros((len(hips), len(rig.names), 4))
    quaternions[..., 3] = 1.0

    def put(name: str, rotation: Rotation) -> None:
        quaternions[:, rig.names.index(name)] = rotation.as_quat()

    put("Hips", pelvis)
    for name in ("Spine", "Spine1", "Spine2"):
        put(name, bend(spine / 3))
    for name in ("Neck", "Head"):
        put(name, bend(head / 2))
    for side, arm in (("Left", left), ("Right", right)):
        for name, rotation in zip(("Shoulder", "Arm", "ForeArm", "Hand"), _arm(arm), strict=True):
            put(side + name, rotation if side == "Left" else mirrored(rotation))
        for name, rotation in {} if arm.fingers is None else _fingers(arm.fingers).items():
            put(f"{side}Hand{name}", rotation if side == "Left" else mirrored(rotation))
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        for name, rotation in zip(("UpLeg", "Leg", "Foot"), _leg(hips, pelvis, sign), strict=True):
            put(side + name, rotation)
    return Motion(skeleton=rig, rotations=quaternions, translation=hips, fps=fps)


def bend(angles: np.ndarray) -> Rotation:
    """Pitch, yaw and roll (T, 3) as rotations about x, y and z."""
    return Rotation.from_euler("YXZ", angles[:, [1, 0, 2]])


def _about(axis: str, angle: np.ndarray) -> Rotation:
    return Rotation.from_euler(axis, np.asarray(angle)[..., None])


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def _bone_angles(distance: np.ndarray, first: float, second: float):
    """Angle between the first bone and the line to its target, and the bend of the joint.

    Law of cosines. The very end of the reach is never used: there the bend changes without bound.
    """
    distance = np.clip(distance, abs(first - second) + 0.05, 0.999 * (first + second))
    lead = np.arccos((first**2 + distance**2 - second**2) / (2 * first * distance))
    inside = np.arccos((first**2 + second**2 - distance**2) / (2 * first * second))
    return lead[:, None], np.pi - inside


def _arm(arm: Arm) -> tuple[Rotation, Rotation, Rotation, Rotation]:
    """Local rotations of a left arm: shoulder girdle, upper arm, forearm, hand."""
    girdle = _about("z", arm.lift)
    base = np.array([0.05, 0.12, 0.0])
    reach = girdle.inv().apply(arm.wrist - base) - (SHOULDER - base)
    axis = _unit(reach)
    lead, bend = _bone_angles(np.linalg.norm(reach, axis=1), _UPPER_ARM, _FOREARM)
    pole = arm.pole - np.sum(axis * arm.pole, axis=1, keepdims=True) * axis
    pole = _unit(pole)
    # The upper arm's own axes: x along the bone, z towards which the elbow folds.
    x = np.cos(lead) * axis + np.sin(lead) * pole
    z = np.sin(lead) * axis - np.cos(lead) * pole
    upper = Rotation.from_matrix(np.stack([x, np.cross(z, x), z], axis=-1))
    forearm = _about("y", -bend) * _about("x", arm.twist)
    return girdle, upper, forearm, _about("z", arm.extension)


def _fingers(shape: np.ndarray) -> dict[str, Rotation]:
    """Local rotations of the fingers of a left hand from (T, 7) hand shapes."""
    found = {}
    across = _unit(np.cross(_THUMB, [0.25, -0.80, -0.55]))  # axis of the thumb's hinges
    for f, finger in enumerate(_FINGERS):
        for k, full in enumerate(_FLEXION[f]):
            angle = full * shape[:, f + 1]
            axis = across if finger == "Thumb" else np.array([0.0, 0.0, -1.0])
            found[f"{finger}{k + 1}"] = Rotation.from_rotvec(angle[:, None] * axis)
        base = f"{finger}1"
        if finger == "Thumb":
            found[base] = _about("x", _OPPOSITION * shape[:, 0]) * found[base]
        else:
            found[base] = _about("y", -_SPREAD[f - 1] * shape[:, 6]) * found[base]
    return found


def _leg(hips: np.ndarray, pelvis: Rotation, sign: float) -> tuple[Rotation, Rotation, Rotation]:
    """Local rotations of one leg whose foot stands still: thigh, shin, foot."""
    mirror = np.array([sign, 1.0, 1.0])
    foot = Rotation.from_euler("y", sign * _TOES_OUT)
    reach = _ANKLE * mirror - (hips + pelvis.apply(np.array([0.09, -0.04, 0.0]) * mirror))
    down = _unit(reach)
    lead, bend = _bone_angles(np.linalg.norm(reach, axis=1), _THIGH, _SHIN)
    x = _unit(np.cross(-down, foot.apply([0.0, 0.0, 1.0])))  # the knee's hinge
    forward = np.cross(x, -down)
    y = -(np.cos(lead) * down + np.sin(lead) * forward)
    thigh = Rotation.from_matrix(np.stack([x, y, np.cross(x, y)], axis=-1))
    shin = _about("x", bend)
    return pelvis.inv() * thigh, shin, (thigh * shin).inv() * foot


def mirrored(rotation: Rotation) -> Rotation:
    """The same rotation seen in a mirror at x = 0."""
    return Rotation.from_quat(rotation.as_quat() * np.array([1.0, -1.0, -1.0, 1.0]))
