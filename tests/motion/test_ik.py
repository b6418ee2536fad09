import numpy as np
import pytest
from rigs import at_rest

from gesturekit.motion import Skeleton
from gesturekit.motion.ik import two_bone_ik
from gesturekit.motion.rotations import (
    normalize_quaternions,
    quaternion_from_rotation_vector,
    rotation_angles,
)
from gesturekit.motion.skeleton import forward_kinematics, global_rotations

# A leg on a pelvis, with a helper joint between hip and knee.
LEG = Skeleton(
    ("pelvis", "hip", "twist", "knee", "ankle"),
    (-1, 0, 1, 2, 3),
    np.array([[0, 1.0, 0], [0.1, 0, 0], [0, -0.2, 0.01], [0.01, -0.2, 0], [0, -0.42, 0]]),
)
CHAIN = [1, 3, 4]


def solve(rotations: np.ndarray, target: np.ndarray, **options) -> tuple[np.ndarray, np.ndarray]:
    """Positions and local rotations of the leg after its ankle was sent to a target."""
    at = np.zeros((len(rotations), 3))
    positions = forward_kinematics(rotations, at, LEG)
    above = global_rotations(rotations, LEG)[:, [0, 2]]
    solved = rotations.copy()
    solved[:, [1, 3]] = two_bone_ik(
        positions[:, CHAIN], target, rotations[:, [1, 3]], above, **options
    )
    return forward_kinematics(solved, at, LEG), solved


def bent(n: int, seed: int = 0) -> np.ndarray:
    """(n, 5, 4) random poses with a well bent knee."""
    rng = np.random.default_rng(seed)
    rotations = normalize_quaternions(rng.normal(size=(n, 5, 4)))
    rotations[:, 2] = [0, 0, 0, 1]
    knee = np.stack([rng.uniform(0.5, 2.0, n), np.zeros(n), np.zeros(n)], axis=-1)
    rotations[:, 3] = quaternion_from_rotation_vector(knee)
    rotations[:, 4] = [0, 0, 0, 1]
    return rotations


def straight(n: int) -> np.ndarray:
    return at_rest(LEG, n).rotations


def test_the_ankle_reaches_its_target_and_bones_keep_their_lengths():
    rotations = bent(200)
    start = forward_kinematics(rotations, np.zeros((200, 3)), LEG)
    rng = np.random.default_rng(1)
    way = rng.normal(size=(200, 3))
    way *= rng.uniform(0.15, 0.78, (200, 1)) / np.linalg.norm(way, axis=1, keepdims=True)
    target = start[:, 1] + way
    positions, solved = solve(rotations, target)
    np.testing.assert_allclose(positions[:, 4], target, atol=1e-9)
    for a, b in ((1, 3), (3, 4)):
        before, after = (np.linalg.norm(p[:, a] - p[:, b], axis=1) for p in (start, positions))
        np.testing.assert_allclose(after, before, atol=1e-9)
    np.testing.assert_array_equal(solved[:, [0, 2, 4]], rotations[:, [0, 2, 4]])


@pytest.mark.parametrize("pole", [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0)])
def test_a_straight_leg_bends_along_the_pole(pole):
    lift = np.linspace(0, 0.3, 40)
    target = [0.11, -0.82, 0.01] + lift[:, None] * [0.0, 1.0, 0.0]
    positions, _ = solve(straight(40), target, pole=np.tile(pole, (40, 1)))
    middle = (positions[:, 1] + positions[:, 4]) / 2
    out = (positions[:, 3] - middle) @ np.array(pole)
    assert out[-1] > 0.2 and (np.diff(out) > -1e-9).all()


def test_no_pop_at_full_extension():
    """The target goes steadily from near to out of reach; the knee straightens ever more slowly."""
    n = 400
    reach = np.linspace(0.6, 1.1, n)
    target = np.stack([np.full(n, 0.1), -reach, np.zeros(n)], axis=-1)
    pose = straight(n)
    pose[:, 3] = quaternion_from_rotation_vector(np.array([1.2, 0.0, 0.0]))
    positions, solved = solve(pose, target)
    got = np.linalg.norm(positions[:, 4] - positions[:, 1], axis=1)
    length = sum(np.linalg.norm(positions[0, a] - positions[0, b]) for a, b in ((1, 3), (3, 4)))
    assert got.max() < length
    assert np.abs(np.diff(got)).max() <= np.diff(reach)[0] + 1e-9
    hard = np.minimum(reach, length)
    steps = rotation_angles(solved[1:, 3], solved[:-1, 3])
    # A hard stop turns the knee by arccos of nearly 1, ever faster, and then not at all.
    knee = np.arccos(np.clip((hard**2 - 2 * (length / 2) ** 2) / (2 * (length / 2) ** 2), -1, 1))
    assert steps.max() < 0.6 * np.abs(np.diff(knee)).max()
