from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from recordings import AITVIEWER, BANDAI, IDLE, ZEGGS
from rigs import PERSON, Bones, below_a_root, numbered, numbered_limbs, renamed, rig_of

from gesturekit.errors import MotionError
from gesturekit.formats.smpl.skeleton import smpl_skeleton
from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.parts import (
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
    upper_body,
)
from gesturekit.motion.parts.joint_names import bare_name
from gesturekit.motion.retarget.body_frames import finger_chains

TEXTS = {
    "mixamo": """
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
""",
    "cmu": """
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
""",
    "acclaim": """
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
""",
    "genea": """
body_world b_root
    b_l_upleg b_l_leg b_l_foot_twist b_l_foot
    b_r_upleg b_r_leg b_r_foot_twist b_r_foot
    b_spine0 b_spine1 b_spine2
          p_navel
          b_spine3
            b_l_shoulder
              p_l_scap b_l_arm b_l_arm_twist b_l_forearm b_l_wrist_twist b_l_wrist
                          b_l_pinky1 b_l_pinky2 b_l_pinky3
                          b_l_index1 b_l_index2 b_l_index3
                          b_l_thumb0 b_l_thumb1 b_l_thumb2 b_l_thumb3
              p_l_delt
            b_r_shoulder
              p_r_scap b_r_arm b_r_arm_twist b_r_forearm b_r_wrist_twist b_r_wrist
                          b_r_pinky1 b_r_pinky2 b_r_pinky3
                          b_r_index1 b_r_index2 b_r_index3
                          b_r_thumb0 b_r_thumb1 b_r_thumb2 b_r_thumb3
              p_r_delt
            b_neck0 b_head b_head_null
""",
    "genea_toes": """
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
""",
    "beat": """
Hips
  Spine Spine1 Spine2 Spine3
          Neck Neck1 Head HeadEnd
          RightShoulder RightArm RightForeArm RightHand
                  RightHandMiddle1 RightHandMiddle2 RightHandMiddle3 RightHandMiddle4
                  RightHandRing RightHandRing1 RightHandRing2
                  RightHandThumb1 RightHandThumb2
          LeftShoulder LeftArm LeftForeArm LeftHand
                  LeftHandMiddle1 LeftHandMiddle2 LeftHandMiddle3 LeftHandMiddle4
                  LeftHandRing LeftHandRing1 LeftHandRing2
                  LeftHandThumb1 LeftHandThumb2
  RightUpLeg RightLeg RightFoot RightForeFoot RightToeBase RightToeBaseEnd
  LeftUpLeg LeftLeg LeftFoot LeftForeFoot LeftToeBase LeftToeBaseEnd
""",
    "xsens": """
Pelvis
  L5 L3 T12 T8
          Neck Head
          RightShoulder RightUpperArm RightForeArm RightHand
          LeftShoulder LeftUpperArm LeftForeArm LeftHand
  RightUpperLeg RightLowerLeg RightFoot RightToe
  LeftUpperLeg LeftLowerLeg LeftFoot LeftToe
""",
    "unreal": """
root
  pelvis
    spine_01 spine_02 spine_03
          clavicle_l upperarm_l
              upperarm_twist_01_l
              lowerarm_l
                lowerarm_twist_01_l
                hand_l
                  index_metacarpal_l index_01_l index_02_l
                  thumb_01_l thumb_02_l
          clavicle_r upperarm_r
              upperarm_twist_01_r
              lowerarm_r
                lowerarm_twist_01_r
                hand_r
                  index_metacarpal_r index_01_r index_02_r
                  thumb_01_r thumb_02_r
          neck_01 head
    thigh_l
      thigh_twist_01_l
      calf_l
        calf_twist_01_l
        foot_l ball_l
    thigh_r
      thigh_twist_01_r
      calf_r
        calf_twist_01_r
        foot_r ball_r
  ik_foot_root
    ik_foot_l
    ik_foot_r
  ik_hand_root ik_hand_gun
      ik_hand_l
      ik_hand_r
""",
    "vrm": """
Root J_Bip_C_Hips
    J_Bip_C_Spine J_Bip_C_Chest J_Bip_C_UpperChest
          J_Sec_L_Bust1 J_Sec_L_Bust2
          J_Sec_R_Bust1 J_Sec_R_Bust2
          J_Bip_C_Neck J_Bip_C_Head
              J_Adj_L_FaceEye
              J_Adj_R_FaceEye
              J_Sec_Hair1_01 J_Sec_Hair2_01
          J_Bip_L_Shoulder J_Bip_L_UpperArm J_Bip_L_LowerArm J_Bip_L_Hand J_Bip_L_Index1
          J_Bip_R_Shoulder J_Bip_R_UpperArm J_Bip_R_LowerArm J_Bip_R_Hand J_Bip_R_Index1
    J_Bip_L_UpperLeg J_Bip_L_LowerLeg J_Bip_L_Foot J_Bip_L_ToeBase
    J_Bip_R_UpperLeg J_Bip_R_LowerLeg J_Bip_R_Foot J_Bip_R_ToeBase
""",
    "rigify": """
DEF-spine
  DEF-pelvis.L
  DEF-pelvis.R
  DEF-thigh.L DEF-thigh.L.001 DEF-shin.L DEF-shin.L.001 DEF-foot.L DEF-toe.L
  DEF-thigh.R DEF-thigh.R.001 DEF-shin.R DEF-shin.R.001 DEF-foot.R DEF-toe.R
  DEF-spine.001 DEF-spine.002 DEF-spine.003
        DEF-breast.L
        DEF-breast.R
        DEF-shoulder.L DEF-upper_arm.L DEF-upper_arm.L.001
              DEF-forearm.L DEF-forearm.L.001 DEF-hand.L
                    DEF-thumb.01.L DEF-thumb.02.L
        DEF-shoulder.R DEF-upper_arm.R DEF-upper_arm.R.001
              DEF-forearm.R DEF-forearm.R.001 DEF-hand.R
                    DEF-thumb.01.R DEF-thumb.02.R
        DEF-spine.004 DEF-spine.005 DEF-spine.006
""",
    "biped": """
Bip01 Bip01_Pelvis
    Bip01_L_Thigh Bip01_L_Calf Bip01_L_Foot Bip01_L_Toe0 Bip01_L_Toe0Nub
    Bip01_R_Thigh Bip01_R_Calf Bip01_R_Foot Bip01_R_Toe0 Bip01_R_Toe0Nub
    Bip01_Spine Bip01_Spine1 Bip01_Neck
          Bip01_Head Bip01_HeadNub
          Bip01_L_Clavicle Bip01_L_UpperArm Bip01_L_Forearm Bip01_L_Hand Bip01_L_Finger0
          Bip01_R_Clavicle Bip01_R_UpperArm Bip01_R_Forearm Bip01_R_Hand Bip01_R_Finger0
""",
    # VRChat calls the thigh "leg".
    "vrchat": """
Hips
  Spine Chest Neck Head
      Left_shoulder Left_arm Left_elbow Left_wrist
      Right_shoulder Right_arm Right_elbow Right_wrist
  Left_leg Left_knee Left_ankle Left_toe
  Right_leg Right_knee Right_ankle Right_toe
""",
    "snake_case": """
hips
  spine chest neck head
      left_shoulder left_upper_arm left_lower_arm left_hand
      right_shoulder right_upper_arm right_lower_arm right_hand
  left_upper_leg left_lower_leg left_foot left_toes
  right_upper_leg right_lower_leg right_foot right_toes
""",
}


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
    "p_l_scap b_l_arm b_l_forearm b_l_wrist|b_l_upleg b_l_leg b_l_foot None",
    "genea_toes": "b_root|b_spine0 b_spine1 b_spine2 b_spine3|b_neck0|b_head|"
    "p_l_scap b_l_arm b_l_forearm b_l_wrist|b_l_upleg b_l_leg b_l_foot b_l_ball",
    "beat": "Hips|Spine Spine1 Spine2 Spine3|Neck|Head|"
    "LeftShoulder LeftArm LeftForeArm LeftHand|LeftUpLeg LeftLeg LeftFoot LeftForeFoot",
    "xsens": "Pelvis|L5 L3 T12 T8|Neck|Head|LeftShoulder LeftUpperArm LeftForeArm LeftHand|"
    "LeftUpperLeg LeftLowerLeg LeftFoot LeftToe",
    "unreal": "pelvis|spine_01 spine_02 spine_03|neck_01|head|"
    "clavicle_l upperarm_l lowerarm_l hand_l|thigh_l calf_l foot_l ball_l",
    "vrm": "J_Bip_C_Hips|J_Bip_C_Spine J_Bip_C_Chest J_Bip_C_UpperChest|J_Bip_C_Neck|J_Bip_C_Head|"
    "J_Bip_L_Shoulder J_Bip_L_UpperArm J_Bip_L_LowerArm J_Bip_L_Hand|"
    "J_Bip_L_UpperLeg J_Bip_L_LowerLeg J_Bip_L_Foot J_Bip_L_ToeBase",
    "rigify": "DEF-spine|DEF-spine.001 DEF-spine.002 DEF-spine.003|DEF-spine.004|DEF-spine.006|"
    "DEF-shoulder.L DEF-upper_arm.L DEF-forearm.L DEF-hand.L|"
    "DEF-thigh.L DEF-shin.L DEF-foot.L DEF-toe.L",
    "biped": "Bip01_Pelvis|Bip01_Spine Bip01_Spine1|Bip01_Neck|Bip01_Head|"
    "Bip01_L_Clavicle Bip01_L_UpperArm Bip01_L_Forearm Bip01_L_Hand|"
    "Bip01_L_Thigh Bip01_L_Calf Bip01_L_Foot Bip01_L_Toe0",
    "vrchat": "Hips|Spine Chest|Neck|Head|Left_shoulder Left_arm Left_elbow Left_wrist|"
    "Left_leg Left_knee Left_ankle Left_toe",
    "snake_case": "hips|spine chest|neck|head|"
    "left_shoulder left_upper_arm left_lower_arm left_hand|"
    "left_upper_leg left_lower_leg left_foot left_toes",
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
FILES = {"zeggs": ZEGGS, "aitviewer": AITVIEWER, "bandai": BANDAI, "reactidle": IDLE}


