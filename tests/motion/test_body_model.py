from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
from rigs import at_rest
from scipy.sparse import csc_array, csr_array
from scipy.spatial.transform import Rotation

from gesturekit.corpus import Item
from gesturekit.errors import FormatError, MotionError
from gesturekit.formats.smpl.skeleton import fit_body, mean_body, smpl_skeleton
from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.body_model.model import BodyModel
from gesturekit.motion.body_shape import BodyShape
from gesturekit.motion.contacts import contact_labels, foot_points, foot_positions
from gesturekit.motion.rotations import (
    quaternion_from_rotation_vector,
    rotation_vector_from_quaternion,
)
from gesturekit.multires.motion_vector import MultiresRepresentation
from gesturekit.training.recordings import load_motions

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


def test_skin_by_the_formula_of_the_paper(saved, capsule_body):
    """Loper et al. 2015, eqs. 2 to 4 and 6 to 10, vertex by vertex with 4 x 4 matrices."""
    arrays, body = capsule_body(24), BodyModel.load(saved(24))
    betas = np.random.default_rng(0).normal(size=20)
    motion = a_motion(n_frames=2, betas=betas)
    shaped = arrays["v_template"] + arrays["shapedirs"] @ betas
    joints = arrays["J_regressor"] @ shaped
    for t in range(2):
        turns = Rotation.from_quat(motion.rotations[t]).as_matrix()
        world = []
        for j, parent in enumerate(body.parents):
            local = np.eye(4)
            local[:3, :3] = turns[j]
            local[:3, 3] = joints[j] - joints[parent] if j else motion.translation[t]
            world.append(world[parent] @ local if j else local)
        posed = shaped + arrays["posedirs"] @ (turns[1:] - np.eye(3)).ravel()
        expected = np.zeros_like(posed)
        for j, matrix in enumerate(world):
            moved = (posed - joints[j]) @ matrix[:3, :3].T + matrix[:3, 3]
            expected += arrays["weights"][:, j, None] * moved
        np.testing.assert_allclose(body.vertices(motion)[t], expected, atol=2e-6)


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


def test_a_few_vertices_are_those_of_the_whole_skin(body):
    motion = a_motion(betas=np.array([1.0, -1.0]))
    few = body.vertices(motion, body.feet)
    assert few.shape == (20, 6, 3)
    np.testing.assert_allclose(few, body.vertices(motion)[:, list(body.feet)], atol=1e-6)


def test_a_rig_of_the_body_has_its_six_foot_points(body):
    motion = a_motion()
    rig = body.rig(motion.skeleton)
    points = foot_points(rig)
    feet = [f"{side}_{joint}" for side in ("left", "right") for joint in ("foot", "foot", "ankle")]
    assert [point.joint for point in points] == feet
    still = at_rest(rig, 3, rig.offsets[0])
    feet = foot_positions(still)
    np.testing.assert_allclose(feet[0], body.vertices_at_rest(indices=body.feet), atol=1e-9)
    assert contact_labels(still).shape == (3, 6) and contact_labels(still).min() == 1
    # Fixed to one joint they are where the skin is, but for what a pose corrects (millimetres).
    moving = Motion(rig, motion.rotations, motion.translation, 30.0)
    apart = np.linalg.norm(foot_positions(moving) - body.vertices(moving, body.feet), axis=-1)
    assert apart.max() < 0.01


def test_the_motion_vector_has_the_six_labels_of_the_paper(body):
    motion = a_motion()
    motion = Motion(body.rig(motion.skeleton), motion.rotations, motion.translation, 30.0)
    representation = MultiresRepresentation.fit([motion], joints="all")
    assert representation.n_features == 24 * 6 + 6 + 3
    labels = representation.encode(motion)[:, representation.layout.contacts]
    np.testing.assert_array_equal(labels, contact_labels(motion))


def test_regressors_in_the_parts_of_a_sparse_matrix(saved, body, capsule_body):
    dense = capsule_body(24)["J_regressor"]
    for kind in (csr_array, csc_array):
        sparse = kind(dense)
        parts = {f"J_regressor_{key}": getattr(sparse, key) for key in SPARSE}
        path = saved(J_regressor=None, **parts)
        np.testing.assert_array_equal(BodyModel.load(path).regressor, body.regressor)


def test_smplx_files_keep_expressions_of_the_face_behind_the_shapes(saved, capsule_body):
    assert BodyModel.load(saved(55)).shapes.shape[-1] == 10
    many = np.zeros((len(capsule_body(55)["v_template"]), 3, 400))
    assert BodyModel.load(saved(55, shapedirs=many)).shapes.shape[-1] == 300
    assert BodyModel.load(saved(24)).shapes.shape[-1] == 20


