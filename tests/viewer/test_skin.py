"""The skin that a page holds, put together as player/skin.js does."""

import base64
from dataclasses import replace

import numpy as np
import pytest
from pages import bundled, data_of, unpacked
from scipy.spatial.transform import Rotation

from gesturekit.formats.smpl import fit_body, smpl_skeleton
from gesturekit.motion import Motion
from gesturekit.motion.body_model import BodyModel, Skin
from gesturekit.motion.skeleton import BodyShape

pytestmark = bundled


@pytest.fixture
def body(tmp_path, capsule_body) -> BodyModel:
    np.savez(tmp_path / "BODY.npz", **capsule_body(24))
    return BodyModel.load(tmp_path / "BODY.npz")


def turning(n_joints: int = 24, n_frames: int = 60) -> Motion:
    """All joints swing, and the body turns round twice."""
    rng = np.random.default_rng(0)
    time = np.arange(n_frames)[:, None, None] / 30
    swing = 0.5 * np.sin(3 * time + rng.uniform(0, 6, (n_joints, 3)))
    swing[:, 0] = np.linspace(0, 4 * np.pi, n_frames)[:, None] * [0, 1, 0]
    rotations = Rotation.from_rotvec(swing.reshape(-1, 3)).as_quat().reshape(n_frames, -1, 4)
    path = np.array([0.0, 0.9, 0.0]) + 0.5 * time[:, 0] * [1, 0, 1]
    rig = replace(smpl_skeleton(n_joints), body_shape=BodyShape((1.0, -0.5)))
    return Motion(rig, rotations, path, 30.0)


def array(text: str, dtype: str, width: int) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), dtype).reshape(-1, width)


@pytest.mark.parametrize("n_joints", [22, 24, 55])
def test_the_skin_moves_as_the_body_model_says(tmp_path, body, n_joints):
    motion = turning(n_joints)
    if n_joints == 55:
        motion = replace(motion, info={})
    motion.save(tmp_path / "a.html", body_model=body)
    page = data_of(tmp_path / "a.html")
    figure, shared = page["figures"][0], page["skin"]
    frames, count = figure["n_frames"], figure["n_joints"]
    root = array(figure["root"], "<f4", 3)[:, None]
    steps = unpacked(figure["points"], frames).view(np.int16).reshape(frames, -1, 3)
    places = (root + steps * figure["step"])[:, :count]
    turns = (
        unpacked(figure["skin"]["turns"], frames).view(np.int16).reshape(frames, count, 4) / 32767.0
    )
    # So near to one another that a frame in between can be read off a straight line.
    assert np.linalg.norm(np.diff(turns, axis=0), axis=-1).max() < 0.5
    turns = Rotation.from_quat(turns.reshape(-1, 4)).as_matrix().reshape(frames, count, 3, 3)
    rest = array(figure["skin"]["vertices"], "<f4", 3)
    centres = array(figure["skin"]["joints"], "<f4", 3)
    joints, weights = array(shared["joints"], "u1", 4), array(shared["weights"], "u1", 4)
    np.testing.assert_array_equal(array(shared["faces"], "<u4", 3), body.faces)
    moved = np.zeros((frames, len(rest), 3))
    for k in range(4):
        j = joints[:, k]
        from_joint = rest - centres[j]
        moved += (weights[:, k] / 255)[:, None] * (
            np.einsum("tvab,vb->tva", turns[:, j], from_joint) + places[:, j]
        )
    uncorrected = replace(body, pose_corrections=None)
    expected = uncorrected.vertices(fit_body(motion, body))
    assert np.abs(moved - expected).max() < 1e-3  # metres; weights are in parts of 255


def share(skin: Skin, joint: int) -> np.ndarray:
    """Return how much of each vertex a joint holds."""
    return (skin.weights * (skin.joints == joint)).sum(axis=1) / skin.weights.sum(axis=1)


def test_a_vertex_keeps_its_four_greatest_weights(body):
    weights = np.zeros_like(body.weights)
    weights[:, [2, 3, 5, 7, 8]] = [0.05, 0.3, 0.15, 0.4, 0.1]
    skin = Skin.of(replace(body, weights=weights))
    for joint, weight in {7: 0.4, 3: 0.3, 5: 0.15, 8: 0.1}.items():
        np.testing.assert_allclose(share(skin, joint), weight / 0.95, atol=0.005)
    # Rigs of fewer than four joints.
    two = replace(body, weights=weights[:, [3, 7]], regressor=body.regressor[:2], parents=(-1, 0))
    skin = Skin.of(two)
    np.testing.assert_allclose(share(skin, 1), 0.4 / 0.7, atol=0.005)
    assert skin.rest.shape == (2, 3)