def told(skeleton: Skeleton, side: str = "left") -> str:
    parts = find_parts(skeleton)
    arm, leg = parts.arms[side], parts.legs[side]
    return (
        f"{parts.pelvis}|{' '.join(parts.spine)}|{parts.neck}|{parts.head}|"
        f"{arm.clavicle} {arm.shoulder} {arm.elbow} {arm.wrist}|"
        f"{leg.hip} {leg.knee} {leg.ankle} {leg.toe}"
    )


@pytest.mark.parametrize("kind", [*TEXTS, "biped_spaces"])
def test_rigs_of_the_field(kind):
    skeleton = rig(TEXTS[kind.removesuffix("_spaces")])
    expected = EXPECTED[kind.removesuffix("_spaces")]
    if kind.endswith("_spaces"):  # as 3ds Max writes them
        skeleton = renamed(skeleton, {name: name.replace("_", " ") for name in skeleton.names})
        assert told(skeleton).replace("Bip01 ", "Bip01_").replace("_L ", "_L_") == expected
        return
    assert told(skeleton) == expected
    to_right = dict(left_right_pairs(skeleton))
    words = [to_right.get(word, word) for word in expected.replace("|", " | ").split()]
    assert told(skeleton, "right") == " ".join(words).replace(" | ", "|")


