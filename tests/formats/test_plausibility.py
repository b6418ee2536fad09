"""Warnings about motions that were read without error, and the unit that a body's size suggests."""

import re
from dataclasses import replace

import numpy as np
import pytest
from rigs import at_rest, rig_of
from scipy.spatial.transform import Rotation

from gesturekit.formats.conventions import guess_unit, plausibility_warnings
from gesturekit.formats.npz import read_npz
from gesturekit.formats.smpl import smpl_skeleton
from gesturekit.motion.parts.body_size import body_height, stature


@pytest.mark.parametrize(
    ("fps", "frame_time", "says"),
    [
        (1.0, True, None),
        (1000.0, True, None),
        (1500.0, True, r"(?=.*\b1500 fps)(?=.*\b1000\b).*--in-fps 1.5\b"),
        (0.04, True, r"(?=.*\b0.04 fps)(?=.*Frame Time).*--in-fps 25\b"),
        (0.5, True, r"(?=.*\b0.5 fps)(?=.*Frame Time).*--in-fps 500\b"),
        (0.04, False, r"(?=.*\b0.04 fps).*--in-fps 25\b"),
    ],
)
def test_rates_that_nobody_records_at_are_questioned(skeleton, fps, frame_time, says):
    info = {"frame_time": "1"} if frame_time else {}
    motion = replace(at_rest(skeleton, 3, (0, 0.9, 0)), fps=fps, info=info)
    found = plausibility_warnings(motion, {})
    assert len(found) == (says is not None) and (not found or re.search(says, found[0]))
    assert plausibility_warnings(motion, {"fps": fps}) == []


@pytest.mark.parametrize(
    ("reading", "tall", "says"),
    [
        ({"unit": "m"}, 0.5, None),
        ({"unit": "m"}, 0.1, r"(?=.*--in-unit m).*0.10 m\b"),
        ({"unit": "cm"}, 9.0, r"(?=.*--in-unit cm).*9.00 m\b"),
        ({"unit": "cm", "height": 9}, 9.0, r"(?=.*--height 9\b).*9.00 m\b"),
    ],
)
def test_sizes_that_no_body_has_are_named_with_the_option_that_made_them(
    skeleton, reading, tall, says
):
    motion = at_rest(skeleton, 3, (0, 0.9, 0)).scaled(tall / body_height(skeleton))
    found = plausibility_warnings(motion, reading)
    assert len(found) == bool(says) and (not found or re.search(says, found[0]))


@pytest.mark.parametrize(("length", "n_joints"), [(0.0, 1), (0.0, 2), (0.0, 3), (1.0, 2)])
def test_bones_without_length_are_no_body(length, n_joints):
    bones = {f"j{k}": (f"j{k - 1}" if k else None, (0, length, 0)) for k in range(n_joints)}
    motion = replace(at_rest(rig_of(bones), 2), fps=0.5)
    found = plausibility_warnings(motion, {"unit": "m"})
    is_flat = n_joints > 1 and not length
    assert "0.5 fps" in found[0] and len(found) == 1 + is_flat


def test_an_axis_that_lays_the_body_down_is_named(skeleton):
    motion = at_rest(skeleton, 3, (0, 0.9, 0))
    assert plausibility_warnings(motion, {"up": "y"}) == []
    motion.rotations[:, 0] = Rotation.from_euler("x", 90, degrees=True).as_quat()
    motion = replace(motion, translation=np.tile([0, 0, 0.9], (3, 1)))
    (said,) = plausibility_warnings(motion, {"up": "z"})
    assert "--in-up z" in said and not plausibility_warnings(motion, {})


@pytest.mark.parametrize(
    ("metres", "unit"),
    [(1, "m"), (0.01, "cm"), (0.001, "mm"), (0.0254, "inch"), (0.0254 / 0.45, "cmu")],
)
def test_the_size_of_a_body_shows_its_unit(metres, unit):
    rig = smpl_skeleton(22)
    still = at_rest(rig, 1).rotations[0]
    assert guess_unit(rig.scaled(1 / metres), still) == (unit, True)
    for share in (0.95, 2.0):  # from 0.9 m to 2.1 m from the ankles to the head
        other = rig.scaled(share / stature(rig) / 0.01)
        assert guess_unit(other, still) == ("cm", True)


@pytest.mark.parametrize(
    ("width", "column", "names"), [(165, None, True), (165, 80, False), (72, None, True)]
)
def test_hands_under_other_keys_are_named_while_fingers_are_still(tmp_path, width, column, names):
    poses = np.full((20, width), 0.1)
    poses[5, [] if column is None else column] = 0.5
    hands = dict.fromkeys(("left_hand_pca12", "right_hand_pose"), np.ones((20, 12)))
    np.savez(tmp_path / "a.npz", poses=poses, trans=np.zeros((20, 3)), mocap_frame_rate=30, **hands)
    said = [
        line for line in plausibility_warnings(read_npz(tmp_path / "a.npz"), {}) if "hand" in line
    ]
    assert len(said) == names
    for line in said:
        assert "left_hand_pca12" in line and "right_hand_pose" in line
