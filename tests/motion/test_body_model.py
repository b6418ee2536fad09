import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csc_array, csr_array
from scipy.spatial.transform import Rotation

from gesturekit.errors import FormatError, MotionError
from gesturekit.formats.smpl import fit_body, mean_body, smpl_skeleton
from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.body_model import BodyModel
from gesturekit.motion.rotations import quaternion_from_rotation_vector
from gesturekit.motion.skeleton import BodyShape

SPARSE = ("data", "indices", "indptr")
NOT_SPARSE = dict.fromkeys((f"J_regressor_{key}" for key in SPARSE), np.ones(2))
NOT_SPARSE |= {"J_regressor": None, "J_regressor_indptr": np.array(1)}


@pytest.fixture(scope="module")
def saved(capsule_body, tmp_path_factory):
    """saved(24, key=other) -> the model's file, with arrays exchanged or (None) left out."""

    def make(n_joints=24, **change):
        path = tmp_path_factory.mktemp("body") / "BODY.npz"
        values = capsule_body(n_joints) | change
        np.savez(path, **{key: value for key, value in values.items() if value is not None})
        return path

    return make


@pytest.fixture(scope="module")
def body(saved, capsule_body):
    return BodyModel.load(saved(), feet=capsule_body(24)["feet"])


def a_motion(n_joints=24, n_frames=20, betas=()):
    rng = np.random.default_rng(3)
    turns = np.cumsum(rng.normal(0, 0.08, (n_frames, n_joints, 3)), axis=0)
    return Motion(
        replace(smpl_skeleton(n_joints), body_shape=BodyShape(tuple(betas))),
        quaternion_from_rotation_vector(turns),
        np.array([0.2, 0.9, 0.1]) + np.cumsum(rng.normal(0, 0.01, (n_frames, 3)), axis=0),
        30.0,
    )


def test_joints_at_rest_follow_the_shape(body):
    mean = body.joints_at_rest()
    # Pelvis, then the offsets of the rig it was built around.
    np.testing.assert_allclose(mean[1] - mean[0], [0.06, -0.09, -0.005], atol=1e-6)
    larger = body.joints_at_rest([2.0])
    np.testing.assert_allclose(larger - larger[0], 1.1 * (mean - mean[0]), atol=1e-5)
    many = np.zeros(300)
    many[0] = 2.0
    np.testing.assert_allclose(body.joints_at_rest(many), larger, atol=1e-12)


@pytest.mark.parametrize("n_joints", [24, 55])
def test_skin_and_joints_are_those_of_the_package_smplx(saved, capsule_body, n_joints):
    torch = pytest.importorskip("torch")
    lbs = pytest.importorskip("smplx.lbs").lbs
    path = saved(n_joints)
    body = BodyModel.load(path)
    betas = np.random.default_rng(0).normal(size=10)
    motion = a_motion(n_joints, betas=betas)
    arrays = capsule_body(n_joints)
    as_tensor = {k: torch.from_numpy(np.asarray(v, dtype=np.float64)) for k, v in arrays.items()}
    vectors = Rotation.from_quat(motion.rotations.reshape(-1, 4)).as_rotvec()
    vertices, joints = lbs(
        torch.from_numpy(np.tile(betas, (motion.n_frames, 1))),
        torch.from_numpy(vectors.reshape(motion.n_frames, -1)),
        as_tensor["v_template"],
        as_tensor["shapedirs"][..., :10],
        as_tensor["posedirs"].reshape(-1, 9 * (n_joints - 1)).T,
        as_tensor["J_regressor"],
        torch.tensor(body.parents),
        as_tensor["weights"],
    )
    # smplx adds `transl` to the pelvis at rest; our translation is where the pelvis is.
    step = motion.translation - body.joints_at_rest(betas)[0]
    np.testing.assert_allclose(body.vertices(motion), vertices.numpy() + step[:, None], atol=2e-6)
    rig = body.rig(motion.skeleton)
    ours = Motion(rig, motion.rotations, motion.translation, 30.0).positions()
    np.testing.assert_allclose(ours, joints.numpy() + step[:, None], atol=2e-6)


def test_regressors_in_the_parts_of_a_sparse_matrix(saved, body, capsule_body):
    dense = capsule_body(24)["J_regressor"]
    for kind in (csr_array, csc_array):
        sparse = kind(dense)
        parts = {f"J_regressor_{key}": getattr(sparse, key) for key in SPARSE}
        path = saved(J_regressor=None, **parts)
        np.testing.assert_array_equal(BodyModel.load(path).regressor, body.regressor)


