"""Motion: skeletons, rotations, kinematics, body parts, contacts, mirroring."""

from gesturekit.motion.body_model.model import FOOT_VERTICES, BodyModel
from gesturekit.motion.body_shape import BodyShape
from gesturekit.motion.contacts import contact_labels, floor_height, foot_points, foot_positions
from gesturekit.motion.ik.two_bone import two_bone_ik
from gesturekit.motion.kinematics import GROUND, forward_kinematics, global_rotations
from gesturekit.motion.model_joints import ModelJoints, first_moving_joint
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import (
    SIDES,
    BodyParts,
    arm_joints,
    body_joints,
    find_legs,
    find_parts,
    known_part_labels,
    left_right_pairs,
    leg_length,
    parse_parts,
    part_labels,
    unidentified,
    upper_body,
)
from gesturekit.motion.parts.body_size import (
    REFERENCE_SIZE,
    body_height,
    body_scale,
    body_size,
    stature,
)
from gesturekit.motion.retarget.body_frames import BodyFrames, body_frames
from gesturekit.motion.retarget.standing_pose import FORWARD, standing_pose, standing_rig
from gesturekit.motion.root_path import RootPath, follow_path
from gesturekit.motion.rotations import (
    invert_quaternions,
    matrix_from_quaternion,
    mean_quaternion,
    multiply_quaternions,
    normalize_quaternions,
    quaternion_from_euler,
    quaternion_from_rotation_vector,
    quaternion_from_sixd,
    rotate_vectors,
    rotation_angles,
    rotation_vector_from_quaternion,
)
from gesturekit.motion.skeleton import Skeleton
from gesturekit.motion.torch_kinematics import (
    ForwardKinematics,
    PointKinematics,
    foot_kinematics,
    rotation_vector_to_matrix,
    sixd_to_matrix,
)

__all__ = [
    "BodyFrames",
    "BodyModel",
    "BodyParts",
    "BodyShape",
    "FOOT_VERTICES",
    "FORWARD",
    "ForwardKinematics",
    "GROUND",
    "ModelJoints",
    "Motion",
    "PointKinematics",
    "REFERENCE_SIZE",
    "RootPath",
    "SIDES",
    "Skeleton",
    "arm_joints",
    "body_frames",
    "body_height",
    "body_joints",
    "body_scale",
    "body_size",
    "contact_labels",
    "find_legs",
    "find_parts",
    "first_moving_joint",
    "floor_height",
    "follow_path",
    "foot_kinematics",
    "foot_points",
    "foot_positions",
    "forward_kinematics",
    "global_rotations",
    "invert_quaternions",
    "known_part_labels",
    "left_right_pairs",
    "leg_length",
    "matrix_from_quaternion",
    "mean_quaternion",
    "multiply_quaternions",
    "normalize_quaternions",
    "parse_parts",
    "part_labels",
    "quaternion_from_euler",
    "quaternion_from_rotation_vector",
    "quaternion_from_sixd",
    "rotate_vectors",
    "rotation_angles",
    "rotation_vector_from_quaternion",
    "rotation_vector_to_matrix",
    "sixd_to_matrix",
    "standing_pose",
    "standing_rig",
    "stature",
    "two_bone_ik",
    "unidentified",
    "upper_body",
]
