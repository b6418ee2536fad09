"""Losses read the same body as the motion core, at any level's rate."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from gesturekit.errors import ConfigError
from gesturekit.evaluation import arm_speed
from gesturekit.motion.contacts import foot_positions
from gesturekit.multires import MultiresRepresentation, VectorKinematics
from gesturekit.multires.kinematics import smooth


@pytest.fixture(scope="module")
def walker(gesture):
    """A gesture that also drifts 0.5 m/s along x: its feet slide."""
    motion = gesture(4.0, fps=25.0)
    motion.translation[:, 0] += 0.5 * motion.times
    return motion


@pytest.fixture(scope="module")
def representation(walker):
    return MultiresRepresentation.fit([walker])


@pytest.fixture(scope="module")
def values(representation, walker):
    return torch.from_numpy(representation.encode(walker).T).float()[None]


@pytest.fixture(scope="module")
def kinematics(representation, walker):
    return VectorKinematics(representation, walker.fps)


def test_feet_and_joints_have_the_positions_of_motion(representation, kinematics, walker, values):
    joints = kinematics.places(values).permute(0, 3, 1, 2)
    index = [walker.skeleton.index(name) for name in representation.joints]
    root = walker.translation[:, None] * [1, 0, 1]
    scale = representation.scale
    np.testing.assert_allclose(joints[0] * scale, walker.positions()[:, index] - root, atol=1e-5)
    # Feet move along with the root too, half as far between frames' middles as over both.
    feet = np.diff(foot_positions(walker), axis=0) * walker.fps / scale
    velocity = kinematics.foot_velocity(values, 1.0)[0]
    np.testing.assert_allclose(velocity[5:], feet[5:], atol=2e-2)


def test_arm_speed_is_that_of_the_evaluation(kinematics, walker, values):
    ours = kinematics.arm_speed(values, stride=1.0)[0].numpy()
    # A swing at 0.7 Hz loses a tenth under the Gaussian; nothing else may differ.
    ratio = ours[10:-10].mean() / arm_speed(walker)[10:-10].mean()
    assert 0.85 < ratio < 1.0
    assert np.corrcoef(ours[10:-10], arm_speed(walker)[10:-10])[0, 1] > 0.95


def turning(representation, walker, angles: np.ndarray) -> torch.Tensor:
    """Vectors (1, D, T) of a pose in which only the left arm turns, about one axis."""
    pose = walker[:1]
    rotations = np.repeat(pose.rotations, len(angles), axis=0)
    arm = walker.skeleton.index("LeftForeArm")
    turn = Rotation.from_rotvec(angles[:, None] * np.array([0.6, 0.0, 0.8]))
    rotations[:, arm] = (turn * Rotation.from_quat(rotations[:, arm])).as_quat()
    places = np.repeat(pose.translation, len(angles), axis=0)
    moving = replace(pose, rotations=rotations, translation=places)
    return torch.from_numpy(representation.encode(moving).T).double()[None]


@pytest.mark.parametrize("stride", [1.0, 2.5])
def test_speed_and_acceleration_of_a_single_turning_joint(
    kinematics, representation, walker, stride
):
    """The chord of an angle a is 2 sin(a / 2); of three frames in a row, 2 (1 - cos a)."""
    steady = turning(representation, walker, 0.1 * np.arange(8))
    speed = kinematics.arm_speed(steady, stride, smoothing=0.0)[0]
    np.testing.assert_allclose(speed, 2 * np.sin(0.05) * 25 / stride, rtol=2e-3)
    acceleration = kinematics.arm_acceleration(steady, stride)[0]
    np.testing.assert_allclose(acceleration, 2 * (1 - np.cos(0.1)) * (25 / stride) ** 2, rtol=0.02)
    # Steps of 0, 0.2, 0 and 0.4: the first frame is as fast as the second.
    steps = turning(representation, walker, np.cumsum([0, 0, 0.2, 0, 0.4]))
    speed = kinematics.arm_speed(steps, stride, smoothing=0.0)[0] * stride / 25
    chords = 2 * np.sin(np.array([0, 0, 0.1, 0, 0.2]))
    np.testing.assert_allclose(speed, chords, atol=1e-4)
    bend = kinematics.arm_acceleration(steps, stride)[0] * (stride / 25) ** 2
    # A step beside a rest is a chord too; the ends are as their neighbours.
    np.testing.assert_allclose(bend, chords[[2, 2, 2, 4, 4]], atol=1e-4)


def test_smoothing_is_a_gaussian_that_ends_at_three_deviations():
    x = np.random.default_rng(0).standard_normal((3, 30))
    expected = gaussian_filter1d(x, 2.0, truncate=3.0, mode="mirror")
    np.testing.assert_allclose(smooth(torch.from_numpy(x), 2.0), expected)
    torch.testing.assert_close(smooth(torch.from_numpy(x), 0.3), torch.from_numpy(x))
    one = gaussian_filter1d(x, 0.4, radius=1, mode="mirror")
    np.testing.assert_allclose(smooth(torch.from_numpy(x), 0.4), one)


@pytest.mark.parametrize("stride", [1.0, 4.0])
def test_the_body_moves_its_feet_and_joints_along(kinematics, representation, values, stride):
    """The root moves 0.02 and -0.01 m a full-rate frame at 25 fps, and ever faster along z."""
    still = values[:, :, :1].repeat(1, 1, 12).double()
    still[:, representation.layout.root_xz] = torch.tensor([0.02, -0.01]).double()[:, None]
    for time, factor in (("second", 25.0), ("frame", 1.0)):
        velocity = kinematics.foot_velocity(still, stride, time)
        assert velocity.shape == (1, 11, len(representation.foot_points), 3)
        expected = factor * torch.tensor([0.02, 0.0, -0.01]).double().expand_as(velocity)
        torch.testing.assert_close(velocity, expected, atol=1e-6, rtol=0)
    still[:, representation.layout.root_xz[1]] += 0.003 * torch.arange(12)
    still[:, representation.layout.root_height] = 0.01 * torch.arange(12) ** 2
    bend = kinematics.bend(still, kinematics.places(still), stride)
    expected = torch.tensor([0.0, 0.02 / stride**2, 0.003 / stride]).double()
    torch.testing.assert_close(bend, expected[:, None].expand_as(bend), atol=1e-6, rtol=0)
    labels = still[0, representation.layout.contacts].T[1:]
    torch.testing.assert_close(kinematics.contact_labels(still)[0], labels)


def test_arms_that_are_not_modelled_are_named(walker):
    names = [name for name in walker.skeleton.names if name != "RightForeArm"]
    representation = MultiresRepresentation.fit([walker], names)
    with pytest.raises(ConfigError, match="RightForeArm"):
        VectorKinematics(representation, 25.0)
    assert VectorKinematics(representation, 25.0, arms=False).arms == []
