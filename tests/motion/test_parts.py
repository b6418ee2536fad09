import re
from dataclasses import replace

import numpy as np
import pytest
from recordings import AITVIEWER, BANDAI, IDLE, ZEGGS
from rigs import PERSON, numbered, numbered_limbs, renamed, rig_of

from gesturekit.errors import MotionError
from gesturekit.formats.smpl import smpl_skeleton
from gesturekit.motion import Skeleton
from gesturekit.motion.parts import (
    BodyParts,
    body_joints,
    find_legs,
    find_parts,
    known_part_labels,
    left_right_pairs,
    parse_parts,
    part_labels,
)

# A chain of joints on each line, attached by its indent; @ stands for left and right, which have
# a line each, with the lines below it.
RIGS = {
    "mixamo": """Left Right
Hips
  Spine Spine1 Spine2
        Neck Head HeadTop_End
        @Shoulder @Arm @ForeArm @Hand
                @HandThumb1 @HandThumb2
                @HandIndex1 @HandIndex2
  @UpLeg @Leg @Foot @ToeBase @Toe_End
""",
    "cmu": """Left Right
Hips
  %HipJoint @UpLeg @Leg @Foot @ToeBase
  LowerBack Spine Spine1
        Neck Neck1 Head
        @Shoulder @Arm @ForeArm @Hand
                @FingerBase @HandIndex1
                %Thumb
""",
    "acclaim": """l r
root
  @hipjoint @femur @tibia @foot @toes
  lowerback upperback thorax
        lowerneck upperneck head
        @clavicle @humerus @radius @wrist @hand
                  @fingers
                @thumb
""",
    "genea": """l r
body_world b_root
    b_@_upleg b_@_leg b_@_foot_twist b_@_foot
    b_spine0 b_spine1 b_spine2
          p_navel
          b_spine3
            b_@_shoulder
              p_@_scap b_@_arm b_@_arm_twist b_@_forearm b_@_wrist_twist b_@_wrist
                          b_@_pinky1 b_@_pinky2
                          b_@_thumb0 b_@_thumb1
              p_@_delt
            b_neck0 b_head b_head_null
""",
    "beat": """Right Left
Hips
  Spine Spine1 Spine2 Spine3
          Neck Neck1 Head HeadEnd
          @Shoulder @Arm @ForeArm @Hand
                  @HandMiddle1 @HandMiddle2
                  @HandRing @HandRing1
  @UpLeg @Leg @Foot @ForeFoot @ToeBase @ToeBaseEnd
""",
    "unreal": """l r
root
  pelvis
    spine_01 spine_02 spine_03
          clavicle_@ upperarm_@
              upperarm_twist_01_@
              lowerarm_@
                lowerarm_twist_01_@
                hand_@
                  index_metacarpal_@ index_01_@
          neck_01 head
    thigh_@
      thigh_twist_01_@
      calf_@
        foot_@ ball_@
  ik_foot_root
    ik_foot_@
  ik_hand_root ik_hand_gun
      ik_hand_@
""",
    "vrm": """L R
Root J_Bip_C_Hips
    J_Bip_C_Spine J_Bip_C_Chest J_Bip_C_UpperChest
          J_Sec_@_Bust1 J_Sec_@_Bust2
          J_Bip_C_Neck J_Bip_C_Head
              J_Adj_@_FaceEye
              J_Sec_Hair1_01 J_Sec_Hair2_01
          J_Bip_@_Shoulder J_Bip_@_UpperArm J_Bip_@_LowerArm J_Bip_@_Hand J_Bip_@_Index1
    J_Bip_@_UpperLeg J_Bip_@_LowerLeg J_Bip_@_Foot J_Bip_@_ToeBase
""",
    "rigify": """L R
DEF-spine
  DEF-pelvis.@
  DEF-thigh.@ DEF-thigh.@.001 DEF-shin.@ DEF-shin.@.001 DEF-foot.@ DEF-toe.@
  DEF-spine.001 DEF-spine.002 DEF-spine.003
        DEF-breast.@
        DEF-shoulder.@ DEF-upper_arm.@ DEF-upper_arm.@.001
              DEF-forearm.@ DEF-forearm.@.001 DEF-hand.@
        DEF-spine.004 DEF-spine.005 DEF-spine.006
""",
    "biped": """L R
Bip01 Bip01_Pelvis
    Bip01_@_Thigh Bip01_@_Calf Bip01_@_Foot Bip01_@_Toe0 Bip01_@_Toe0Nub
    Bip01_Spine Bip01_Spine1 Bip01_Neck
          Bip01_Head Bip01_HeadNub
          Bip01_@_Clavicle Bip01_@_UpperArm Bip01_@_Forearm Bip01_@_Hand Bip01_@_Finger0
""",
    # VRChat calls the thigh "leg".
    "vrchat": """Left Right
Hips
  Spine Chest Neck Head
      @_shoulder @_arm @_elbow @_wrist
  @_leg @_knee @_ankle @_toe
""",
}