@pytest.mark.parametrize("kind", FILES)
def test_rigs_of_real_files(shared_data, kind):
    assert told(Motion.load(shared_data / FILES[kind]).skeleton) == EXPECTED[kind]


@pytest.mark.parametrize("prefix", ["mixamorig:", "mixamorig", "mixamorig9:", "Character1_"])
def test_prefixes_of_joint_names_are_ignored(prefix):
    plain = rig(TEXTS["mixamo"])
    skeleton = renamed(plain, {name: prefix + name for name in plain.names})
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


def test_fingers_ends_and_face_are_not_body_joints():
    parts = find_parts(rig(TEXTS["acclaim"]))
    assert parts.fingers == ("lfingers", "lthumb", "rfingers", "rthumb")  # "lhand" is a hand
    parts = find_parts(rig(TEXTS["mixamo"]))
    assert len(parts.fingers) == 8
    assert parts.ends == ("HeadTop_End", "LeftToe_End", "RightToe_End")
    assert find_parts(smpl_skeleton(55)).face == ("jaw", "left_eye_smplhf", "right_eye_smplhf")


def test_arm_joints(person):
    assert arm_joints(person) == ("LeftArm", "LeftForeArm", "RightArm", "RightForeArm")


def same_joints(found: BodyParts, expected: BodyParts, renamed: Skeleton, usual: Skeleton) -> None:
    to_usual = dict(zip(renamed.names, usual.names, strict=True))
    assert to_usual[found.pelvis] == expected.pelvis
    assert tuple(to_usual[name] for name in found.spine) == expected.spine
    assert (to_usual[found.neck], to_usual[found.head]) == (expected.neck, expected.head)
    for side in ("left", "right"):
        for ours, theirs in ((found.arms, expected.arms), (found.legs, expected.legs)):
            told = {part: to_usual.get(joint) for part, joint in vars(ours[side]).items()}
            assert told == vars(theirs[side])


