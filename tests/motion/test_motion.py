import os
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gesturekit.errors import FormatError, MotionError
from gesturekit.motion import Motion
from gesturekit.motion.face import smplx_face


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"rotations": np.ones((60, 3, 4))}, r"(?=.*\(60, 3, 4\)).*\b19 joints"),
        ({"rotations": np.ones((0, 19, 4))}, "frame"),
        ({"translation": np.zeros((59, 3))}, r"(?=.*translation)(?=.*\(59, 3\)).*\(60, 3\)"),
        ({"translation": np.full((60, 3), np.inf)}, "(?=.*translation).*frame 0"),
        ({"fps": float("nan")}, "fps"),
        ({"joint_translations": {"Hips": np.zeros((60, 3))}}, "'Hips'"),
        ({"joint_translations": {"Hip": np.zeros((60, 3))}}, "(?=.*'Hip').*Hips"),
        ({"joint_translations": {"Head": np.zeros((59, 3))}}, r"(?=.*'Head').*\(59, 3\)"),
        ({"rotations": np.full((60, 19, 4), np.nan)}, "(?=.*'Hips').*frame 0"),
        ({"rotations": np.ones((60, 19, 4)) - np.eye(60, 19, -7)[..., None]}, r"frame 7 is \[0"),
        ({"translation": np.zeros((60, 2))}, r"(?=.*\(60, 2\)).*\(60, 3\)"),
        ({"translation": np.eye(60, 3, -7) * 3e38}, r"(?=.*frame 7\b).*3e\+38"),
        ({"face": smplx_face(np.zeros((59, 3)))}, "(?=.*face).*59.*60"),
        ({"face": np.zeros((60, 3))}, "(?=.*face).*FaceTrack"),
    ],
)
def test_invalid_motions_are_refused(moving_person, change, says):
    with pytest.raises(MotionError, match=says):
        replace(moving_person, **change)


def test_positions_are_of_a_joint_by_its_name(moving_person):
    with pytest.raises(MotionError, match=r"positions\(3\)"):
        moving_person.positions(3)


def test_quaternions_of_any_length_are_normalised_and_unit_ones_are_not_touched(moving_person):
    once = moving_person.rotations
    factors = np.random.default_rng(0).uniform(0.1, 9, (60, 19, 1))
    again = replace(moving_person, rotations=once * factors).rotations
    np.testing.assert_allclose(again, once, atol=1e-14)
    assert (replace(moving_person, rotations=once).rotations == once).all()


def test_a_bad_quaternion_is_named(moving_person):
    rotations = moving_person.rotations.copy()
    for bad in (0.0, [0, 0, np.nan, 1], [1, 0, -np.inf, 0]):
        rotations[7, 2] = bad
        with pytest.raises(MotionError, match=r"(?=.*'Chest').*frame 7\b"):
            replace(moving_person, rotations=rotations)


def test_frames_are_cut_like_those_of_an_array(moving_person):
    positions = moving_person.positions()
    for frames in (np.s_[10:20], np.s_[-5:], np.s_[:7], np.s_[50:99], np.s_[::2], np.s_[3:20:4]):
        part = moving_person[frames]
        np.testing.assert_array_equal(part.positions(), positions[frames])
        start = range(60)[frames][0] / 30
        np.testing.assert_allclose(part.times, moving_person.times[frames] - start)
    assert len(moving_person) == 60 and len(moving_person[10:40]) == 30
    for frames, shown in ((np.s_[60:], "60:"), (np.s_[5:5], "5:5"), (np.s_[:-70], ":-70")):
        with pytest.raises(MotionError, match=rf"\[{shown}\].* 60"):
            moving_person[frames]
    for wrong, message in ((3, r"(?=.*frame 3\b).*\[10:11\]"), (np.s_[::-1], "-1")):
        with pytest.raises(MotionError, match=message):
            moving_person[wrong]


def test_euler_angles_are_those_of_scipy(moving_person):
    angles = moving_person.euler("XZY")
    assert angles.shape == (60, moving_person.skeleton.n_joints, 3)
    expected = Rotation.from_quat(moving_person.rotations[7]).as_euler("XZY", degrees=True)
    np.testing.assert_allclose(angles[7], expected)
    with pytest.raises(MotionError, match="(?=.*'XZ').*XYZ"):
        moving_person.euler("XZ")


def test_joints_by_name_and_what_to_take_in_place_of_an_array(moving_person):
    names = moving_person.joint_names
    assert names == moving_person.skeleton.names
    for joint in (names[0], names[-1]):
        expected = moving_person.positions()[:, names.index(joint)]
        np.testing.assert_array_equal(moving_person.positions(joint), expected)
    for value in (moving_person, [moving_person, moving_person]):
        with pytest.raises(MotionError, match=r"(?=.*motion\.positions\(\)).*motion\.rotations"):
            np.asarray(value)


def test_trim(moving_person):
    part = moving_person.trim(0.5, 1.25)
    np.testing.assert_array_equal(part.translation, moving_person.translation[15:38])
    assert moving_person.trim(1.0).n_frames == 30 and moving_person.trim(stop=0.1).n_frames == 3
    for start, stop in ((1.9, 2.1), (1.0, 1.0), (-0.5, 1.0), (1.5, 1.0), (float("nan"), None)):
        with pytest.raises(MotionError, match=rf"{start:g}\b"):
            moving_person.trim(start, stop)


def test_number_of_frames_is_exact(moving_person):
    # 49 frames at 30 fps are 24.5 at 15 fps: half a frame counts as one.
    assert moving_person[:49].resample(15).n_frames == 25
    assert moving_person[:47].resample(15).n_frames == 24


def test_a_pipe_is_refused_before_it_is_read(tmp_path):
    os.mkfifo(tmp_path / "a.bvh")
    with pytest.raises(FormatError, match=r"a\.bvh"):
        Motion.load(tmp_path / "a.bvh")
    with pytest.raises(FormatError, match=r"b\.bvh"):
        Motion.load(tmp_path / "b.bvh")


def test_options_that_a_format_does_not_have_are_refused_by_name(moving_person, tmp_path):
    with pytest.raises(FormatError, match=r"a\.bvh.*(?=.*'audio').*\.mp4"):
        moving_person.save(tmp_path / "a.bvh", audio="speech.wav")
    with pytest.raises(FormatError, match=r"a\.npz.*(?=.*'unti').*fps"):
        moving_person.save(tmp_path / "a.npz", unti="cm")
    assert not list(tmp_path.iterdir())
    moving_person.save(tmp_path / "a.npz", fps=15)
    with pytest.raises(FormatError, match=r"a\.npz.*'units'(?=.*nor has any other format).*up"):
        Motion.load(tmp_path / "a.npz", units="cm")