def rig(kind: str) -> Skeleton:
    """Return a rig of the table, all joints in one point."""
    sides, text = RIGS[kind].split("\n", 1)
    lines: list[str] = []
    for block in re.finditer(r"( *)\S*[@%].*\n(?:\1 +.*[@%].*\n)*|.+\n", text):
        both = sides.split() if "@" in block[0] else [""]
        lines += [block[0].replace("@", side).replace("%", side[:1]) for side in both]
    names, parents, above = [], [], []
    for line in "".join(lines).strip("\n").split("\n"):
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
    "beat": "Hips|Spine Spine1 Spine2 Spine3|Neck|Head|"
    "LeftShoulder LeftArm LeftForeArm LeftHand|LeftUpLeg LeftLeg LeftFoot LeftForeFoot",
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


@pytest.mark.parametrize("kind", [*RIGS, "biped_spaces"])
def test_rigs_of_the_field(kind):
    skeleton = rig(kind.removesuffix("_spaces"))
    expected = EXPECTED[kind.removesuffix("_spaces")]
    if kind.endswith("_spaces"):  # as 3ds Max writes them
        skeleton = renamed(skeleton, {name: name.replace("_", " ") for name in skeleton.names})
        assert told(skeleton).replace("Bip01 ", "Bip01_").replace("_L ", "_L_") == expected
        return
    assert told(skeleton) == expected
    to_right = dict(left_right_pairs(skeleton))
    words = [to_right.get(word, word) for word in expected.replace("|", " | ").split()]
    assert told(skeleton, "right") == " ".join(words).replace(" | ", "|")


@pytest.mark.parametrize("prefix", ["mixamorig:", "mixamorig9:", "Character1_"])
def test_prefixes_of_joint_names_are_ignored(prefix):
    plain = rig("mixamo")
    skeleton = renamed(plain, {name: prefix + name for name in plain.names})
    assert told(skeleton).replace(prefix, "") == EXPECTED["mixamo"]
    assert len(body_joints(skeleton)) == 22


@pytest.mark.parametrize(("n_joints", "n_body"), [(22, 22), (24, 24), (52, 22), (55, 22)])
def test_smpl_family(n_joints, n_body):
    skeleton = smpl_skeleton(n_joints)
    assert told(skeleton) == EXPECTED["smpl"]
    assert len(body_joints(skeleton)) == n_body
    # Of legs and arms 8, then hands, or 15 joints of fingers, and eyes.
    assert len(left_right_pairs(skeleton)) == {22: 8, 24: 9, 52: 23, 55: 24}[n_joints]


def test_fingers_ends_and_face_are_not_body_joints():
    parts = find_parts(rig("acclaim"))
    assert parts.fingers == ("lfingers", "lthumb", "rfingers", "rthumb")  # "lhand" is a hand
    parts = find_parts(rig("mixamo"))
    assert len(parts.fingers) == 8
    assert parts.ends == ("HeadTop_End", "LeftToe_End", "RightToe_End")
    assert find_parts(smpl_skeleton(55)).face == ("jaw", "left_eye_smplhf", "right_eye_smplhf")


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