def test_pickled_notes_are_left_alone_and_pickled_arrays_refused(saved):
    notes = np.array([{"pelvis": 0}], dtype=object)
    assert BodyModel.load(saved(joint2num=notes)).n_joints == 24
    with pytest.raises(FormatError, match="'J_regressor'.*pickled"):
        BodyModel.load(saved(J_regressor=notes))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"v_template": np.zeros((9, 3))}, "9 vertices"),
        ({"v_template": None}, "'v_template'"),
        ({"weights": np.zeros((3, 2))}, "weights"),
        ({"kintree_table": np.array([[-1, 5, 0] + [0] * 21, range(24)])}, "tree"),
        ({"f": np.array([[0, 1, 99999]])}, "among"),
        ({"f": np.array([[0.0, 1.0, 2.0]])}, "f has shape"),
        ({"posedirs": np.zeros((3, 3, 207))}, "posedirs"),
        ({"shapedirs": np.zeros((3, 3))}, "shapedirs"),
        ({"J_regressor": np.zeros((24, 7))}, "J_regressor"),
        ({"J_regressor": None}, "'J_regressor'"),
        ({"kintree_table": np.full((2, 24), np.nan)}, "kintree_table"),
        ({"kintree_table": np.zeros((0, 24))}, "kintree_table"),
        ({"posedirs": np.full((748, 3, 207), np.nan)}, "posedirs holds"),
        ({"weights": np.zeros((748, 24))}, "sum to 1"),
        (NOT_SPARSE, "J_regressor is not a sparse matrix"),
        ({"v_template": np.zeros(748)}, "v_template has shape (748,)"),
        ({"v_template": np.zeros((748, 4))}, "v_template has shape (748, 4)"),
        ({"v_template": np.zeros((0, 3))}, "v_template has shape (0, 3)"),
        ({"v_template": np.zeros((200_001, 3))}, "v_template has shape (200001, 3)"),
        ({"v_template": np.full((748, 3), np.inf)}, "v_template holds"),
        ({"weights": np.ones(748)}, "weights have shape (748,)"),
        ({"weights": np.ones((748, 0))}, "weights have shape (748, 0)"),
        ({"weights": np.full((748, 257), 1 / 257)}, "weights have shape (748, 257)"),
        ({"weights": np.eye(24)[np.zeros(748, int)] * 1.02}, "sum to 1"),
        ({"weights": np.eye(24)[np.zeros(748, int)] * 2 - np.eye(24)[1]}, "negative"),
        ({"shapedirs": np.zeros((748, 2, 3))}, "shapedirs"),
        ({"posedirs": np.zeros((748, 3, 206))}, "posedirs"),
        ({"kintree_table": np.zeros((2, 23))}, "kintree_table has shape (23,)"),
        ({"kintree_table": np.array([-1, 0, 2, *range(2, 23)])}, "tree"),
        ({"kintree_table": np.array([-1, 0, -1, *range(2, 23)])}, "tree"),
        ({"f": np.array([[0, 1, -1]])}, "among"),
        ({"f": np.array([[0, 1, 748]])}, "among"),
        ({"f": np.array([0, 1, 2])}, "f has shape"),
        ({"f": np.array([[0, 1]])}, "f has shape"),
    ],
)
def test_files_that_are_no_body_model(saved, change, says):
    path = saved(**change)
    with pytest.raises(FormatError) as caught:
        BodyModel.load(path)
    assert str(path) in str(caught.value) and says in str(caught.value)


def test_files_that_differ_in_what_does_not_matter_are_the_same_model(saved, body):
    """A tree of one row, or with a root whose parent is -1 as an unsigned number; no faces; feet
    at the ends of the list; weights that are rounded.
    """
    parents = np.array([body.parents, range(24)])
    unsigned = (parents % 2**32).astype(np.uint32)
    rounded = {"weights": 1.009 * np.eye(24)[np.zeros(748, int)], "kintree_table": parents[0]}
    for change in ({"kintree_table": unsigned}, rounded, {"f": np.zeros((0, 3), int)}):
        again = BodyModel.load(saved(**change), feet=[0, 1, 2, 3, 4, 747])
        assert (again.parents, again.feet) == (body.parents, (0, 1, 2, 3, 4, 747))
        assert again.n_vertices == 748 and again.faces.dtype == np.int64
    plain = BodyModel.load(saved(shapedirs=None, posedirs=None))
    assert plain.feet is None and plain.shapes.shape == (748, 3, 0)
    assert plain.rig(smpl_skeleton(24)).end_sites == {}
    np.testing.assert_allclose(plain.joints_at_rest([3.0]), body.joints_at_rest(), atol=1e-12)
    motion = at_rest(smpl_skeleton(24), 2, body.joints_at_rest()[0])
    np.testing.assert_allclose(plain.vertices(motion)[1], plain.template, atol=1e-6)


