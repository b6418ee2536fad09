"""Inspecting motion: what is said of rigs and of how they move."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from gesturekit.errors import GestureKitError
from gesturekit.inspection import Sheet, inspect
from gesturekit.inspection.tree import tree
from gesturekit.motion import Motion, Skeleton


def row(sheet: Sheet, label: str) -> str:
    return dict(sheet.rows)[label]


def test_a_gesture(gesture, tmp_path):
    gesture(4.0, t_pose=15).save(tmp_path / "take.bvh")
    sheet = inspect(tmp_path / "take.bvh")
    assert sheet.kind == "motion"
    assert row(sheet, "time").startswith("4.00 s: 120 frames at 30 fps")
    assert row(sheet, "axes").startswith("cm, Y up, Z forward, the body faces +Z")
    assert "19 joints, 5 end sites" in row(sheet, "body")
    assert "nothing changes place" in row(sheet, "moves")
    assert any("T-pose: the first 15 frames" in problem for problem in sheet.problems)
    facts = json.loads(json.dumps(sheet.to_json(), allow_nan=False))
    assert facts["parts"]["LeftForeArm"] == "left elbow"
    assert 1.2 < facts["height"] < 2.2 and facts["contact_share"].keys() == {"left", "right"}


def test_what_looks_wrong_is_told_with_its_frame(gesture, tmp_path):
    motion = gesture(4.0)
    rotations = motion.rotations.copy()
    rotations[30:70] = rotations[30]
    rotations[100, motion.skeleton.index("LeftArm")] = [1.0, 0.0, 0.0, 0.0]
    rotations[20, motion.skeleton.index("Head")] = [0.0, 0.3, 0.0, 0.95]
    replace(motion, rotations=rotations).save(tmp_path / "take.npz")
    problems = " ".join(inspect(tmp_path / "take.npz").problems)
    assert "nothing moves from 1.00 to 2.33 s" in problems
    assert "m/s of LeftHand: frames 100 (3.33 s), 101" in problems
    # The arm's pop is the jump of its hand, as in `prepare`.
    assert "1 pop away and back" in problems and "of Head: frame 20 (0.67 s)" in problems


def test_parts_can_be_named_by_hand(gesture, tmp_path):
    gesture(1.0).save(tmp_path / "take.bvh")
    named = inspect(tmp_path / "take.bvh", parts={"head": "Neck"})
    assert named.facts["parts"]["Neck"] == "head"
    for parts, says in (
        ({"left_elbo": "LeftArm"}, "no part is called 'left_elbo'"),
        ({"left_elbow": "Elbow"}, "no joint 'Elbow'"),
        ({"left_elbow": "RightFoot"}, "RightFoot"),
    ):
        with pytest.raises(GestureKitError, match=says):
            inspect(tmp_path / "take.bvh", parts=parts)


def test_a_rig_that_is_no_body_is_told_as_it_is(tmp_path):
    names = ("rope", "rope1", "rope2", "tail")
    rope = Skeleton(names, (-1, 0, 1, 0), [[0, 0, 0], [0, 0.5, 0], [0, 0.5, 0], [0.1, 0, 0]])
    turned = np.tile([0.0, 0.0, 0.0, 1.0], (5, 4, 1))
    Motion(rope, turned, np.zeros((5, 3)), 30.0).save(tmp_path / "rope.bvh")
    sheet = inspect(tmp_path / "rope.bvh")
    assert sheet.drawing(100) == ["rope", "├─ rope1 > rope2", "└─ tail"]
    assert sheet.facts["parts"] == {} and sheet.problems
    assert "guessed" in row(sheet, "axes") and "feet" not in dict(sheet.rows)


def test_one_frame_is_enough(gesture, tmp_path):
    gesture(1.0).slice(3, 4).save(tmp_path / "one.bvh")
    sheet = inspect(tmp_path / "one.bvh")
    assert "1 frame at 30 fps" in row(sheet, "time") and sheet.problems == ()


def test_the_tree_names_every_joint_but_fingers_and_fits(shared_data):
    for file, most in (
        ("paired/zeggs_067_Speech_2/067_Speech_2_x_1_0.bvh", 20),
        ("motion/bandai/dataset-1_bye_old_001.bvh", 12),
        ("smpl/glamr_running_smpl.npz", 15),
    ):
        sheet = inspect(shared_data / file)
        assert max(map(len, sheet.lines(100))) <= 100 and max(map(len, sheet.lines(72))) <= 72
        assert len(sheet.drawing(100)) <= most, "one screen"
        text, parts = "\n".join(sheet.drawing(100)), sheet.facts["parts"]
        for name in sheet.facts["joints"]:
            assert name in text or parts[name] in ("finger", "end"), name
        assert "[left elbow]" in text and "[right knee]" in text


def test_a_tree_of_one_joint_and_of_no_parts(gesture):
    from gesturekit.motion.joint_selection import keep_joints

    motion = gesture(0.5)
    assert tree(keep_joints(motion, ["Hips"]).skeleton, {}) == ["Hips"]
    assert "LeftHand" in "\n".join(tree(motion.skeleton, {}))


def test_a_rig_as_deep_as_a_file_may_be():
    """A comb: each joint has a tooth and the next joint."""
    names, parents = ["j0"], [-1]
    for depth in range(1500):
        names += [f"j{depth + 1}", f"tooth{depth}"]
        parents += [0 if depth == 0 else 2 * depth - 1] * 2
    comb = Skeleton(tuple(names), tuple(parents), np.zeros((len(names), 3)))
    assert len(tree(comb, {})) == 3001


def test_what_a_reader_warns_of_is_a_problem_told(tmp_path):
    person = {"Rh": [[0.0] * 3], "Th": [[0.0] * 3], "poses": [[0.01] * 72]}
    for k in range(8):
        people = [person | {"id": 1}, person | {"id": 2}]
        (tmp_path / f"{k:06d}.json").write_text(json.dumps(people))
    sheet = inspect(tmp_path, read={"person": 2})
    assert sheet.facts["format"] == "EasyMocap" and sheet.facts["frames"] == 8
    assert any("several people" in problem for problem in inspect(tmp_path).problems)


def test_every_recording_is_told(shared_data):
    for path in sorted((shared_data / "motion").rglob("*.bvh"))[::6]:
        sheet = inspect(path)
        assert sheet.facts["frames"] == Motion.load(path).n_frames
        assert np.isfinite(sheet.facts["height"]) and 1.2 < sheet.facts["height"] < 2.1