def test_meaningless_joint_names(mixamo):
    """The shape tells: legs and arms, left from right by the feet, the head from its top."""
    for usual in (mixamo, smpl_skeleton(24), smpl_skeleton(55)):
        renamed = numbered(usual)
        same_joints(find_parts(renamed), find_parts(usual), renamed, usual)
        by_name = {tuple(map(usual.index, pair)) for pair in left_right_pairs(usual)}
        by_shape = {tuple(map(renamed.index, pair)) for pair in left_right_pairs(renamed)}
        assert by_shape <= by_name and len(by_shape) >= 8


@pytest.mark.parametrize("kind", [kind for kind in FILES if kind != "bandai"])
def test_nameless_rigs_of_real_files(shared_data, kind):
    usual = Motion.load(shared_data / FILES[kind]).skeleton
    renamed = numbered(usual)
    same_joints(find_parts(renamed), find_parts(usual), renamed, usual)


def test_ambiguous_shapes_are_errors(mixamo, shared_data):
    heap = numbered(Motion.load(shared_data / FILES["bandai"]).skeleton)
    no_feet = np.where(np.abs(mixamo.offsets[:, 2:]) > 0.08, 0, mixamo.offsets)
    three_bones = mixamo.offsets.copy()
    hands = [mixamo.index(f"mixamorig:{side}Hand") for side in ("Left", "Right")]
    three_bones[hands, 0] *= 0.5
    knuckles = [j for j, parent in enumerate(mixamo.parents) if parent in hands]
    three_bones[knuckles, 0] *= 2.5
    for skeleton, says in (
        (heap, "1 pair of limbs"),
        (replace(numbered(mixamo), offsets=no_feet), "which way is forward"),
        (replace(numbered(mixamo), offsets=three_bones), "no two bones"),
    ):
        with pytest.raises(MotionError, match=rf"arms.*{says}.*--part left_elbow=JOINT.*parts: "):
            find_parts(skeleton)


def test_parts_named_by_hand():
    plain = rig(TEXTS["mixamo"])  # all in one point: nothing is told by shape
    skeleton = numbered(plain)
    with pytest.raises(MotionError, match=r"arms and legs.*left_elbow=JOINT"):
        find_parts(skeleton)
    named = numbered_limbs(plain)
    parts = find_parts(skeleton, overrides=named)
    assert parts.pelvis == "Joint0" and parts.spine == ("Joint1", "Joint2", "Joint3")
    # A skeleton that holds them needs no overrides, and keeps them.
    holding = Skeleton.from_json(replace(skeleton, parts=named).to_json())
    assert find_parts(holding) == parts == find_parts(holding.scaled(2.0))
    with pytest.raises(MotionError, match="left_elbo"):
        find_parts(skeleton, overrides={"left_elbo": "Joint1"})
    with pytest.raises(MotionError, match=r"left_elbow.*'Joint99'"):
        replace(skeleton, parts={"left_elbow": "Joint99"})


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        ({"left_elbow": "LeftLeg"}, "'mixamorig:LeftLeg' cannot be both left_elbow and left_knee"),
        ({"left_ankle": "RightFoot", "right_ankle": "LeftFoot"}, "does not hang on the other"),
        ({"left_hip": "Spine1"}, "'mixamorig:LeftLeg' cannot be the left knee"),
        ({"left_elbow": "LeftArm"}, "bones of 0.13 and 0.55 m"),
        ({"head": "LeftHand"}, "'mixamorig:LeftHand' cannot be the head"),
    ],
)
def test_wrong_parts_fail_loudly(mixamo, overrides, says):
    with pytest.raises(MotionError, match=says):
        find_parts(mixamo, {part: f"mixamorig:{name}" for part, name in overrides.items()})