def test_missing_pickled_and_other_models_are_refused(saved, body, tmp_path):
    with pytest.raises(FormatError, match="no such body model"):
        BodyModel.of(tmp_path / "absent.npz", smpl_skeleton(24))
    (tmp_path / "SMPL.pkl").write_bytes(b"\x80\x04.")
    with pytest.raises(FormatError, match="pickle"):
        BodyModel.load(tmp_path / "SMPL.pkl")
    for feet, says in (
        ([1, 2], "2 foot vertices, not six"),
        ([0, 1, 2, 3, 4, -1], "not among 748"),
        ([0, 1, 2, 3, 4, 748], "not among 748"),
    ):
        with pytest.raises(FormatError, match=says):
            BodyModel.load(saved(), feet=feet)
    with pytest.raises(MotionError, match="24 joints and the rig 55"):
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
        with pytest.raises(FormatError, match=rf"subfolder smplx? has {file}\.npz; add that file"):
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


def test_a_model_whose_joints_hang_together_otherwise_is_refused(body):
    other = replace(body, parents=(*body.parents[:-1], 20))
    with pytest.raises(FormatError, match="a model of 24 joints, not of the SMPL family"):
        fit_body(a_motion(), other)


def test_a_model_with_fewer_betas_than_the_body_warns(body):
    motion = a_motion(betas=np.ones(21))
    with pytest.warns(UserWarning, match="a model of 20 betas for a body of 21; the others are"):
        fitted = fit_body(motion, body)
    known = body.rig(a_motion(betas=np.ones(20)).skeleton)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fit_body(a_motion(betas=np.ones(20)), body)
    np.testing.assert_array_equal(fitted.skeleton.offsets, known.offsets)
    assert len(fitted.skeleton.body_shape.betas) == 21  # and are written again


@pytest.mark.parametrize("up", ["y", "z", "-y"])
def test_recordings_of_a_speaker_keep_trans_on_the_mean_body(body, saved, tmp_path, caplog, up):
    motion, model, items = a_motion(), saved(), []
    vectors = rotation_vector_from_quaternion(motion.rotations).reshape(20, -1)
    for name, betas in (("a", (2.0, 0.4)), ("b", (-1.0, 0.0, 3.0))):
        file = tmp_path / f"{name}.npz"
        np.savez(file, poses=vectors, trans=motion.translation, betas=betas, mocap_framerate=30)
        reading = {"up": up, "body_model": str(model)}
        part = {"audio": None, "duration": 20 / 30, "speaker": "ann", "reading": reading}
        items.append(Item(id=name, motion=file, **part))
    recorded = load_motions(items, tmp_path / "corpus.jsonl", 30.0, {})
    assert "2 recordings of speaker ann have 2 body shapes; the mean" in caplog.text
    turn = {"y": np.eye(3), "z": [[1, 0, 0], [0, 0, 1], [0, -1, 0]], "-y": np.diag([1, -1, -1])}
    pelvis = motion.translation + body.joints_at_rest([0.5, 0.2, 1.5])[0]
    for one in recorded:
        assert one.skeleton.body_shape.betas == pytest.approx((0.5, 0.2, 1.5))
        np.testing.assert_allclose(one.translation, pelvis @ np.transpose(turn[up]), atol=1e-9)


def test_a_shape_in_a_skeleton_file_is_checked():
    values = a_motion(betas=[0.5]).skeleton.to_json()
    assert Skeleton.from_json(values).body_shape == BodyShape((0.5,))
    for shape, says in (
        ({"gender": "man"}, "gender 'man'; expected female"),
        ({"betas": [float("nan")]}, "betas of shape"),
        ({"betas": [0.1] * 1001}, "1001 betas; a body has up to 1000"),
        ({"pelvis": [0.0, 1.0]}, "pelvis: 2 numbers"),
        ({"weight": 80}, "weight"),
    ):
        with pytest.raises(MotionError, match=says):
            Skeleton.from_json(values | {"body_shape": shape})
