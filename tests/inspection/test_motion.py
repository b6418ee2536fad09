"""Inspecting motion: what is said of rigs and of how they move."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from avatars import BONES, avatar_json, packed
from rigs import PERSON, nameless, rig_of
from scipy.spatial.transform import Rotation

from gesturekit.conversion.convert import convert
from gesturekit.corpus import prepare
from gesturekit.errors import GestureKitError
from gesturekit.inspection import Summary, inspect
from gesturekit.inspection.tree import tree
from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.parts.body_size import body_scale
from gesturekit.systems import model_folder


def row(summary: Summary, label: str) -> str:
    return dict(summary.rows)[label]


def test_a_gesture(gesture, tmp_path):
    gesture(4.0, t_pose=15).save(tmp_path / "take.bvh")
    summary = inspect(tmp_path / "take.bvh")
    assert summary.kind == "motion"
    assert row(summary, "time").startswith("4.00 s: 120 frames at 30 fps")
    assert row(summary, "axes").startswith("cm, Y up, Z forward, the body faces +Z")
    assert "19 joints, 5 end sites" in row(summary, "body")
    assert "nothing changes place" in row(summary, "moves")
    jump, pose = summary.problems
    assert jump.endswith(" of RightHand: frame 15 (0.50 s)")
    assert pose == "rest pose or T-pose: the first 15 frames"
    facts = json.loads(json.dumps(summary.to_json(), allow_nan=False))
    assert facts["parts"]["LeftForeArm"] == "left elbow"
    assert 0 < facts["hand_speed_mean"] < 0.5 * facts["hand_speed_max"]
    assert 1.2 < facts["height"] < 2.2 and facts["contact_share"].keys() == {"left", "right"}


@pytest.fixture
def walk():
    """walk(degrees=0): 41 frames at 20 fps. Half a second of 2 m/s ahead, a quarter back, then the
    body stands; the left forearm turns by 2 rad/s all the time, its hand on a circle of 0.25 m.
    """
    orders = ["ZXY"] * len(PERSON)
    orders[6] = "XYZ"
    ends = {"Head": (np.array([0.0, 0.15, 0.0]),)}
    rig = rig_of(PERSON, end_sites=ends, rotation_orders=tuple(orders))

    def make(degrees: float = 0.0) -> Motion:
        frames = np.arange(41)
        rotations = np.tile([0.0, 0.0, 0.0, 1.0], (41, rig.n_joints, 1))
        turns = {"LeftArm": (2, -1.2), "RightArm": (2, 1.2), "LeftForeArm": (1, 0.1 * frames)}
        for name, (axis, angle) in turns.items():
            rotations[:, rig.index(name), [axis, 3]] = np.stack(
                np.broadcast_arrays(np.sin(np.asarray(angle) / 2), np.cos(np.asarray(angle) / 2)),
                -1,
            )
        turn = Rotation.from_euler("y", degrees, degrees=True)
        rotations[:, 0] = turn.as_quat()
        ahead = 0.1 * np.minimum(frames, 10) - 0.1 * np.clip(frames - 10, 0, 5)
        place = turn.apply(ahead[:, None] * [0.0, 0.0, 1.0]) + [0.0, 0.9, 0.0]
        return Motion(rig, rotations, place, 20.0)

    return make


@pytest.mark.parametrize(("degrees", "side"), [(0, "+Z"), (90, "+X"), (136, "-Z"), (-90, "-X")])
def test_every_row_of_a_walk_of_known_size(walk, tmp_path, degrees, side):
    walk(degrees).save(tmp_path / "walk.bvh")
    summary = inspect(tmp_path / "walk.bvh")
    height, rows = summary.facts["height"], dict(summary.rows)
    assert list(rows) == ["time", "axes", "body", "channels", "moves", "hands", "feet", "floor"]
    assert rows["time"] == "2.05 s: 41 frames at 20 fps (Frame Time: 0.0500000000)"
    shown = round(summary.facts["facing_degrees"])
    assert (shown - degrees) % 360 == 0
    about = f"cm, Y up, Z forward, the body faces {side} ({shown}° about Y) on average"
    assert rows["axes"] == about
    assert rows["body"] == f"{height:.2f} m from sole to crown, 19 joints, 1 end site"
    assert rows["channels"] == "angles ZXY, XYZ on 1 joint; positions of Hips"
    still = "not Hips, Spine, Chest, Neck and 14 more"
    goes = "Hips changes place; the body goes 1.5 m and ends 0.5 m from where it began"
    assert rows["moves"] == f"1 of 19 joints turn ({still}); {goes}"
    hands = "0.50 m/s on average, 0.50 at most (both together, relative to the pelvis)"
    assert rows["hands"] == hands
    # 25 or 26 of 41 frames.
    assert re.fullmatch(r"stand still .*: left 6[13] %, right 6[13] % of the frames", rows["feet"])
    assert rows["floor"].endswith(f" at Y = {summary.facts['floor']:.2f} m")
    low = walk(degrees)
    replace(low, translation=low.translation - [0.0, 0.4, 0.0]).save(tmp_path / "low.bvh")
    sunk = inspect(tmp_path / "low.bvh").facts["floor"]
    assert sunk == pytest.approx(summary.facts["floor"] - 0.4, abs=1e-6)
    assert summary.facts["path_length"] == pytest.approx(1.5, abs=1e-6)
    assert summary.facts["displacement"] == pytest.approx(0.5, abs=1e-6)
    assert summary.facts["turning_joints"] == ["LeftForeArm"] and summary.problems == ()


def test_the_body_goes_where_its_pelvis_goes(walk, tmp_path):
    """A pelvis below a root that moves too, and a rope whose tail alone moves."""
    motion = walk()
    old = motion.skeleton
    rig = replace(
        old,
        names=("Root", *old.names),
        parents=(-1, *(parent + 1 for parent in old.parents)),
        offsets=np.concatenate([np.zeros((1, 3)), old.offsets]),
        rotation_orders=("ZXY", *old.rotation_orders),
    )
    still = np.tile([0.0, 0.0, 0.0, 1.0], (41, 1, 1))
    steps = np.linspace(0.0, 1.0, 41)[:, None]
    rotations = np.concatenate([still, motion.rotations], axis=1)
    moved = {"Hips": steps * [0.0, 0.0, 1.0]}
    both = Motion(rig, rotations, steps * [0.0, 0.0, 1.0], 20.0, joint_translations=moved)
    both.save(tmp_path / "a.npz")
    facts = inspect(tmp_path / "a.npz").facts
    assert facts["travelling_joints"] == ["Root", "Hips"]
    assert facts["path_length"] == pytest.approx(2.0) == facts["displacement"]
    rope = Skeleton(("rope", "tail"), (-1, 0), [[0, 0, 0], [0, 0.5, 0]])
    tail = {"tail": steps * [0.0, 0.0, 0.7]}
    Motion(rope, still.repeat(2, 1), np.zeros((41, 3)), 20.0, joint_translations=tail).save(
        tmp_path / "a.npz"
    )
    facts = inspect(tmp_path / "a.npz").facts
    assert facts["travelling_joints"] == ["tail"]
    assert facts["path_length"] == pytest.approx(0.7)


def test_a_child_stands_and_travels_by_its_size(walk, tmp_path):
    """Half the size: a tenth of a millimetre is 0.05 mm, and 0.2 m/s of a still foot is 0.1."""
    motion = walk()
    offsets = 0.5 / body_scale(motion.skeleton) * motion.skeleton.offsets
    rig = replace(motion.skeleton, offsets=offsets, end_sites={})
    still = np.tile([0.0, 0.9, 0.0], (41, 1))
    for far, says in ((0.7e-4, "Hips changes place"), (0.3e-4, "nothing changes place")):
        place = still + np.linspace(0.0, far, 41)[:, None] * [0.0, 0.0, 1.0]
        replace(motion, skeleton=rig, translation=place).save(tmp_path / "a.npz")
        rows = dict(inspect(tmp_path / "a.npz").rows)
        assert says in rows["moves"] and "(heel or toe below 0.1 m/s)" in rows["feet"]


def test_names_that_repeat_in_a_file_are_listed(walk, tmp_path):
    walk().save(tmp_path / "a.bvh")
    text = (tmp_path / "a.bvh").read_text().replace("JOINT RightHand", "JOINT LeftHand")
    (tmp_path / "a.bvh").write_text(text)
    renamed = row(inspect(tmp_path / "a.bvh"), "renamed")
    assert renamed == "names that repeat: LeftHand_2 (was LeftHand)"


def test_an_upper_body_is_said_to_be_one(walk, tmp_path):
    motion = walk()
    names = motion.skeleton.names
    motion.keep([n for n in names if "Leg" not in n and "Foot" not in n]).save(tmp_path / "a.npz")
    rows = dict(inspect(tmp_path / "a.npz").rows)
    assert " m as a whole person, by its arms, 13 joints, 1 end site" in rows["body"]
    assert rows["legs"] == "no legs: upper body only; contacts and foot metrics are left out"
    assert "feet" not in rows and "channels" not in rows


def test_fingers_and_faces_are_counted(tmp_path):
    text = (model_folder("demo") / "skeleton.json").read_text(encoding="utf-8")
    rig = Skeleton.from_json(json.loads(text)["skeleton"])
    still = np.tile([0.0, 0.0, 0.0, 1.0], (30, rig.n_joints, 1))
    Motion(rig, still, np.zeros((30, 3)), 30.0).save(tmp_path / "a.npz")
    summary = inspect(tmp_path / "a.npz")
    n_ends = sum(map(len, rig.end_sites.values()))
    assert f" 52 joints, 30 of fingers, {n_ends} end sites" in row(summary, "body")
    assert row(summary, "moves") == "0 of 52 joints turn; nothing changes place"
    assert any("rest pose or a T-pose all the time" in problem for problem in summary.problems)
    text = "\n".join(summary.drawing(100))
    assert "└─ 15 joints of fingers: LeftHandThumb1, LeftHandIndex1, LeftHandMiddle1" in text


def test_the_tree_of_a_person(walk):
    labels = {"Hips": "pelvis", "Spine": "spine", "Chest": "spine", "Head": "other"}
    assert tree(walk().skeleton, labels, width=48) == [
        "Hips [pelvis]",
        "├─ Spine > Chest [spine]",
        "│  ├─ Neck > Head",
        "│  ├─ LeftShoulder > LeftArm > LeftForeArm",
        "│  │   > LeftHand",
        "│  └─ RightShoulder > RightArm > RightForeArm",
        "│      > RightHand",
        "├─ LeftUpLeg > LeftLeg > LeftFoot",
        "└─ RightUpLeg > RightLeg > RightFoot",
    ]
    longest = "│  └─ RightShoulder > RightArm > RightForeArm > RightHand"
    for width, fits in ((len(longest), True), (len(longest) - 1, False)):
        assert (longest in tree(walk().skeleton, labels, width)) == fits


def test_rest_poses_at_both_ends_trembling_and_many_jumps(gesture, tmp_path):
    motion = gesture(4.0, t_pose=15)
    rotations = motion.rotations.copy()
    rotations[-10:] = [0.0, 0.0, 0.0, 1.0]
    replace(motion, rotations=rotations).save(tmp_path / "a.npz")
    problems = inspect(tmp_path / "a.npz").problems
    assert "rest pose or T-pose: the first 15 frames and the last 10 frames" in problems
    rotations = gesture(4.0).rotations.copy()
    swing = Rotation.from_rotvec([[0.0, 0.0, 0.06], [0.0, 0.0, -0.06]] * 60)
    for joint in range(1, motion.skeleton.n_joints):
        rotations[:, joint] = (Rotation.from_quat(rotations[:, joint]) * swing).as_quat()
    replace(motion, rotations=rotations).save(tmp_path / "a.npz")
    trembles = [p for p in inspect(tmp_path / "a.npz").problems if "tremble" in p]
    share = int(re.search(r"frame to frame in (\d+) % of the time", trembles[0])[1])
    assert 50 < share <= 100
    rotations = gesture(4.0).rotations.copy()
    arm = motion.skeleton.index("LeftArm")
    rotations[20:110:15, arm] = [1.0, 0.0, 0.0, 0.0]  # 6 frames, each jumped to and from
    replace(motion, rotations=rotations).save(tmp_path / "a.npz")
    jumps = next(p for p in inspect(tmp_path / "a.npz").problems if "12 jumps" in p)
    assert jumps.endswith("frames 20 (0.67 s), 21 (0.70 s), 35 (1.17 s), 36 (1.20 s) and 8 more")
    rotations[45:, arm] = gesture(4.0).rotations[45:, arm]
    replace(motion, rotations=rotations).save(tmp_path / "a.npz")
    jumps = next(p for p in inspect(tmp_path / "a.npz").problems if "4 jumps" in p)
    assert jumps.endswith("frames 20 (0.67 s), 21 (0.70 s), 35 (1.17 s), 36 (1.20 s)")


def test_the_heading_of_a_rotated_file_is_reported_in_our_axes(gesture, tmp_path):
    gesture(1.0).save(tmp_path / "take.bvh")
    axes = row(inspect(tmp_path / "take.bvh", read={"up": "z"}), "axes")
    assert "Z up" in axes and ", read as Y up, Z forward, the body faces " in axes


def test_suspicious_motion_is_reported_with_its_frame(gesture, tmp_path):
    motion = gesture(4.0)
    rotations = motion.rotations.copy()
    rotations[30:70] = rotations[30]
    rotations[100, motion.skeleton.index("LeftArm")] = [1.0, 0.0, 0.0, 0.0]
    rotations[20, motion.skeleton.index("Head")] = [0.0, 0.3, 0.0, 0.95]
    replace(motion, rotations=rotations).save(tmp_path / "take.npz")
    problems = " ".join(inspect(tmp_path / "take.npz").problems)
    assert "nothing moves from 1.00 to 2.33 s (frames 30 to 69)" in problems
    assert "m/s of LeftHand: frames 100 (3.33 s), 101" in problems
    # The arm's pop is the jump of its hand, as in `prepare`.
    # Its sine and cosine are .3 and .95: twice 17.5 degrees, and those of the gesture.
    pop = r"1 pop away and back, the largest (\d+)° of Head: frame 20 \(0\.67 s\)"
    assert 20 < int(re.search(pop, problems)[1]) < 50


def test_parts_can_be_named_by_hand(gesture, tmp_path):
    gesture(1.0).save(tmp_path / "take.bvh")
    named = inspect(tmp_path / "take.bvh", parts={"head": "Neck"})
    assert named.facts["parts"]["Neck"] == "head"
    for parts, says in (
        ({"left_elbo": "LeftArm"}, "no part is called 'left_elbo'"),
        ({"left_elbow": "Elbow"}, "no joint 'Elbow'"),
    ):
        with pytest.raises(GestureKitError, match=says):
            inspect(tmp_path / "take.bvh", parts=parts)
    wrong = inspect(tmp_path / "take.bvh", parts={"left_elbow": "RightFoot"})
    assert "'RightFoot'" in wrong.problems[0] and wrong.facts["parts"]["Head"] == "head"


def test_a_rig_that_is_not_a_body_is_described(tmp_path, save_as_others):
    names = ("rope", "rope1", "rope2", "tail")
    rope = Skeleton(names, (-1, 0, 1, 0), [[0, 0, 0], [0, 0.5, 0], [0, 0.5, 0], [0.1, 0, 0]])
    turned = np.tile([0.0, 0.0, 0.0, 1.0], (5, 4, 1))
    save_as_others(Motion(rope, turned, np.zeros((5, 3)), 30.0), tmp_path / "rope.bvh")
    summary = inspect(tmp_path / "rope.bvh")
    assert summary.drawing(100) == ["rope", "├─ rope1 > rope2", "└─ tail"]
    assert summary.facts["parts"] == {} and summary.problems
    assert "guessed" in row(summary, "axes") and "feet" not in dict(summary.rows)


@pytest.mark.parametrize(
    "version, meta, named",
    [
        (1, {"name": "Ann", "authors": ["B", "C"], "licenseUrl": "vrm.dev/1.0"}, "Ann, by B, C"),
        (0, {"title": "Ann", "author": 3, "licenseName": "vrm.dev/1.0"}, "Ann"),
    ],
)
def test_an_avatar(version, meta, named, tmp_path, recwarn):
    found, data = avatar_json(version)
    found["extensions"]["VRMC_vrm" if version else "VRM"]["meta"] = meta
    (tmp_path / "me.vrm").write_bytes(packed(found, data))
    summary = inspect(tmp_path / "me.vrm")
    assert summary.title.startswith(f"{tmp_path / 'me.vrm'}: avatar, vrm, ") and not recwarn.list
    vrm = f"VRM {'1.0' if version else '0.x'}, {len(BONES)} humanoid bones, {named}"
    assert row(summary, "avatar") == vrm and row(summary, "licence") == "vrm.dev/1.0"
    # A mesh without a skin hangs on its bones, which are still the joints.
    plain = {name: value for name, value in found.items() if name != "skins"}
    plain["nodes"] = [{k: v for k, v in node.items() if k != "skin"} for node in found["nodes"]]
    (tmp_path / "plain.vrm").write_bytes(packed(plain, data))
    assert inspect(tmp_path / "plain.vrm").facts["joints"] == summary.facts["joints"]
    assert row(summary, "contents") == "1 mesh, 0 animations" and summary.problems == ()
    assert f"{len(BONES) + 1} joints" in row(summary, "body")  # and one of the hair
    del meta["licenseUrl" if version else "licenseName"]
    (tmp_path / "me.vrm").write_bytes(packed(found, data))
    assert row(inspect(tmp_path / "me.vrm"), "licence") == "none named"


def test_the_contents_of_a_glb(gesture, tmp_path):
    gesture(0.5).save(tmp_path / "take.glb")  # 19 joints; Mixamo has Spine1 for its Chest
    summary = inspect(tmp_path / "take.glb")
    assert row(summary, "contents") == "1 mesh, 1 animation: take"
    assert row(summary, "avatar").startswith("18 bones with Mixamo's names")


def test_one_frame_is_enough(gesture, tmp_path):
    gesture(1.0)[3:4].save(tmp_path / "one.bvh")
    summary = inspect(tmp_path / "one.bvh")
    assert "1 frame at 30 fps" in row(summary, "time") and summary.problems == ()
    rests = gesture(1.0, t_pose=3)
    rests[:1].save(tmp_path / "one.bvh")
    assert "hands" not in dict(summary.rows) and inspect(tmp_path / "one.bvh").problems == ()
    rests[:2].save(tmp_path / "two.bvh")
    summary = inspect(tmp_path / "two.bvh")
    assert "it is in its rest pose or a T-pose all the time" in summary.problems
    assert row(summary, "hands").startswith("0.00 m/s on average")
    rests[2:4].save(tmp_path / "two.bvh")
    assert "rest pose or T-pose: the first 1 frame" in inspect(tmp_path / "two.bvh").problems


def test_the_tree_names_every_joint_but_fingers_and_fits(shared_data):
    for file, most in (
        ("paired/zeggs_067_Speech_2/067_Speech_2_x_1_0.bvh", 20),
        ("motion/bandai/dataset-1_bye_old_001.bvh", 12),
        ("smpl/glamr_running_smpl.npz", 15),
    ):
        summary = inspect(shared_data / file)
        assert max(map(len, summary.lines(100))) <= 100 and max(map(len, summary.lines(72))) <= 72
        assert len(summary.drawing(100)) <= most, "one screen"
        text, parts = "\n".join(summary.drawing(100)), summary.facts["parts"]
        for name in summary.facts["joints"]:
            assert name in text or parts[name] in ("finger", "end"), name
        assert "[left elbow]" in text and "[right knee]" in text


@pytest.mark.parametrize(
    ("names", "parents", "lines"),
    [
        (
            ["Hand", "Index1", "Index2"],
            [-1, 0, 1],
            ["Hand [left wrist] > Index1 > Index2 [finger]"],
        ),
        (
            ["Hand", "Index1", "Index2", "Thumb1"],
            [-1, 0, 1, 0],
            ["Hand [left wrist]", "└─ 3 joints of fingers: Index1, Thumb1"],
        ),
        (["Arm", "Top", "Hand"], [-1, 0, 0], ["Arm > Hand [left wrist] + Top [end]"]),
        (["Arm", "Top"], [-1, 0], ["Arm > Top [end]"]),
    ],
)
def test_fingers_and_ends_in_a_tree(names, parents, lines):
    kinds = {"Hand": "left wrist", "Top": "end", "Arm": None}
    labels = {name: kinds.get(name, "finger") for name in names if name != "Arm"}
    rig = Skeleton(tuple(names), tuple(parents), np.zeros((len(names), 3)))
    assert tree(rig, labels, 100) == lines


def test_a_tree_of_one_joint_and_of_no_parts(gesture):
    motion = gesture(0.5)
    assert tree(motion.keep(["Hips"]).skeleton, {}, 100) == ["Hips"]
    assert "LeftHand" in "\n".join(tree(motion.skeleton, {}, 100))


def test_a_rig_as_deep_as_a_file_may_be():
    """A comb: each joint has a tooth and the next joint."""
    names, parents = ["j0"], [-1]
    for depth in range(1500):
        names += [f"j{depth + 1}", f"tooth{depth}"]
        parents += [0 if depth == 0 else 2 * depth - 1] * 2
    comb = Skeleton(tuple(names), tuple(parents), np.zeros((len(names), 3)))
    assert len(tree(comb, {}, 100)) == 3001


def test_warnings_of_a_reader_are_listed_as_problems(tmp_path):
    person = {"Rh": [[0.0] * 3], "Th": [[0.0] * 3], "poses": [[0.01] * 72]}
    for k in range(8):
        people = [person | {"id": 1}, person | {"id": 2}]
        (tmp_path / f"{k:06d}.json").write_text(json.dumps(people))
    summary = inspect(tmp_path, read={"person": 2})
    assert summary.facts["format"] == "EasyMocap" and summary.facts["frames"] == 8
    assert any("several people" in problem for problem in inspect(tmp_path).problems)


def with_frame_time(motion: Motion, path: Path, text: str) -> Path:
    motion.save(path)
    path.write_text(re.sub("Frame Time: .*", f"Frame Time: {text}", path.read_text()))
    return path


@pytest.mark.parametrize(
    ("frame_time", "says"),
    [
        ("33.333", "0.03 fps: is Frame Time in milliseconds? --in-fps 30 sets the rate"),
        ("30", "0.033 fps: does Frame Time hold the rate? --in-fps 30 sets the rate"),
        ("0.0000333", "30030 fps: is Frame Time 1000 times too small? --in-fps 30 sets the rate"),
    ],
)
def test_an_implausible_frame_rate_is_questioned(gesture, tmp_path, frame_time, says):
    path = with_frame_time(gesture(2.0), tmp_path / "a.bvh", frame_time)
    assert inspect(path).problems[0] == says
    assert not any("fps" in problem for problem in inspect(path, read={"fps": 30.0}).problems)
    (outcome,) = convert(path, tmp_path / "b.npz", dry_run=True)
    assert outcome.facts["warnings"] == (f"{path}: {says}",)
    report = prepare([], unpaired_motion=[tmp_path])
    assert says in [problem.message for problem in report.problems]


def test_bones_without_length_are_reported(gesture, tmp_path):
    motion = gesture(2.0)
    flat = replace(motion.skeleton, offsets=np.zeros((motion.skeleton.n_joints, 3)))
    replace(motion, skeleton=flat).save(tmp_path / "a.npz")
    assert any("all bones have length 0" in text for text in inspect(tmp_path / "a.npz").problems)
    report = prepare([], unpaired_motion=[tmp_path])
    assert any("all bones have length 0" in problem.message for problem in report.problems)


def test_a_mirrored_body_is_doubted(gesture, tmp_path):
    motion = gesture(2.0)
    rig = motion.skeleton
    names, parents, offsets = list(rig.names), list(rig.parents), list(rig.offsets)
    for side in ("Left", "Right"):
        names.append(f"{side}ToeBase")
        parents.append(rig.index(f"{side}Foot"))
        offsets.append(np.array([0.0, -0.05, 0.12]))
    still = np.tile([0.0, 0.0, 0.0, 1.0], (motion.n_frames, 2, 1))
    rotations = np.concatenate([motion.rotations, still], axis=1)
    swap = {"Left": "Right", "Right": "Left"}
    swapped = [re.sub("^(Left|Right)", lambda m: swap[m[0]], name) for name in names]
    for sides, is_told in ((names, False), (swapped, True)):
        skeleton = Skeleton(tuple(sides), tuple(parents), np.array(offsets))
        replace(motion, skeleton=skeleton, rotations=rotations).save(tmp_path / "a.npz")
        problems = inspect(tmp_path / "a.npz").problems
        assert any("the toes point backwards" in text for text in problems) == is_told


@pytest.mark.parametrize(
    ("read", "says"),
    [
        ({"height": 0.1}, "--height 0.1 makes the body 0.10 m tall"),
        ({"unit": "m"}, "--in-unit m makes the body "),
        ({"up": "z"}, "--in-up z lays the body down"),
    ],
)
def test_implausible_options_are_reported(gesture, tmp_path, read, says):
    gesture(2.0).save(tmp_path / "a.bvh")
    assert any(says in problem for problem in inspect(tmp_path / "a.bvh", read=read).problems)
    usual = {"height": 1.2, "unit": "cm", "up": "y"}
    assert inspect(tmp_path / "a.bvh", read=usual).problems == ()


def test_height_scales_the_body(gesture, tmp_path):
    """Nothing but its feet tells the parts of this rig, and an exporter made up their ends."""
    motion, _ = nameless(gesture(1.0))
    usual = gesture(1.0).skeleton.names
    ends = [j for j, name in enumerate(usual) if name.endswith(("Foot", "Hand"))]
    sites = {f"Joint{j}": (np.array([0.0, -0.05, 0.15]),) for j in ends}
    rig = replace(motion.skeleton, end_sites=sites)
    replace(motion, skeleton=rig).save(tmp_path / "a.npz")
    summary = inspect(tmp_path / "a.npz", read={"height": 1.0})
    assert summary.facts["height"] == pytest.approx(1.0)


@pytest.mark.parametrize("parts", [{}, {"right_elbow": "RightForeArm"}])
def test_a_rig_that_lacks_an_arm_shows_all_its_other_parts(gesture, tmp_path, parts):
    motion = gesture(1.0)
    kept = [name for name in motion.skeleton.names if not name.startswith(("LeftSh", "LeftArm"))]
    kept = [name for name in kept if name not in ("LeftForeArm", "LeftHand")]
    motion.keep(kept).save(tmp_path / "a.npz")
    summary = inspect(tmp_path / "a.npz", parts=parts)
    labels = summary.facts["parts"]
    told = {name: labels[name] for name in ("Hips", "Chest", "Neck", "Head", "LeftFoot")}
    assert list(told.values()) == ["pelvis", "spine", "neck", "head", "left ankle"]
    assert labels["RightForeArm"] == "right elbow" and "feet" in dict(summary.rows)
    (problem,) = summary.problems
    assert problem.startswith("cannot identify the left arm: specify them if the rig has them")
    assert "metrics of arms and feet are left out" in problem and len(problem) < 180
    assert "speed" in dict(summary.rows)  # that of both hands is not known
