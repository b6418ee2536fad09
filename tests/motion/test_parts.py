from __future__ import annotations

import numpy as np
import pytest

from gesturekit.errors import MotionError
from gesturekit.formats.smpl import smpl_skeleton
from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.parts import (
    arm_joints,
    body_joints,
    find_parts,
    left_right_pairs,
    upper_body,
)

MIXAMO = """
Hips
  Spine Spine1 Spine2
        Neck Head HeadTop_End
        LeftShoulder LeftArm LeftForeArm LeftHand
                LeftHandThumb1 LeftHandThumb2
                LeftHandIndex1 LeftHandIndex2
        RightShoulder RightArm RightForeArm RightHand
                RightHandThumb1 RightHandThumb2
                RightHandIndex1 RightHandIndex2
  LeftUpLeg LeftLeg LeftFoot LeftToeBase LeftToe_End
  RightUpLeg RightLeg RightFoot RightToeBase RightToe_End
"""
CMU = """
Hips
  LHipJoint LeftUpLeg LeftLeg LeftFoot LeftToeBase
  RHipJoint RightUpLeg RightLeg RightFoot RightToeBase
  LowerBack Spine Spine1
        Neck Neck1 Head
        LeftShoulder LeftArm LeftForeArm LeftHand
                LeftFingerBase LeftHandIndex1
                LThumb
        RightShoulder RightArm RightForeArm RightHand
                RightFingerBase RightHandIndex1
                RThumb
"""
ACCLAIM = """
root
  lhipjoint lfemur ltibia lfoot ltoes
  rhipjoint rfemur rtibia rfoot rtoes
  lowerback upperback thorax
        lowerneck upperneck head
        lclavicle lhumerus lradius lwrist lhand
                  lfingers
                lthumb
        rclavicle rhumerus rradius rwrist rhand
                  rfingers
                rthumb
"""
GENEA = """
body_world b_root
    b_l_upleg b_l_leg b_l_foot b_l_ball
    b_r_upleg b_r_leg b_r_foot b_r_ball
    b_spine0 b_spine1 b_spine2 b_spine3
            b_neck0 b_head
            b_l_shoulder p_l_scap b_l_arm
                  b_l_arm_twist
                  b_l_forearm b_l_wrist_twist b_l_wrist b_l_thumb0 b_l_thumb1
            b_r_shoulder p_r_scap b_r_arm
                  b_r_arm_twist
                  b_r_forearm b_r_wrist_twist b_r_wrist b_r_thumb0 b_r_thumb1
"""
BIPED = """
Bip01 Bip01_Pelvis
    Bip01_L_Thigh Bip01_L_Calf Bip01_L_Foot Bip01_L_Toe0 Bip01_L_Toe0Nub
    Bip01_R_Thigh Bip01_R_Calf Bip01_R_Foot Bip01_R_Toe0 Bip01_R_Toe0Nub
    Bip01_Spine Bip01_Spine1 Bip01_Neck
          Bip01_Head Bip01_HeadNub
          Bip01_L_Clavicle Bip01_L_UpperArm Bip01_L_Forearm Bip01_L_Hand Bip01_L_Finger0
          Bip01_R_Clavicle Bip01_R_UpperArm Bip01_R_Forearm Bip01_R_Hand Bip01_R_Finger0
"""


def rig(text: str) -> Skeleton:
    """A chain of names on each line, hung on the joint that its indent (2 a level) leads to."""
    names, parents, above = [], [], []
    for line in text.strip("\n").split("\n"):
        depth = (len(line) - len(line.lstrip())) // 2
        for i, name in enumerate(line.split()):
            above = above[: depth + i]
            parents.append(above[-1] if above else -1)
            above.append(len(names))
            names.append(name)
    return Skeleton(tuple(names), tuple(parents), np.zeros((len(names), 3)))


# pelvis, spine, neck, head, then clavicle shoulder elbow wrist and hip knee ankle toe of the left.
EXPECTED = {
    "mixamo": "Hips|Spine Spine1 Spine2|Neck|Head|LeftShoulder LeftArm LeftForeArm LeftHand|"
    "LeftUpLeg LeftLeg LeftFoot LeftToeBase",
    "cmu": "Hips|LowerBack Spine Spine1|Neck|Head|LeftShoulder LeftArm LeftForeArm LeftHand|"
    "LeftUpLeg LeftLeg LeftFoot LeftToeBase",
    "acclaim": "root|lowerback upperback thorax|lowerneck|head|lclavicle lhumerus lradius lwrist|"
    "lfemur ltibia lfoot ltoes",
    "genea": "b_root|b_spine0 b_spine1 b_spine2 b_spine3|b_neck0|b_head|"
    "p_l_scap b_l_arm b_l_forearm b_l_wrist|b_l_upleg b_l_leg b_l_foot b_l_ball",
    "biped": "Bip01_Pelvis|Bip01_Spine Bip01_Spine1|Bip01_Neck|Bip01_Head|"
    "Bip01_L_Clavicle Bip01_L_UpperArm Bip01_L_Forearm Bip01_L_Hand|"
    "Bip01_L_Thigh Bip01_L_Calf Bip01_L_Foot Bip01_L_Toe0",
    "smpl": "pelvis|spine1 spine2 spine3|neck|head|"
    "left_collar left_shoulder left_elbow left_wrist|left_hip left_knee left_ankle left_foot",
    "zeggs": "Hips|Spine Spine1 Spine2 Spine3|Neck|Head|"
    "LeftShoulder LeftArm LeftForeArm LeftHand|LeftUpLeg LeftLeg LeftFoot LeftToeBase",
    "aitviewer": "Hips|Chest Chest2 Chest3 Chest4|Neck|Head|"
    "LeftCollar LeftShoulder LeftElbow LeftWrist|LeftHip LeftKnee LeftAnkle LeftToe",
    "bandai": "Hips|Spine Chest|Neck|Head|Shoulder_L UpperArm_L LowerArm_L Hand_L|"
    "UpperLeg_L LowerLeg_L Foot_L Toes_L",
    "reactidle": "pelvis|spine spine.001|neck|face|shoulder.L upper_arm.L forearm.L None|"
    "thigh.L shin.L foot.L None",
}
FILES = {
    "zeggs": "paired/zeggs_067_Speech_2/067_Speech_2_x_1_0.bvh",
    "aitviewer": "motion/aitviewer/sample.bvh",
    "bandai": "motion/bandai/dataset-1_bow_sad_001.bvh",
    "reactidle": "motion/reactidle/003_genuine.bvh",
}
TEXTS = {"mixamo": MIXAMO, "cmu": CMU, "acclaim": ACCLAIM, "genea": GENEA, "biped": BIPED}


