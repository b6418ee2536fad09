"""Loss on the sliding of feet, against the motion core and numbers worked out by hand."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from gesturekit.diffusion import DeltaRepresentation
from gesturekit.diffusion.losses import foot_sliding, foot_velocity
from gesturekit.diffusion.motion_vector import VectorPlaces
from gesturekit.motion.contacts import foot_positions
from gesturekit.motion.torch_kinematics import foot_kinematics


@pytest.fixture(scope="module")
def walker(gesture):
    """A gesture that also walks a circle: 0.5 m/s, half a turn in 4 s."""
    motion = gesture(4.0, fps=25.0)
    turn = np.pi / 4 * motion.times
    motion.translation[:, 0] += 0.5 * np.sin(turn)
    motion.translation[:, 2] += 0.5 * (1 - np.cos(turn))
    about = Rotation.from_euler("y", turn[:, None])
    motion.rotations[:, 0] = (about * Rotation.from_quat(motion.rotations[:, 0])).as_quat()
    return motion


def test_foot_velocity_matches_that_of_motion(walker):
    representation = DeltaRepresentation.fit([walker])
    places = VectorPlaces(representation, foot_kinematics(representation))
    values = torch.from_numpy(representation.encode(walker)).float()
    made = foot_velocity(places, values[None], walker.fps)[0].numpy() * representation.scale
    real = np.diff(foot_positions(walker), axis=0) * walker.fps
    speeds, real_speeds = (np.linalg.norm(velocity, axis=-1) for velocity in (made, real))
    np.testing.assert_allclose(speeds, real_speeds, atol=2e-4)
    np.testing.assert_allclose(made[..., 1], real[..., 1], atol=2e-4)
    assert real_speeds.min() > 0.1  # they slide all the time


def test_feet_that_stand_must_not_slide():
    recorded = torch.zeros(3, 1, 2, 3)
    # The second of two feet steps: it may be as fast as it likes.
    recorded[:, 0, 1, 2] = 1.0
    predicted = torch.full_like(recorded, 5.0)
    # The first one slides by 1 cm/s; by 0.8 and 1.5 m/s in two directions, 1.7 m/s; not at all.
    predicted[0, 0, 0] = torch.tensor([0.0, 0.01, 0.0])
    predicted[1, 0, 0] = torch.tensor([0.8, 0.0, 1.5])
    predicted[2, 0, 0] = 0.0
    # s = 0.1: s^2 / 2 = 0.005; s = 17: sqrt(290) - 1 = 16.03.
    expected = pytest.approx([0.005, 16.03, 0.0], rel=5e-3)
    assert foot_sliding(predicted, recorded).tolist() == expected
