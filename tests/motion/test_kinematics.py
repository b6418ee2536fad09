import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from gesturekit.motion.model_joints import ModelJoints
from gesturekit.motion.rotations import (
    matrix_from_quaternion,
    normalize_quaternions,
    quaternion_from_sixd,
    rotate_vectors,
)
from gesturekit.motion.skeleton import forward_kinematics, global_rotations
from gesturekit.motion.torch_kinematics import (
    ForwardKinematics,
    PointKinematics,
    rotation_vector_to_matrix,
    sixd_to_matrix,
)


def test_torch_agrees_with_numpy(moving_person):
    skeleton = moving_person.skeleton
    chain = ForwardKinematics(skeleton.parents, skeleton.offsets)
    turns = torch.from_numpy(matrix_from_quaternion(moving_person.rotations))
    places = chain(turns, torch.from_numpy(moving_person.translation))
    np.testing.assert_allclose(places.numpy(), moving_person.positions(), atol=1e-6)
    batched = chain(turns.reshape(3, 4, 5, -1, 3, 3), torch.zeros(3, 4, 5, 3, dtype=turns.dtype))
    about_root = moving_person.positions() - moving_person.translation[:, None]
    np.testing.assert_allclose(batched.reshape(places.shape).numpy(), about_root, atol=1e-6)


def test_torch_gradients_are_those_of_finite_differences(person):
    chain = ForwardKinematics(person.parents[:4], person.offsets[:4]).double()
    x = torch.randn(1, 4, 6, dtype=torch.float64, requires_grad=True)
    root = torch.randn(1, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x, root: chain(sixd_to_matrix(x), root), (x, root))


def test_sixd_to_matrix_is_the_rotation_and_never_nan():
    x = torch.randn(100, 6)
    expected = matrix_from_quaternion(quaternion_from_sixd(x.numpy()))
    np.testing.assert_allclose(sixd_to_matrix(x).numpy(), expected, atol=1e-5)
    bad = torch.zeros(3, 6)
    bad[1, 0], bad[2] = 1.0, torch.tensor([1.0, 2, 3, 2, 4, 6])
    bad.requires_grad_()
    out = sixd_to_matrix(bad)
    out.square().sum().backward()
    assert out.isfinite().all() and bad.grad.isfinite().all()


def test_matrices_of_rotation_vectors_are_those_of_scipy_and_never_nan():
    vectors = np.random.default_rng(0).normal(size=(2, 5, 4, 3))
    vectors[0, 0] *= 1e-8
    vectors[0, 1] = 0
    x = torch.from_numpy(vectors).requires_grad_()
    found = rotation_vector_to_matrix(x)
    expected = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
    np.testing.assert_allclose(found.detach().reshape(-1, 3, 3), expected, atol=1e-9)
    found.sum().backward()
    assert x.grad.isfinite().all()
    alone = torch.from_numpy(vectors[0, 2:]).requires_grad_()
    assert torch.autograd.gradcheck(rotation_vector_to_matrix, alone)
    assert rotation_vector_to_matrix(torch.ones(3)).dtype == torch.float32


@pytest.mark.parametrize("points", [None, np.array([[0.1, 0.2, 0.3], [0.0, 0.0, -0.4]])])
@pytest.mark.parametrize(
    "joints", [["LeftHand", "Head"], ["Hips", "Spine"], ["Chest", "Hips"], ["Hips", "Hips"]]
)
def test_torch_places_points_of_some_joints_as_numpy_does(moving_person, joints, points):
    """Neck and left forearm are not modelled; lengths are those of a body half as large."""
    skeleton = moving_person.skeleton
    fixed = normalize_quaternions(np.random.default_rng(2).normal(size=(skeleton.n_joints, 4)))
    moved = {"LeftForeArm": np.array([0.2, 0.1, 0.0])}
    names = tuple(name for name in skeleton.names if name not in ("Neck", "LeftForeArm"))
    model = ModelJoints(skeleton, names, fixed, moved, scale=2.0)
    pose = moving_person.rotations[:6].copy()
    for name in ("Neck", "LeftForeArm"):
        pose[:, skeleton.index(name)] = fixed[skeleton.index(name)]
    at = [skeleton.index(name) for name in joints]
    kinematics = PointKinematics(model, at, points)
    height = 0.5 + 0.1 * np.arange(6)
    root = np.stack([0 * height, 2 * height, 0 * height], axis=1)
    moved = {name: np.tile(place, (6, 1)) for name, place in moved.items()}
    expected = forward_kinematics(pose, root, skeleton, moved)[:, at]
    if points is not None:
        expected = expected + rotate_vectors(global_rotations(pose, skeleton)[:, at], points)
    turned = pose[:, [model.indices[k] for k in kinematics.turned]]
    matrices = torch.from_numpy(matrix_from_quaternion(turned)).float()
    found = kinematics(
        matrices.reshape(2, 3, -1, 3, 3), torch.from_numpy(height).float().reshape(2, 3)
    )
    np.testing.assert_allclose(found.reshape(6, 2, 3).numpy(), expected / 2, atol=1e-5)