def test_bodies_that_cannot_be_fail_loudly(mixamo):
    one_long_leg = mixamo.offsets.copy()
    one_long_leg[[mixamo.index(f"mixamorig:Left{name}") for name in ("Leg", "Foot")]] *= 2
    with pytest.raises(MotionError, match="the left leg would be 1.65 m long, the right"):
        find_parts(replace(mixamo, offsets=one_long_leg))
    high_knees = mixamo.offsets.copy()
    high_knees[[mixamo.index(f"mixamorig:{side}Leg") for side in ("Left", "Right")]] *= 0.1
    with pytest.raises(MotionError, match="left knee.*left ankle|left knee.*left hip"):
        find_parts(replace(mixamo, offsets=high_knees))
    swapped = {}
    for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle", "toe", "clavicle"):
        for side, other in (("left", "right"), ("right", "left")):
            parts = find_parts(mixamo)
            limbs = vars(parts.arms[other]) | vars(parts.legs[other])
            swapped[f"{side}_{part}"] = limbs[part]
    with pytest.raises(MotionError, match="toes point backwards"):
        find_parts(mixamo, swapped)


def test_labels(mixamo):
    labels = part_labels(mixamo)
    assert list(labels) == list(mixamo.names)
    for name, label in {
        "Hips": "pelvis",
        "Spine1": "spine",
        "Neck": "neck",
        "Head": "head",
        "HeadTop_End": "end",
        "LeftShoulder": "left clavicle",
        "LeftForeArm": "left elbow",
        "RightHandRing2": "finger",
        "RightFoot": "right ankle",
        "RightToeBase": "right toe",
    }.items():
        assert labels[f"mixamorig:{name}"] == label
    genea = part_labels(rig(TEXTS["genea"]))
    assert (genea["body_world"], genea["b_l_arm_twist"]) == ("root", "twist")
    assert genea["p_navel"] == "other"


@pytest.mark.parametrize(
    ("name", "side", "bare"),
    [
        ("mixamorig:LeftForeArm", "left", "forearm"),
        ("LeftForeArmRoll2", "left", "forearmroll"),
        ("LeftBall", "left", "ball"),
        ("ArmLeft", "left", "arm"),
        ("RightFinger1", "right", "finger"),
        ("upperarm_twist_01_l", "left", "upperarmtwist"),
        ("HandL", "left", "hand"),
        ("lfemur", "left", "femur"),
        ("RHipJoint", "right", "hipjoint"),
        ("Skull", "", "skull"),
    ],
)
def test_a_name_without_its_side(name, side, bare):
    assert bare_name(name, side) == bare


def test_leg_length_counts_what_lies_between(mixamo):
    assert leg_length(mixamo) == pytest.approx(0.406 + 0.421)
    plain = rig(TEXTS["genea"])
    offsets = np.zeros((plain.n_joints, 3))
    for side in "lr":
        for joint, length in (("leg", 0.4), ("foot_twist", 0.2), ("foot", 0.2), ("upleg", 0.1)):
            offsets[plain.index(f"b_{side}_{joint}"), 1] = -length
    assert leg_length(replace(plain, offsets=offsets)) == pytest.approx(0.8)


@pytest.mark.parametrize("side", ["left", "right"])
def test_fingers(mixamo, side):
    chains = finger_chains(mixamo, find_parts(mixamo), side)
    assert list(chains) == ["thumb", "index", "middle", "ring", "little"]
    first = mixamo.index(f"mixamorig:{side.title()}HandPinky1")
    assert chains["little"] == (first, first + 1, first + 2, first + 3)
    biped = rig(TEXTS["biped"])
    (kind, chain) = next(iter(finger_chains(biped, find_parts(biped), side).items()))
    assert kind == "thumb" and len(chain) == 1
    unreal = rig(TEXTS["unreal"])
    index = finger_chains(unreal, find_parts(unreal), side)["index"]
    assert [unreal.names[j] for j in index] == [f"index_0{n}_{side[0]}" for n in (1, 2)]