def test_parts_named_by_hand():
    plain = rig("mixamo")  # all in one point: the shape identifies no part
    skeleton = numbered(plain)
    with pytest.raises(MotionError, match="left_elbow=JOINT"):
        find_parts(skeleton)
    named = numbered_limbs(plain)
    parts = find_parts(skeleton.with_parts(named))
    assert parts.pelvis == "Joint0" and parts.spine == ("Joint1", "Joint2", "Joint3")
    # A skeleton keeps them.
    holding = Skeleton.from_json(replace(skeleton, parts=named).to_json())
    assert find_parts(holding) == parts == find_parts(holding.scaled(2.0))
    with pytest.raises(MotionError, match="left_elbo"):
        find_parts(skeleton.with_parts({"left_elbo": "Joint1"}))
    with pytest.raises(MotionError, match=r"(?=.*left_elbow).*'Joint99'"):
        replace(skeleton, parts={"left_elbow": "Joint99"})


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        ({"left_elbow": "LeftLeg"}, "(?=.*'mixamorig:LeftLeg')(?=.*left_elbow).*left_knee"),
        (
            {"left_ankle": "RightFoot", "right_ankle": "LeftFoot"},
            "(?=.*RightFoot').*'mixamorig:LeftLeg'",
        ),
        ({"left_hip": "Spine1"}, "(?=.*'mixamorig:LeftLeg')(?=.*left knee).*'mixamorig:Spine1'"),
        ({"left_elbow": "LeftArm"}, r"(?=.*'mixamorig:LeftArm')(?=.*\b0.13\b).*0.55 m"),
        ({"head": "LeftHand"}, "(?=.*'mixamorig:LeftHand').*head"),
    ],
)
def test_wrong_parts_fail_loudly(mixamo, overrides, says):
    with pytest.raises(MotionError, match=says):
        by_hand = {part: f"mixamorig:{name}" for part, name in overrides.items()}
        find_parts(mixamo.with_parts(by_hand))


def test_labels(mixamo):
    labels = part_labels(mixamo)
    assert set(labels) == set(mixamo.names)
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
    genea = part_labels(rig("genea"))
    assert (genea["body_world"], genea["b_l_arm_twist"]) == ("root", "twist")
    assert genea["p_navel"] == "other"


def test_what_else_hangs_on_a_rig_is_neither_head_nor_legs():
    """A lamp on the chest before the neck, and a crab of ten legs, two of which are named."""
    trunk = {name: PERSON[name] for name in ("Hips", "Spine", "Chest")}
    lamp = {f"Lamp{k}": (f"Lamp{k - 1}" if k else "Chest", (0.0, 0.1, 0.1)) for k in range(3)}
    lamp["LampHead"] = ("Lamp2", (0.0, 0.1, 0.1))
    assert find_parts(rig_of(trunk | lamp | PERSON)).head == "Head"
    crab = {"Body": (None, (0.0, 0.0, 0.0))}
    for k in range(10):
        above, side = "Body", ("Left", "Right")[k] if k < 2 else f"Limb{k}"
        for part in ("UpLeg", "Leg", "Foot"):
            crab[side + part], above = (above, (0.1, -0.1, 0.1 * k)), side + part
    assert find_legs(rig_of(crab)) is None


def one_armed(*missing: str) -> Skeleton:
    return rig_of({k: v for k, v in PERSON.items() if not k.startswith(missing)})


def test_parts_that_a_rig_lacks_are_named_and_the_others_labelled():
    arm = ("RightShoulder", "RightArm", "RightForeArm", "RightHand")
    labels, reason = known_part_labels(one_armed(*arm))
    usual = part_labels(rig_of(PERSON))
    assert labels == {name: label for name, label in usual.items() if name not in arm}
    assert "right arm" in reason and "--part right_" in reason
    leg = ("LeftUpLeg", "LeftLeg", "LeftFoot")
    labels, reason = known_part_labels(one_armed(*arm, *leg))
    assert "right arm" in reason and "left leg" in reason
    known = {"LeftForeArm": "left elbow", "RightFoot": "right ankle", "Head": "head"}
    assert {name: labels[name] for name in known} == known
    # Without two hips there is no pelvis, and so no spine.
    assert labels["Hips"] == labels["Spine"] == "other" and labels["Neck"] == "neck"
    legs = one_armed(*arm, *(name.replace("Right", "Left") for name in arm))
    labels, reason = known_part_labels(legs)
    assert "arms" in reason
    found = [labels[name] for name in ("Hips", "RightLeg", "Chest")]
    assert found == ["pelvis", "right knee", "other"]
    assert known_part_labels(rig_of(PERSON)) == (usual, "")


@pytest.mark.parametrize(
    ("texts", "says"),
    [
        (["left_elbow"], "(?=.*'left_elbow').*PART=JOINT"),
        (["elbow=a"], "'elbow=a'"),
        (["head="], "'head='"),
    ],
)
def test_parts_on_a_command_line(texts, says):
    assert parse_parts(["left_elbow=Joint=12", "head=a"]) == {"left_elbow": "Joint=12", "head": "a"}
    with pytest.raises(MotionError, match=says):
        parse_parts(texts)
