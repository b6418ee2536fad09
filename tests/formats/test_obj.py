import numpy as np
import pytest

from gesturekit.errors import FormatError
from gesturekit.formats import write_obj
from gesturekit.formats.smpl import smpl_skeleton
from gesturekit.motion import Motion
from gesturekit.motion.body_model import BodyModel
from gesturekit.motion.rotations import quaternion_from_rotation_vector


@pytest.fixture
def body_file(tmp_path, capsule_body):
    np.savez(tmp_path / "BODY.npz", **capsule_body(24))
    return tmp_path / "BODY.npz"


def a_motion(n_joints):
    turns = np.random.default_rng(0).normal(0, 0.2, (5, n_joints, 3))
    rig = smpl_skeleton(n_joints)
    return Motion(rig, quaternion_from_rotation_vector(turns), np.tile([0, 0.9, 0], (5, 1)), 30.0)


def read(path):
    lines = [line.split() for line in path.read_text().splitlines()]
    skin = np.array([line[1:] for line in lines if line[0] == "v"], dtype=float)
    return skin, np.array([line[1:] for line in lines if line[0] == "f"], dtype=int)


@pytest.mark.parametrize("n_joints", [22, 24, 55])
def test_the_skin_of_a_frame(tmp_path, body_file, n_joints):
    motion = a_motion(n_joints)
    motion.save(tmp_path / "a.obj", body_model=body_file, frame=3)
    skin, faces = read(tmp_path / "a.obj")
    body = BodyModel.load(body_file)
    assert faces.min() == 1 and faces.max() == len(skin) == body.n_vertices
    assert 0.9 < np.ptp(skin, axis=0).max() < 2.0
    motion[:1].save(tmp_path / "b.obj", body_model=body_file)
    motion.save(tmp_path / "c.obj", body_model=body_file, frame=-5)
    assert (tmp_path / "b.obj").read_text() == (tmp_path / "c.obj").read_text()
    if n_joints == 24:
        np.testing.assert_allclose(skin, body.vertices(motion[3:4])[0], atol=1e-6)


def test_a_failed_obj_leaves_no_file(tmp_path, body_file):
    with pytest.raises(FormatError, match="--body-model"):
        a_motion(24).save(tmp_path / "a.obj")
    with pytest.raises(FormatError, match=r"(?=.*\b777\b).*\b5 frames"):
        write_obj(a_motion(24), tmp_path / "a.obj", body_model=body_file, frame=777)
    with pytest.raises(FormatError, match="absent.npz"):
        a_motion(24).save(tmp_path / "a.obj", body_model=tmp_path / "absent.npz")
    assert not list(tmp_path.glob("*.obj"))