def test_accessories_are_not_the_head(mixamo):
    odd = {"Head": "skull", "HeadTop_End": "hat", "LeftHand": "PalmL", "RightHand": "PalmR"}
    found = find_parts(renamed(mixamo, {f"mixamorig:{usual}": name for usual, name in odd.items()}))
    assert found.head == "skull"
    assert [found.arms[side].wrist for side in ("left", "right")] == ["PalmL", "PalmR"]
    # A lamp on the chest, whose head is farther along than the person's and stands before it.
    lamp = {f"Lamp{k}": (f"Lamp{k - 1}" if k else "Chest", (0.0, 0.1, 0.1)) for k in range(3)}
    lamp["LampHead"] = ("Lamp2", (0.0, 0.1, 0.1))
    trunk = {name: PERSON[name] for name in ("Hips", "Spine", "Chest")}
    assert find_parts(rig_of(trunk | lamp | PERSON)).head == "Head"
    arm = ("RightShoulder", "RightArm", "RightForeArm", "RightHand")
    bones = {name: bone for name, bone in (trunk | lamp | PERSON).items() if name not in arm}
    labels, _ = known_part_labels(rig_of(bones))
    assert (labels["Head"], labels["LampHead"]) == ("head", "other")


def test_arms_on_a_neck_leave_a_spine_below_it():
    """The neck is the spine where nothing else is between it and the hips."""
    for between in ([], ["Spine"], ["Spine", "Waist"]):
        way = ["Hips", *between, "Neck", "Head"]
        bones: Bones = {"Hips": PERSON["Hips"]}
        bones |= {name: (above, (0.0, 0.2, 0.0)) for above, name in zip(way, way[1:])}
        for name, (above, offset) in PERSON.items():
            if name not in ("Hips", "Spine", "Chest", "Neck", "Head"):
                bones[name] = ("Neck" if above == "Chest" else above, offset)
        found = find_parts(rig_of(bones))
        assert found.spine == (tuple(between) or ("Neck",))
        assert found.neck == ("Neck" if between else None) and found.head == "Head"


def animal(legs: int, named: tuple[str, ...]) -> Skeleton:
    """A body with so many legs of equal length, of which one pair has joints of these names."""
    bones: Bones = {"Body": (None, (0.0, 0.0, 0.0))}
    for k in range(legs):
        side, x, row, above = ("Left", "Right")[k % 2], (0.1, -0.1)[k % 2], k // 2, "Body"
        for part in named if row == 1 else [f"Limb{row}{part}" for part in "abcd"[: len(named)]]:
            offset = (x, 0.0, 0.1 * row) if above == "Body" else (x, -0.05, 0.0)
            bones[f"{side}{part}"] = (above, offset)
            above = f"{side}{part}"
    return rig_of(bones)


@pytest.mark.parametrize(
    "named", [("Coxa", "Leg", "Tip"), ("UpLeg", "Leg", "Foot"), ("Coxa", "UpLeg", "Leg", "Foot")]
)
def test_two_legs_of_a_crab_are_not_those_of_a_person(named):
    crab, two_legs = animal(10, named), animal(4, named)
    assert find_legs(crab) is None
    labels, reason = known_part_labels(crab)
    assert labels == {} and "cannot identify the arms and legs" in reason
    hip = named[named.index("Leg") - 1]
    assert find_legs(below_a_root(crab, 0.5)) is None
    by_hand = crab.with_parts({"left_hip": f"Left{hip}", "right_hip": f"Right{hip}"})
    for rig in (two_legs, by_hand):
        labels, _ = known_part_labels(rig)
        assert labels[f"Left{hip}"] == "left hip" and labels["RightLeg"] == "right knee"


def spider(legs: int, others: float) -> Skeleton:
    """A body with legs of 0.1 + 0.3 + 0.2 m all round; two are named, others are so much longer."""
    bones: Bones = {"Body": (None, (0.0, 0.0, 0.0))}
    for k in range(legs):
        names = (("Coxa", "Leg", "Tip"), ("Limb_a", "Limb_b", "Limb_c"))[k > 1]
        names = [f"{('Left', 'Right')[k]}{name}" if k < 2 else f"{name}{k}" for name in names]
        size = 1.0 if k < 2 else others
        above = "Body"
        for name, length in zip(names, (0.1, 0.3, 0.2), strict=True):
            bones[name] = (above, (0.0, -size * length, 0.0))
            above = name
    return rig_of(bones).with_parts({"left_ankle": "LeftTip", "right_ankle": "RightTip"})


