"""Meshes of the mannequin, where its parts go, and how a scene shows them."""

import numpy as np
import pytest
from rigs import at_rest
from scipy.spatial.transform import Rotation

from gesturekit.motion import Motion
from gesturekit.motion.body_model import Skin
from gesturekit.viewer.drawn_body import DrawnBody, simplified
from gesturekit.viewer.figure import Figure
from gesturekit.viewer.scene import Camera, Mannequin, Scene


def test_parts_move_with_their_points_between_frames_too(gesture):
    motion = gesture(0.5, 30.0)
    figure = Figure.of(motion)
    body = Mannequin(figure)
    times = (-1.0, 0.0, 0.25, 99.0)
    last = len(figure.points) - 1
    frames = (figure.points[0], figure.points[0], figure.points[7:9].mean(axis=0),
              figure.points[last])  # fmt: skip
    right, left = (motion.skeleton.index(f"{side}Arm") for side in ("Right", "Left"))
    for time, points in zip(times, frames):
        moves = body.transforms(time).astype(float)
        assert moves.shape == (len(figure.limbs) + 1, 3, 4)
        for limb, move in zip(figure.limbs, moves):
            start, end = points[list(limb.ends)]
            assert move[:, 3] == pytest.approx(start, abs=1e-5)
            assert move[:, :3] @ [0, limb.length, 0] == pytest.approx(end - start, abs=1e-5)
            # Wide along the shoulders, and as deep as round limbs are.
            wide, depth = move[:, 0], move[:, 2]
            assert np.linalg.norm(wide) == pytest.approx(limb.width, rel=1e-5)
            assert np.linalg.norm(depth) == pytest.approx(1, rel=1e-5)
            assert abs(wide @ (end - start)) < 1e-5 and abs(depth @ wide) < 1e-5
            assert np.linalg.det(move[:, :3]) > 0
            if limb.width > 1:
                across = points[left] - points[right]
                assert wide @ across > 0.9 * limb.width * np.linalg.norm(across)
        base, *ends = points[list(figure.head)]
        move, up, face = moves[-1], *(end - base for end in ends)
        assert move[:, 3] == pytest.approx(base, abs=1e-5)
        assert move[:, 1] * np.linalg.norm(up) == pytest.approx(up, abs=1e-5)
        assert move[:, 2] @ face > 0.9 * np.linalg.norm(face)
        assert move[:, :3].T @ move[:, :3] == pytest.approx(np.eye(3), abs=1e-5)
        assert np.linalg.det(move[:, :3]) == pytest.approx(1)


@pytest.fixture
def standing(gesture) -> Motion:
    """A person that stands still, and faces another way than +Z."""
    motion = gesture(0.2, 30.0)
    rotations = np.repeat(motion.rotations[:1], motion.n_frames, axis=0)
    turn = Rotation.from_euler("y", 2.0) * Rotation.from_quat(rotations[0, 0])
    rotations[:, 0] = turn.as_quat()
    path = np.tile([5.0, motion.translation[0, 1], -3.0], (motion.n_frames, 1))
    return Motion(motion.skeleton, rotations, path, 30.0)


def test_a_scene_shows_the_body_its_shadow_and_the_floor(standing):
    drawn = DrawnBody.of(standing)
    figure = drawn.figure
    image = np.zeros((240, 240, 3), np.uint8)
    scene, camera = Scene(drawn, 1.0), Camera(figure, 1.0)
    scene.draw(0.0, image)
    again = np.zeros_like(image)
    scene.draw(0.0, again)
    assert (image == again).all(), "no trace of one frame is in the next"
    axes = camera.at(0.0)
    focal = 120 / np.tan(np.radians(15))

    def pixel(point: np.ndarray) -> tuple[int, int]:
        right, up, back = axes[:3] @ (point - axes[3])
        return int(120 - focal * up / -back), int(120 + focal * right / -back)

    shade = image.astype(int).sum(axis=2)
    spread = np.ptp(image.astype(int), axis=2)
    for limb in figure.limbs:
        if max(limb.radii) > 0.02 * figure.height and limb.side:
            row, column = pixel(figure.points[0, list(limb.ends)].mean(axis=0))
            assert spread[row, column] > 30, "limbs have the colours of their sides"
    # The sun is before the body, to its left; each point's shadow falls behind, to its right.
    cos, sin = np.cos(figure.front), np.sin(figure.front)
    ahead, left = np.array([sin, 0, cos]), np.array([cos, 0, -sin])
    trunk = figure.points[0, 0]
    high = trunk[1] - figure.floor
    fallen = trunk - [0, high, 0] - high / 2.6 * (ahead + left)
    lit = trunk - [0, high, 0] + high / 2.6 * (ahead - left)
    assert shade[pixel(fallen)] < shade[pixel(lit)] - 60
    assert spread[pixel(fallen)] < 60, "grey, as the floor is"