def told(skeleton: Skeleton, side: str = "left") -> str:
    parts = find_parts(skeleton)
    arm, leg = parts.arms[side], parts.legs[side]
    return (
        f"{parts.pelvis}|{' '.join(parts.spine)}|{parts.neck}|{parts.head}|"
        f"{arm.clavicle} {arm.shoulder} {arm.elbow} {arm.wrist}|"
        f"{leg.hip} {leg.knee} {leg.ankle} {leg.toe}"
    )


@pytest.mark.parametrize("kind", TEXTS)
def test_rigs_of_the_field(kind):
    skeleton = rig(TEXTS[kind])
    assert told(skeleton) == EXPECTED[kind]
    to_right = dict(left_right_pairs(skeleton))
    words = [to_right.get(word, word) for word in EXPECTED[kind].replace("|", " | ").split()]
    assert told(skeleton, "right") == " ".join(words).replace(" | ", "|")


@pytest.mark.parametrize("kind", FILES)
def test_rigs_of_real_files(shared_data, kind):
    assert told(Motion.load(shared_data / FILES[kind]).skeleton) == EXPECTED[kind]


@pytest.mark.parametrize("prefix", ["mixamorig:", "mixamorig", "mixamorig9:", "Character1_"])
def test_prefixes_do_not_matter(prefix):
    plain = rig(MIXAMO)
    names = tuple(prefix + name for name in plain.names)
    skeleton = Skeleton(names, plain.parents, plain.offsets)
    assert told(skeleton).replace(prefix, "") == EXPECTED["mixamo"]
    assert len(body_joints(skeleton)) == 22


@pytest.mark.parametrize(("n_joints", "n_body"), [(22, 22), (24, 24), (52, 22), (55, 22)])
def test_smpl_family(n_joints, n_body):
    skeleton = smpl_skeleton(n_joints)
    assert told(skeleton) == EXPECTED["smpl"]
    assert len(body_joints(skeleton)) == n_body
    assert len(left_right_pairs(skeleton)) == {22: 8, 24: 9, 52: 23, 55: 24}[n_joints]


def test_body_and_upper_body_of_zeggs(shared_data):
    skeleton = Motion.load(shared_data / FILES["zeggs"]).skeleton
    body = body_joints(skeleton)
    assert len(body) == 24 and "Head" in body and "LeftToeBase" in body
    assert not [name for name in body if "Thumb" in name or name.endswith("End")]
    upper = set(upper_body(skeleton))
    assert {"Spine", "Head", "LeftHand", "RightHandPinky4"} <= upper
    assert not upper & {"Hips", "LeftUpLeg", "RightToeBase"}
    assert len(left_right_pairs(skeleton)) == 33


def test_what_is_no_body_joint():
    parts = find_parts(rig(ACCLAIM))
    assert parts.fingers == ("lfingers", "lthumb", "rfingers", "rthumb")  # "lhand" is a hand
    parts = find_parts(rig(MIXAMO))
    assert len(parts.fingers) == 8
    assert parts.ends == ("HeadTop_End", "LeftToe_End", "RightToe_End")
    assert find_parts(smpl_skeleton(55)).face == ("jaw", "left_eye_smplhf", "right_eye_smplhf")


def test_arm_joints(person):
    assert arm_joints(person) == ("LeftArm", "LeftForeArm", "RightArm", "RightForeArm")


def test_names_that_say_nothing():
    plain = rig(MIXAMO)
    names = tuple(f"joint{j}" for j in range(plain.n_joints))
    skeleton = Skeleton(names, plain.parents, plain.offsets)
    with pytest.raises(MotionError, match=r"left_elbow.*overrides"):
        find_parts(skeleton)
    by_hand = {
        f"{side}_{part}": names[plain.index(name)]
        for side, word in (("left", "Left"), ("right", "Right"))
        for part, name in (
            ("shoulder", f"{word}Arm"),
            ("elbow", f"{word}ForeArm"),
            ("wrist", f"{word}Hand"),
            ("hip", f"{word}UpLeg"),
            ("knee", f"{word}Leg"),
            ("ankle", f"{word}Foot"),
        )
    }
    parts = find_parts(skeleton, overrides=by_hand)
    assert parts.pelvis == "joint0" and parts.spine == ("joint1", "joint2", "joint3")
    with pytest.raises(MotionError, match="left_elbo"):
        find_parts(skeleton, overrides={"left_elbo": "joint1"})