@pytest.mark.parametrize(
    ("legs", "others", "person"),
    [(6, 1.0, False), (5, 1.0, True), (6, 0.81, False), (6, 0.79, True), (9, 0.79, True)],
)
def test_six_chains_of_four_fifths_of_a_leg_are_too_many_for_a_person(legs, others, person):
    for size in (1.0, 100.0):
        rig = spider(legs, others).scaled(size)
        assert (find_legs(rig) is not None) == person
        # The same at the end of a chain without branches, and with the length in end sites.
        deep = {f"Link{k}": (f"Link{k - 1}" if k else None, (0.0, size, 0.0)) for k in range(3)}
        rows = {
            n: (None if p < 0 else rig.names[p], tuple(o))
            for n, p, o in zip(rig.names, rig.parents, rig.offsets, strict=True)
        }
        rows["Body"] = ("Link2", (0.0, size, 0.0))
        assert (find_legs(rig_of(deep | rows, parts=rig.parts)) is not None) == person


def one_armed(*missing: str) -> Skeleton:
    return rig_of({k: v for k, v in PERSON.items() if not k.startswith(missing)})


def test_parts_that_a_rig_lacks_are_named_and_the_others_labelled():
    arm = ("RightShoulder", "RightArm", "RightForeArm", "RightHand")
    labels, reason = known_part_labels(one_armed(*arm))
    usual = part_labels(rig_of(PERSON))
    assert labels == {name: label for name, label in usual.items() if name not in arm}
    assert reason.startswith("cannot identify the right arm: ")
    assert "--part right_shoulder=JOINT" in reason or "--part right_elbow=JOINT" in reason
    leg = ("LeftUpLeg", "LeftLeg", "LeftFoot")
    labels, reason = known_part_labels(one_armed(*arm, *leg))
    assert reason.startswith("cannot identify the right arm and left leg: ")
    known = {"LeftForeArm": "left elbow", "RightFoot": "right ankle", "Head": "head"}
    assert {name: labels[name] for name in known} == known
    # Without two hips there is no pelvis, and so no spine.
    assert labels["Hips"] == labels["Spine"] == "other" and labels["Neck"] == "neck"
    legs = one_armed(*arm, *(name.replace("Right", "Left") for name in arm))
    labels, reason = known_part_labels(legs)
    assert reason.startswith("cannot identify the arms: ")
    assert (labels["Hips"], labels["RightLeg"], labels["Chest"]) == (
        "pelvis",
        "right knee",
        "other",
    )
    assert known_part_labels(rig_of(PERSON)) == (usual, "")


@pytest.mark.parametrize(
    ("above", "lengths", "legs"),
    [
        # Upper arms of 0.28 m: half of both together below the chest, all of both on it.
        ("Hips", (0.1, 0.179), False),
        ("Hips", (0.14, 0.14), True),
        ("Hips", (0.1, 0.181), True),
        ("Spine", (0.1, 0.1, 0.081), True),
        ("Chest", (0.3, 0.259), False),
        ("Chest", (0.3, 0.261), True),
        ("Hips", (2.0,), False),  # a stick is no chain
    ],
)
def test_long_chains_on_the_trunk_of_a_body_without_legs_may_be_legs(above, lengths, legs):
    bones: Bones = {k: v for k, v in PERSON.items() if "Leg" not in k and "Foot" not in k}
    for k, length in enumerate(lengths):
        bones[f"Chain{k}"] = (above, (0.0, 0.0, -length))
        above = f"Chain{k}"
    for size in (1.0, 100.0):
        rig = rig_of(bones).scaled(size)
        if not legs:
            assert find_parts(rig).legs == {}
            continue
        with pytest.raises(MotionError, match="identify the legs, which may begin at Chain0"):
            find_parts(rig)
    if len(lengths) == 2 and not legs:  # an end site is part of its chain
        longer = {"Chain1": (np.array([0.0, 0.0, -0.002]),)}
        with pytest.raises(MotionError, match="which may begin at Chain0"):
            find_parts(rig_of(bones, end_sites=longer))


@pytest.mark.parametrize(
    ("texts", "says"),
    [
        (["left_elbow"], "'left_elbow'; expected"),
        (["elbow=a"], "'elbow=a'"),
        (["head="], "'head='"),
    ],
)
def test_parts_on_a_command_line(texts, says):
    assert parse_parts(["left_elbow=Joint=12", "head=a"]) == {"left_elbow": "Joint=12", "head": "a"}
    with pytest.raises(MotionError, match=says):
        parse_parts(texts)
