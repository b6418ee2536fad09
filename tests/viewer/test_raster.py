"""Kernels of the rasteriser, against numpy and scipy, and numbers worked out by hand."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gesturekit.viewer import raster
from gesturekit.viewer.scene import Camera


def f32(*values) -> np.ndarray:
    return np.array(values, np.float32)


@pytest.fixture
def samples() -> tuple[np.ndarray, np.ndarray]:
    """Depths and colours of the 40 by 60 samples of a picture of 20 by 30 pixels."""
    return np.zeros((40, 60), np.float32), np.empty((40, 60, 3), np.float32)


@pytest.fixture
def view() -> tuple[np.ndarray, float]:
    """A camera that is turned, and its pixels for a slope of 1."""
    axes = Rotation.from_euler("yxz", [0.7, -0.4, 0.1]).as_matrix().T
    # Half of a field of 30 degrees is seen at 20 pixels from the middle.
    focal = Camera.focal(40.0)
    assert focal == pytest.approx(74.641, abs=1e-3)
    return np.concatenate([axes, [[1.0, 2.0, 3.0]]]), focal


def test_vertices_and_normals_are_skinned():
    rng = np.random.default_rng(0)
    matrices = rng.normal(size=(3, 3, 4)).astype(np.float32)
    vertices, normals = rng.normal(size=(2, 50, 3)).astype(np.float32)
    parts = rng.integers(0, 3, (50, 4)).astype(np.int32)
    weights = rng.dirichlet([1, 1, 1, 1], 50).astype(np.float32)
    weights[::2, 2:] = 0
    out, out_normals = np.empty_like(vertices), np.empty_like(vertices)
    raster.place(vertices, normals, parts, weights, matrices, out, out_normals)
    moved = np.einsum("nij,vj->vni", matrices[..., :3], vertices) + matrices[..., 3]
    expected = np.einsum("vk,vki->vi", weights, moved[np.arange(50)[:, None], parts])
    assert out == pytest.approx(expected, abs=1e-5)
    # Normals stay across surfaces under any linear map: the inverse transposed, by its determinant.
    turns = [np.linalg.det(m) * np.linalg.inv(m).T for m in matrices[..., :3].astype(float)]
    moved = np.einsum("nij,vj->vni", turns, normals)
    expected = np.einsum("vk,vki->vi", weights, moved[np.arange(50)[:, None], parts])
    assert out_normals == pytest.approx(expected, abs=1e-4)


def test_places_are_projected_through_a_hole(view):
    camera, focal = view
    rng = np.random.default_rng(0)
    seen = rng.uniform([-1, -1, -9], [1, 1, -2], (20, 3))  # right, up, and away from the camera
    vertices = (seen @ camera[:3] + camera[3]).astype(np.float32)
    out = np.empty_like(vertices)
    raster.project(vertices, camera, focal, 60, 40, out)
    expected = np.stack(
        [30 + focal * seen[:, 0] / -seen[:, 2], 20 - focal * seen[:, 1] / -seen[:, 2],
         1 / -seen[:, 2]], axis=1
    )  # fmt: skip
    assert out == pytest.approx(expected, rel=1e-4)
    # Nothing is drawn of what is behind the camera, or all but in it.
    level = np.concatenate([np.eye(3), np.zeros((1, 3))])
    near = f32((0, 0, 1), (0, 0, -1e-5), (0, 0, -1e-2))
    raster.project(near, level, 75.0, 60, 40, out := np.empty_like(near))
    assert (out[:, 2] > 0).tolist() == [False, False, True]
    assert out[:, :2] == pytest.approx(np.tile([30.0, 20.0], (3, 1)))


def test_faces_are_filled_where_sample_centres_are_inside(samples):
    rng = np.random.default_rng(3)
    corners = rng.uniform([-8, -8, 0.2], [68, 48, 1.0], (36, 3)).astype(np.float32)
    corners[-1, 2] = 0.0  # behind the camera
    colours = rng.uniform(0, 255, corners.shape).astype(np.float32)
    faces = np.arange(36).reshape(12, 3).astype(np.int32)
    raster_box = raster.fill(corners, colours, faces, *samples)
    rows, columns = np.mgrid[:40, :60] + 0.5
    depths, image = np.zeros((40, 60)), np.zeros((40, 60, 3))
    drawn = 0
    for face in faces[:-1]:
        sides = np.concatenate([corners[face, :2].astype(float).T, np.ones((1, 3))])
        if np.linalg.det(sides) > 0:  # seen from its back
            continue
        drawn += 1
        shares = np.moveaxis(
            np.tensordot(np.linalg.inv(sides), [columns, rows, np.ones_like(rows)], 1), 0, -1
        )
        depth = shares @ corners[face, 2]
        wins = (shares >= 0).all(axis=-1) & (depth > depths)
        depths[wins] = depth[wins]
        image[wins] = (shares @ colours[face])[wins]
    assert 3 <= drawn <= 9
    assert samples[0] == pytest.approx(depths, abs=1e-4)
    covered = depths > 0
    assert 0.2 < covered.mean() < 0.99
    assert samples[1][covered] == pytest.approx(image[covered], abs=0.1)
    filled = [np.flatnonzero(covered.any(axis=axis)) for axis in (1, 0)]
    assert raster_box[0] <= filled[0][0] and raster_box[1] >= filled[0][-1] + 1
    assert raster_box[2] <= filled[1][0] and raster_box[3] >= filled[1][-1] + 1


@pytest.mark.parametrize("first", [0, 1, 2])
def test_faces_side_by_side_leave_no_gap_and_none_behind_the_camera_is_drawn(samples, first):
    """The diagonal of a square goes through the centres of samples, by each corner in turn."""
    corners = f32((8, 8, 1), (8, 16, 1), (16, 16, 1), (16, 8, 1))
    faces = np.array([np.roll([0, 1, 2], first), np.roll([0, 2, 3], first)], np.int32)
    colours = np.zeros((4, 3), np.float32)
    box = raster.fill(corners, colours, faces, *samples)
    assert box.tolist() == [8, 16, 8, 16] and samples[0][8:16, 8:16].all()
    assert np.count_nonzero(samples[0]) == 64
    corners[first, 2] = 0
    samples[0][:] = 0
    box = raster.fill(corners, colours, faces[:1], *samples)
    assert box[1] == 0 and not samples[0].any()
