"""Motions one after another: placed, and without a jump in pose or speed."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import gesturekit as gk
from gesturekit.errors import MotionError
from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.face import smplx_face


@pytest.fixture
def other(moving_person) -> Motion:
    """The same person in other poses at another place."""
    later = np.roll(moving_person.rotations, 23, axis=0)
    return replace(moving_person, rotations=later, translation=moving_person.translation + 0.3)


def test_pose_and_speed_go_on_and_later_frames_keep_their_pose(moving_person, other):
    made = gk.concatenate([moving_person, other], blend=0.3)
    assert (made.n_frames, made.fps) == (120, 30.0)
    np.testing.assert_array_equal(made.positions()[:60], moving_person.positions())
    changes = np.abs(np.diff(made.positions(), 2, axis=0)).max(axis=(1, 2))
    hard = gk.concatenate([moving_person, other], blend=0)
    jump = np.abs(np.diff(hard.positions(), 2, axis=0)).max()
    # The step to the first frame of the second motion is the last one before it, up to curvature.
    assert changes[58] < 1.5 * changes[:57].max() and changes[58] < 0.05 * jump
    assert changes.max() < 0.2 * jump
    np.testing.assert_allclose(made.rotations[69:, 1:], other.rotations[9:, 1:], atol=1e-12)
    assert np.abs(made.rotations[63, 1:] - other.rotations[3, 1:]).max() > 1e-3


def test_the_difference_decays_alike_in_all_that_moves():
    """Within 9 frames, in the height of the root, a joint's place, and a joint's angle.

    The first motion ends with a rise by 0.03 to 0.06 and would reach 0.09; the second one begins
    at 0.5, so that the difference is -0.41.
    """
    rig = Skeleton(("root", "arm", "hand"), (-1, 0, 1), [[0, 0, 0], [0, 1, 0], [0, 1, 0]])

    def along(values: np.ndarray) -> Motion:
        angles = np.zeros((len(values), 3, 3))
        angles[:, 1, 2] = values
        turns = Rotation.from_rotvec(angles.reshape(-1, 3)).as_quat().reshape(-1, 3, 4)
        place = values[:, None] * [0, 1, 0]
        return Motion(rig, turns, place, 30.0, {"hand": place + [0.2, 0, 0]})

    before, after = np.array([-0.2, 0.03, 0.06]), 0.5 + 0.01 * np.arange(20.0)
    made = gk.concatenate([along(before), along(after)], blend=0.3)[3:]
    height = made.translation[:, 1]
    left = height - after
    assert left[0] == pytest.approx(-0.41) and (np.diff(left[:10]) > 0).all()
    np.testing.assert_allclose(left[9:], 0, atol=1e-9)
    place = np.outer(height, [0, 1, 0]) + [0.2, 0, 0]
    np.testing.assert_allclose(made.joint_translations["hand"], place, atol=1e-9)
    turned = Rotation.from_quat(made.rotations[:, 1]).as_rotvec()
    np.testing.assert_allclose(turned, np.outer(height, [0, 0, 1]), atol=1e-9)


def test_short_motions_other_rates_and_faces(moving_person, other):
    face = np.ones((60, 10))
    parts = [replace(moving_person, face=smplx_face(face)), other[:1], other.resample(60.0)]
    made = gk.concatenate(parts)
    assert made.n_frames == 60 + 1 + 60 and made.fps == 30.0 and made.face is None
    assert np.isfinite(made.positions()).all()
    assert gk.concatenate(parts[:1] * 2).face.values.shape == (120, 10)
    assert gk.concatenate([other[:1], other[:1]]).n_frames == 2


def test_what_cannot_be_concatenated_is_one_error(moving_person):
    with pytest.raises(MotionError, match=r"(?=.*motion 2\b)(?=.*'RightToeBase').*--rig"):
        gk.concatenate([moving_person, moving_person.keep(moving_person.skeleton.names[:-1])])
    with pytest.raises(MotionError, match=r"(?=.*motion 3\b)(?=.*'LeftLeg').*\b0\.\d+ m"):
        gk.concatenate([moving_person, moving_person, moving_person.scaled(1.2)])
    with pytest.raises(MotionError, match="motions"):
        gk.concatenate([])
    with pytest.raises(MotionError, match=r"concatenate\(\[a, b\]\)"):
        gk.concatenate(moving_person, moving_person)
    with pytest.raises(MotionError, match="(?=.*blend).*-1"):
        gk.concatenate([moving_person], blend=-1)
