import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gesturekit.motion import rotations as r

RNG = np.random.default_rng(0)
Q = r.normalize_quaternions(RNG.normal(size=(200, 4)))
P = r.normalize_quaternions(RNG.normal(size=(200, 4)))
V = RNG.normal(size=(200, 3))


def same(a, b, atol=1e-7):
    np.testing.assert_allclose(r.rotation_angles(a, b), 0, atol=atol)


def test_quaternion_algebra_matches_scipy():
    q, p = Rotation.from_quat(Q), Rotation.from_quat(P)
    same(r.multiply_quaternions(Q, P), (q * p).as_quat())
    np.testing.assert_allclose(r.rotate_vectors(Q, V), q.apply(V), atol=1e-12)
    np.testing.assert_allclose(r.matrix_from_quaternion(Q), q.as_matrix(), atol=1e-12)
    same(r.quaternion_from_matrix(q.as_matrix()), Q)
    np.testing.assert_allclose(r.rotation_vector_from_quaternion(Q), q.as_rotvec(), atol=1e-9)
    same(r.quaternion_from_rotation_vector(q.as_rotvec()), Q)
    np.testing.assert_allclose(r.rotation_angles(Q, P), (q.inv() * p).magnitude(), atol=1e-9)


@pytest.mark.parametrize("order", ["".join(o) for o in itertools.permutations("XYZ")])
def test_euler_angles_are_intrinsic_and_survive_gimbal_lock(order):
    angles = RNG.uniform(-180, 180, (100, 3))
    same(r.quaternion_from_euler(angles, order), Rotation.from_euler(order, angles, True).as_quat())
    angles[:50, 1] = np.repeat([90.0, -90.0], 25)
    q = r.quaternion_from_euler(angles, order)
    same(r.quaternion_from_euler(r.euler_from_quaternion(q, order), order), q, atol=1e-6)


def test_sixd_is_the_first_two_columns():
    matrix = Rotation.from_quat(Q).as_matrix()
    expected = np.concatenate([matrix[:, :, 0], matrix[:, :, 1]], axis=1)
    np.testing.assert_allclose(r.sixd_from_quaternion(Q), expected, atol=1e-12)
    same(r.quaternion_from_sixd(expected), Q)


def test_any_six_numbers_give_a_rotation():
    x = RNG.normal(size=(200, 6)) * 10.0 ** RNG.uniform(-3, 3, (200, 1))
    x[0], x[1], x[2, :3] = 0, [1, 2, 3, 2, 4, 6], 0  # no axis, one, and the second alone
    x[3], x[4], x[5] = [0, 0, 1e-12, 0, 1, 0], [1, 0, 0, -1, 0, 0], [1, 0, 0, 1, 1e-12, 0]
    matrix = r.matrix_from_quaternion(r.quaternion_from_sixd(x))
    squares = matrix @ matrix.swapaxes(1, 2)
    np.testing.assert_allclose(squares, np.tile(np.eye(3), (200, 1, 1)), atol=1e-6)
    assert (np.linalg.det(matrix) > 0.99).all()


def test_slerp_takes_the_shorter_arc_at_an_even_pace():
    angle = r.rotation_angles(Q, P)
    for weight in (0.0, 0.3, 1.0):
        for end in (P, -P):
            between = r.slerp(Q, end, weight)
            np.testing.assert_allclose(r.rotation_angles(Q, between), weight * angle, atol=1e-7)
    same(r.slerp(Q, Q, 0.5), Q)
    # Rotations by less than a millionth of a radian, here about x: the angle is twice q's x.
    near = np.array([4e-8, 0.0, 0.0, 1.0])
    np.testing.assert_allclose(r.slerp(r.IDENTITY, near, 0.25), [1e-8, 0, 0, 1], rtol=1e-6)


def test_mean_ignores_signs():
    turns = r.quaternion_from_rotation_vector(0.1 * np.concatenate([V, -V]))
    near = r.multiply_quaternions(Q[0], turns)
    near[::3] *= -1
    assert r.rotation_angles(r.mean_quaternion(near), Q[0]) < 1e-6