def test_pickled_notes_are_left_alone_and_pickled_arrays_refused(saved):
    notes = np.array([{"pelvis": 0}], dtype=object)
    assert BodyModel.load(saved(joint2num=notes)).n_joints == 24
    with pytest.raises(FormatError, match="(?=.*'J_regressor').*pickled"):
        BodyModel.load(saved(J_regressor=notes))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"v_template": np.zeros((9, 3))}, r"(?=.*\(748, 24\)).*\b9\b"),
        ({"v_template": None}, "'v_template'"),
        ({"weights": np.zeros((3, 2))}, "weights"),
        ({"kintree_table": np.array([[-1, 5, 0] + [0] * 21, range(24)])}, "kintree_table"),
        ({"f": np.array([[0, 1, 99999]])}, "748"),
        ({"f": np.array([[0.0, 1.0, 2.0]])}, "f .*float64"),
        ({"posedirs": np.zeros((3, 3, 207))}, "posedirs"),
        ({"shapedirs": np.zeros((3, 3))}, "shapedirs"),
        ({"J_regressor": np.zeros((24, 7))}, "J_regressor"),
        ({"J_regressor": None}, "'J_regressor'"),
        ({"posedirs": np.full((748, 3, 207), np.nan)}, "(?=.*posedirs).*finite"),
        ({"weights": np.zeros((748, 24))}, r"(?=.*weights).*\b1\b"),
        (NOT_SPARSE, r"(?=.*J_regressor).*\(24, 748\)"),
        ({"v_template": np.zeros((200_001, 3))}, r"(?=.*v_template).*\(200001, 3\)"),
        ({"weights": np.full((748, 257), 1 / 257)}, r"(?=.*weights).*\(748, 257\)"),
        ({"weights": np.eye(24)[np.zeros(748, int)] * 2 - np.eye(24)[1]}, "negative"),
    ],
)
def test_files_that_are_no_body_model(saved, change, says):
    path = saved(**change)
    with pytest.raises(FormatError, match=f"{re.escape(str(path))}.*{says}"):
        BodyModel.load(path)


def test_missing_pickled_and_other_models_are_refused(saved, body, tmp_path):
    with pytest.raises(FormatError, match=r"absent\.npz"):
        BodyModel.of(tmp_path / "absent.npz", smpl_skeleton(24))
    (tmp_path / "SMPL.pkl").write_bytes(b"\x80\x04.")
    with pytest.raises(FormatError, match=r"SMPL\.pkl.*\.npz"):
        BodyModel.load(tmp_path / "SMPL.pkl")
    for feet, says in (
        ([1, 2], r"\b2\b"),
        ([0, 1, 2, 3, 4, -1], r"(?=.*-1).*\b748"),
        ([0, 1, 2, 3, 4, 748], r"(?=.*\b748\]).*\b748"),
    ):
        with pytest.raises(FormatError, match=says):
            BodyModel.load(saved(), feet=feet)
    with pytest.raises(MotionError, match=r"(?=.*\b24\b).*55"):
        body.vertices(a_motion(55))


def test_a_folder_gives_the_model_of_a_rig_and_its_gender(tmp_path, saved):
    for name in ("SMPL_NEUTRAL", "smpl/SMPL_FEMALE", "smplh_male"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        saved(52 if "smplh" in name else 24).rename(tmp_path / f"{name}.npz")

    def chosen(n_joints, gender):
        shape = BodyShape(gender=gender)
        body = BodyModel.of(tmp_path, replace(smpl_skeleton(n_joints), body_shape=shape))
        return body.source.removeprefix(f"{tmp_path}/")

    assert chosen(24, None) == chosen(22, "neutral") == "SMPL_NEUTRAL.npz"
    assert chosen(24, "female") == "smpl/SMPL_FEMALE.npz"
    assert chosen(52, "male") == "smplh_male.npz"
    for n_joints, gender, file in ((24, "male", "SMPL_MALE"), (55, None, "SMPLX_NEUTRAL")):
        with pytest.raises(FormatError, match=rf"{file}\.npz"):
            chosen(n_joints, gender)


def test_the_mean_body_of_recordings_has_the_bones_of_the_mean_betas(body):
    def rig(betas, gender="male"):
        shape = BodyShape(betas, gender=gender)
        return body.rig(replace(smpl_skeleton(24), body_shape=shape))

    mean = mean_body([rig((1.0,)), rig((3.0, 2.0)), rig((8.0, 1.0)), rig((9.0,), "female")])
    assert mean.body_shape.betas == (4.0, 1.0) and mean.body_shape.gender == "male"
    joints = body.joints_at_rest([4.0, 1.0])
    np.testing.assert_allclose(mean.body_shape.pelvis, joints[0], atol=1e-12)
    bones = joints[1:] - joints[list(mean.parents[1:])]
    np.testing.assert_allclose(mean.offsets[1:], bones, atol=1e-12)
    feet = body.vertices_at_rest([4.0, 1.0], body.feet)
    for name, first in (("left_foot", 0), ("right_ankle", 5)):
        place = joints[mean.index(name)] + mean.end_sites[name][0]
        np.testing.assert_allclose(place, feet[first], atol=1e-12)
    np.testing.assert_array_equal(mean_body([mean]).offsets, mean.offsets)


def test_a_model_with_fewer_betas_than_the_body_warns(body):
    motion = a_motion(betas=np.ones(21))
    with pytest.warns(UserWarning, match=r"(?=.*\b20 betas).*\b21"):
        fitted = fit_body(motion, body)
    known = body.rig(a_motion(betas=np.ones(20)).skeleton)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fit_body(a_motion(betas=np.ones(20)), body)
    np.testing.assert_array_equal(fitted.skeleton.offsets, known.offsets)
    assert len(fitted.skeleton.body_shape.betas) == 21  # and are written again


def test_a_shape_in_a_skeleton_file_is_checked():
    values = a_motion(betas=[0.5]).skeleton.to_json()
    assert Skeleton.from_json(values).body_shape == BodyShape((0.5,))
    for shape, says in (
        ({"gender": "man"}, "(?=.*'man').*female"),
        ({"betas": [float("nan")]}, "(?=.*betas).*nan"),
        ({"betas": [0.1] * 1001}, r"(?=.*\b1001\b).*\b1000"),
        ({"pelvis": [0.0, 1.0]}, r"(?=.*pelvis).*\b2\b"),
        ({"weight": 80}, "weight"),
    ):
        with pytest.raises(MotionError, match=says):
            Skeleton.from_json(values | {"body_shape": shape})