def test_limbs_are_seen_where_the_camera_puts_them(skeleton):
    """The outermost coloured pixels are those of the outermost vertices of coloured limbs."""
    path = np.arange(20)[:, None] / 19 * [0.5, 0, 1.0]
    drawn = DrawnBody.of(at_rest(skeleton, 20, path + [0.0, 0.9, 0.0]))
    body, camera = Mannequin(drawn.figure), Camera(drawn.figure, 1.5)
    sides = [np.ptp(colour) > 50 for colour in body.mesh.colours]
    moves = body.transforms(0.5)[body.mesh.parts[:, 0]]
    places = np.einsum("vij,vj->vi", moves[..., :3], body.mesh.vertices) + moves[..., 3]
    axes = camera.at(0.5)
    right, up, back = axes[:3] @ (places[sides] - axes[3]).T
    focal = 100 / np.tan(np.radians(15))
    columns, rows = 150 + focal * right / -back, 100 - focal * up / -back
    image = np.zeros((200, 300, 3), np.uint8)
    Scene(drawn, 1.5).draw(0.5, image)
    found = np.argwhere(np.ptp(image.astype(int), axis=2) > 40)
    assert found.min(axis=0) == pytest.approx([rows.min(), columns.min()], abs=1.5)
    assert found.max(axis=0) == pytest.approx([rows.max() - 1, columns.max() - 1], abs=1.5)


def grid(n: int, joints: int = 1) -> Skin:
    """A flat square of n by n points, 1 m wide, of joints side by side."""
    x, z = (axis.ravel() / (n - 1) for axis in np.meshgrid(np.arange(n), np.arange(n)))
    vertices = np.stack([x, np.zeros(n * n), z], axis=1)
    a = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.stack([a, a + n, a + 1], 1), np.stack([a + 1, a + n, a + n + 1], 1)])
    owners = np.zeros((n * n, 4), np.uint8)
    owners[:, 0] = np.minimum(x * joints, joints - 1)
    weights = np.tile(np.array([255, 0, 0, 0], np.uint8), (n * n, 1))
    return Skin(
        vertices, faces.astype(np.uint32), owners, weights, np.zeros((joints, 3)),
        regions=np.zeros(n * n, np.uint8),
    )  # fmt: skip


def area(skin: Skin) -> float:
    a, b, c = np.moveaxis(skin.vertices[skin.faces], 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def test_simplified_meshes_have_no_more_vertices_than_asked_and_keep_their_shape():
    skin = grid(41, joints=3)
    assert simplified(skin, 41 * 41, 1.7) is skin
    for most in (1680, 400, 60):
        found = simplified(skin, most, 1.7)
        assert most / 3 < len(found.vertices) <= most
        assert found.faces.max() == len(found.vertices) - 1
        assert (np.diff(np.sort(found.faces, axis=1), axis=1) > 0).all(), "no face is a line"
        assert area(found) > 0.6
        # The third of each joint is its own; vertices are means of those that they stand for.
        assert len(np.unique(found.joints[:, 0])) == 3
        for joint in range(3):
            x = found.vertices[found.joints[:, 0] == joint, 0]
            assert joint / 3 - 0.02 <= x.min() and x.max() <= (joint + 1) / 3 + 0.02
    # A cell for each joint at last.
    assert len(simplified(skin, 3, 1.7).vertices) == 3
    middles = simplified(skin, 3, 1.7).vertices
    assert middles[:, 2] == pytest.approx(0.5) and len(simplified(skin, 1, 1.7).vertices) == 3
