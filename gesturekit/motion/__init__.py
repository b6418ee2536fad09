"""Motion: skeletons, rotations, kinematics, body parts, contacts, mirroring."""

from gesturekit.lazy import attach, by_name
from gesturekit.motion.motion import Motion
from gesturekit.motion.skeleton import Skeleton

__all__ = ["Motion", "Skeleton"]

_OTHERS = {
    "body_model": "BodyModel FOOT_VERTICES",
    "contacts": "contact_labels floor_height foot_points foot_positions",
    "ik": "two_bone_ik",
    "kinematics": "GROUND forward_kinematics global_rotations",
    "model_joints": "ModelJoints first_moving_joint",
    "parts": "BodyParts SIDES arm_joints body_joints find_legs find_parts known_part_labels "
    "left_right_pairs leg_length parse_parts part_labels unidentified upper_body",
    "parts.body_size": "REFERENCE_SIZE body_height body_scale body_size stature",
    "retarget.body_frames": "BodyFrames body_frames",
    "retarget.standing_pose": "FORWARD standing_pose standing_rig",
    "root_path": "RootPath follow_path",
    "rotations": "invert_quaternions matrix_from_quaternion mean_quaternion multiply_quaternions "
    "normalize_quaternions quaternion_from_euler quaternion_from_rotation_vector "
    "quaternion_from_sixd rotate_vectors rotation_angles rotation_vector_from_quaternion",
    "skeleton": "BodyShape",
    "torch_kinematics": "ForwardKinematics PointKinematics foot_kinematics "
    "rotation_vector_to_matrix sixd_to_matrix",
}
__getattr__ = attach(__name__, {}, by_name(_OTHERS))[1]
