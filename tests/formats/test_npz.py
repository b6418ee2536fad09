import pickle
import warnings
from dataclasses import replace

import numpy as np
import pytest
from recordings import BANDAI, ZEGGS
from scipy.spatial.transform import Rotation

from gesturekit.errors import FormatError
from gesturekit.formats import read_npz, write_npz
from gesturekit.formats.smpl import fit_body, model_pelvis, smpl_skeleton
from gesturekit.motion import Motion
from gesturekit.motion.body_model import BodyModel
from gesturekit.motion.contacts import contact_labels, foot_points
from gesturekit.motion.rotations import quaternion_from_rotation_vector, rotation_angles
from gesturekit.motion.skeleton import BodyShape


def smpl_motion(n_joints: int, fps: float = 30.0) -> Motion:
    rng = np.random.default_rng(0)
    rotations = quaternion_from_rotation_vector(0.3 * rng.normal(size=(20, n_joints, 3)))
    rig = smpl_skeleton(n_joints)
    return Motion(rig, rotations, np.array([0.1, 0.9, 0.2]) + rng.normal(size=(20, 3)) * 0.1, fps)


def test_any_rig_survives_to_the_last_bit(shared_data, tmp_path):
    for file in (BANDAI, ZEGGS):
        motion = Motion.load(shared_data / file)[:100]
        motion.save(tmp_path / "a.npz")
        again = Motion.load(tmp_path / "a.npz")
        assert (again.skeleton.names, again.fps) == (motion.skeleton.names, motion.fps)
        assert again.skeleton.rotation_orders == motion.skeleton.rotation_orders
        np.testing.assert_array_equal(again.positions(), motion.positions())
        assert set(again.end_positions()) == set(motion.end_positions())
        for name, ends in motion.end_positions().items():
            np.testing.assert_array_equal(again.end_positions()[name], ends)
        assert set(again.joint_translations) == set(motion.joint_translations)


def test_beat2_keys(tmp_path):
    motion = smpl_motion(55)
    write_npz(motion, tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz", allow_pickle=False) as file:
        assert file["poses"].shape == (20, 165)
        assert file["expressions"].shape == (20, 100)
        assert file["betas"].shape == (300,)
        assert str(file["gender"]) == "neutral" and str(file["model"]) == "smplx2020"
        assert int(file["mocap_frame_rate"]) == int(file["mocap_framerate"]) == 30
        turned = quaternion_from_rotation_vector(file["poses"].reshape(20, 55, 3))
        assert rotation_angles(turned, motion.rotations).max() < 1e-6
        # The unmoved SMPL-X model holds its pelvis 35 cm below its origin.
        np.testing.assert_allclose(file["trans"][:, 1], motion.translation[:, 1] + 0.35)


def foreign(path, motion, up, rig=None, **change):
    """What a file by others holds: the native keys taken out."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        write_npz(motion, path, up=up, rig=rig)
    with np.load(path) as file:
        keys = ("poses", "trans", "betas", "gender", "mocap_framerate")
        values = {key: file[key] for key in keys} | change
    np.savez(path, **{key: value for key, value in values.items() if value is not None})
    return path


@pytest.mark.parametrize("up", ["y", "z"])
def test_amass_and_beat2_files_are_read_whichever_axis_is_up(tmp_path, up):
    motion = smpl_motion(55)
    again = read_npz(foreign(tmp_path / "a.npz", motion, up))
    assert again.info["up"] == up and again.fps == 30
    np.testing.assert_allclose(again.positions(), motion.positions(), atol=1e-9)
    assert read_npz(tmp_path / "a.npz", up=up).info["up"] == up
    foreign(tmp_path / "a.npz", motion, up, times=np.arange(20), v_template=np.zeros((9, 3)))
    assert read_npz(tmp_path / "a.npz").n_frames == 20, "of features and bodies alone"
    with pytest.raises(FormatError, match="(?=.*'x').*-y"):
        read_npz(tmp_path / "a.npz", up="x")


@pytest.mark.parametrize("fps", [20.0, 50.0])
def test_rates_are_converted_on_request(tmp_path, fps):
    motion = smpl_motion(55, fps)
    with pytest.warns(UserWarning, match="--fps 30"):
        write_npz(motion, tmp_path / "as-is.npz")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        write_npz(motion, tmp_path / "a.npz", fps=30)
    again = read_npz(tmp_path / "a.npz")
    assert again.fps == 30 and abs(again.duration - motion.duration) < 1 / 30


def beat2(path, n_frames=12):
    """A file as PantoMatrix' beat_format_save writes it."""
    rng = np.random.default_rng(1)
    values = {
        "betas": rng.normal(size=300),
        "poses": 0.3 * rng.normal(size=(n_frames, 165)),
        "expressions": rng.normal(size=(n_frames, 100)),
        "trans": rng.normal(size=(n_frames, 3)),
        "model": "smplx2020",
        "gender": "female",
        "mocap_frame_rate": 30,
    }
    np.savez(path, **values)
    return values


def test_a_beat2_file_comes_back_as_it_was(tmp_path):
    values = beat2(tmp_path / "beat2.npz")
    motion = Motion.load(tmp_path / "beat2.npz", up="y")
    motion.save(tmp_path / "a.npz")
    Motion.load(tmp_path / "a.npz").save(tmp_path / "b.npz")  # and by way of the native keys
    for name in ("a.npz", "b.npz"):
        with np.load(tmp_path / name) as file:
            for key in ("betas", "expressions", "trans"):
                np.testing.assert_allclose(file[key], values[key], atol=1e-12)
            np.testing.assert_allclose(file["poses"], values["poses"], atol=1e-9)
            assert (str(file["gender"]), str(file["model"])) == ("female", "smplx2020")


@pytest.mark.parametrize("old", [22, 24, 52, 55])
@pytest.mark.parametrize(("rig", "new"), [("smpl", 24), ("smplh", 52), ("smplx", 55)])
def test_any_rig_of_the_family_to_any_other(tmp_path, old, rig, new):
    motion = smpl_motion(old)
    again = read_npz(foreign(tmp_path / "a.npz", motion, "z", rig=rig), up="z")
    assert again.skeleton.names == smpl_skeleton(new).names
    np.testing.assert_allclose(again.translation, motion.translation, atol=1e-9)
    for j, name in enumerate(again.skeleton.names):
        turns = again.rotations[:, j]
        if name in motion.skeleton.names:
            expected = motion.rotations[:, motion.skeleton.index(name)]
        else:
            expected = np.tile([0.0, 0, 0, 1], (len(turns), 1))
        assert rotation_angles(turns, expected).max() < 1e-6


@pytest.mark.parametrize("up", ["auto", "-y"])
def test_a_body_in_the_axes_of_a_camera_is_turned_upright(tmp_path, up):
    motion = smpl_motion(55)
    path = foreign(tmp_path / "a.npz", motion, "y")
    with np.load(path) as file:
        values = dict(file)
    turn = Rotation.from_euler("x", 180, degrees=True)
    poses = values["poses"].copy()
    poses[:, :3] = (turn * Rotation.from_rotvec(poses[:, :3])).as_rotvec()
    trans = turn.apply(values["trans"] + model_pelvis(55)) - model_pelvis(55)
    np.savez(path, **values | {"poses": poses, "trans": trans})
    read = read_npz(path, up=up)
    np.testing.assert_allclose(read.positions(), motion.positions(), atol=1e-9)
    assert read.info["up"] == "-y"
    read.save(tmp_path / "own.npz")  # trans is kept, and so is the axis of its body model
    assert read_npz(tmp_path / "own.npz").info["up"] == "-y"


def test_shapes_are_kept_within_their_space_and_dropped_outside(tmp_path):
    betas = np.arange(1.0, 11.0)
    motion = smpl_motion(24)
    shape = BodyShape(tuple(betas), gender="male")
    motion = replace(motion, skeleton=replace(motion.skeleton, body_shape=shape))
    write_npz(motion, tmp_path / "h.npz", rig="smplh")
    with pytest.warns(UserWarning, match="(?=.*betas).*--rig smpl"):
        write_npz(motion, tmp_path / "x.npz", rig="smplx")
    write_npz(motion, tmp_path / "own.npz")
    with np.load(tmp_path / "h.npz") as h, np.load(tmp_path / "x.npz") as x:
        np.testing.assert_array_equal(h["betas"], [*betas, 0, 0, 0, 0, 0, 0])
        assert h["dmpls"].shape == (20, 8)
        assert not x["betas"].any() and x["betas"].shape == (300,)
        assert str(x["gender"]) == str(h["gender"]) == "male"
    assert read_npz(tmp_path / "own.npz").skeleton.body_shape.betas == tuple(betas)


def test_joints_hang_together_as_in_the_models_own_tables():
    body = [-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19]
    assert list(smpl_skeleton(22).parents) == body
    assert list(smpl_skeleton(24).parents) == [*body, 20, 21]
    for n_joints, face in ((52, []), (55, [15, 15, 15])):
        first = 22 + len(face)
        hands = []
        for joint in range(first, first + 30, 3):
            hands += [20 if joint < first + 15 else 21, joint, joint + 1]
        assert list(smpl_skeleton(n_joints).parents) == [*body, *face, *hands]


@pytest.mark.filterwarnings("ignore:.*a model of 10 betas for a body of 300")
def test_a_body_model_gives_the_rig_its_bones(tmp_path, capsule_body):
    values = beat2(tmp_path / "beat2.npz")
    arrays = capsule_body(55)
    np.savez(tmp_path / "BODY.npz", **arrays)
    body = BodyModel.load(tmp_path / "BODY.npz", feet=arrays["feet"])
    motion = read_npz(tmp_path / "beat2.npz", up="y", body_model=body)
    joints = body.joints_at_rest(values["betas"])
    np.testing.assert_allclose(motion.translation, values["trans"] + joints[0], atol=1e-9)
    np.testing.assert_allclose(motion.skeleton.offsets[1], joints[1] - joints[0], atol=1e-9)
    assert contact_labels(motion).shape == (12, 6)
    # Fitted later it is the same, and what is written is what was read.
    later = fit_body(read_npz(tmp_path / "beat2.npz", up="y"), body)
    np.testing.assert_allclose(later.positions(), motion.positions(), atol=1e-9)
    for up in ("y", "z"):
        path = foreign(tmp_path / "a.npz", motion, up)
        again = read_npz(path, up=up, body_model=body)
        np.testing.assert_allclose(again.positions(), motion.positions(), atol=1e-9)
        read_npz(path, up=up).save(tmp_path / "native.npz")
        later = fit_body(read_npz(tmp_path / "native.npz"), body)
        np.testing.assert_allclose(later.positions(), motion.positions(), atol=1e-9)
    write_npz(motion, tmp_path / "native.npz")
    again = read_npz(tmp_path / "native.npz")
    assert len(foot_points(again.skeleton)) == 6
    with np.load(tmp_path / "native.npz") as file:
        np.testing.assert_allclose(file["trans"], values["trans"], atol=1e-9)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"poses": np.zeros((20, 99))}, r"\(20, 99\)"),
        ({"trans": np.zeros((19, 3))}, r"(?=.*'trans')(?=.*\(19, 3\)).*\(20, 3\)"),
        ({"mocap_framerate": None}, "mocap_frame_rate"),
        ({"poses": np.full((20, 165), np.nan)}, "frame 0"),
        ({"mocap_frame_rate": 60}, "(?=.*'mocap_frame_rate' 60).*'mocap_framerate' 30"),
        ({"poses": np.array([{}])}, "(?=.*'poses').*pickle"),
        ({"betas": np.zeros(1001)}, r"(?=.*'betas').*\(1001,\)"),
        ({"betas": np.full(10, np.nan)}, "(?=.*'betas').*finite"),
        ({"poses": None, "v_template": np.zeros((9, 3))}, "--body-model"),
        ({"poses": None, "values": np.zeros(9), "times": np.zeros(9), "spec": "{}"}, "features"),
    ],
)
def test_amass_files_that_are_broken(tmp_path, change, says):
    path = foreign(tmp_path / "a.npz", smpl_motion(55), "y", **change)
    with pytest.raises(FormatError, match=f"{path}.*{says}"):
        read_npz(path)


def test_the_keys_of_another_npz_are_listed(tmp_path):
    path = tmp_path / "a.npz"
    keys = {"é" + "x" * 50: 0, **{f"k{i}": 0 for i in range(8)}}
    for arrays, held in ((keys, rf"\\xe9{'x' * 36}, k0.*, k6 and 1 more"), ({}, "none")):
        np.savez(path, **arrays)
        with pytest.raises(FormatError, match=f"{path}: no key 'poses'.* has {held}$"):
            read_npz(path)


def test_files_that_are_no_npz(tmp_path):
    path = tmp_path / "a.npz"
    write_npz(smpl_motion(24), path)
    for content in (None, b"", b"PK\x03\x04 no zip", b"text", path.read_bytes()[:-500]):
        path.unlink() if content is None else path.write_bytes(content)
        with pytest.raises(FormatError, match=str(path)):
            read_npz(path)


class Trap:
    sprung = False

    def __reduce__(self):
        return setattr, (Trap, "sprung", True)


def test_nothing_pickled_is_ever_loaded(tmp_path):
    path = foreign(tmp_path / "a.npz", smpl_motion(55), "y", notes=np.array([Trap()], dtype=object))
    assert read_npz(path).n_frames == 20  # a pickled note is left alone
    assert not Trap.sprung
    foreign(path, smpl_motion(55), "y", poses=np.array([Trap()], dtype=object))
    with pytest.raises(FormatError, match="(?=.*'poses').*pickle"):
        read_npz(path)
    foreign(path, smpl_motion(55), "y", gender=np.array([Trap()], dtype=object))
    with pytest.warns(UserWarning, match="(?=.*'gender').*pickle"):
        assert read_npz(path).n_frames == 20
    assert not Trap.sprung
    pickle.loads(pickle.dumps(Trap()))
    assert Trap.sprung  # the trap works


def seamless(path, motion):
    """Write a motion of SMPL-H in the axes of a camera, Y down, with the keys of Seamless."""
    half = Rotation.from_euler("x", 180, degrees=True)
    turns = Rotation.from_quat(motion.rotations.reshape(-1, 4)).as_rotvec().reshape(-1, 52, 3)
    turns[:, 0] = (half * Rotation.from_rotvec(turns[:, 0])).as_rotvec()
    parts = np.split(turns, [1, 22, 37], axis=1)
    names = ("global_orient", "body_pose", "left_hand_pose", "right_hand_pose")
    values = dict(zip(names, parts)) | {"global_orient": turns[:, 0]}
    values["translation"] = half.apply(motion.translation) - model_pelvis(52)
    np.savez(path, **{f"smplh:{key}": value for key, value in values.items()})
    return path


def test_files_of_seamless_interaction_are_stood_up(tmp_path):
    motion = smpl_motion(52)
    path = seamless(tmp_path / "a.npz", motion)
    again = read_npz(path)
    assert (again.fps, again.info["up"]) == (30, "-y")
    for wrong, says in (
        (np.zeros((20, 20, 3)), r"body_pose.*\(20, 20, 3\)"),
        (np.zeros((19, 21, 3)), "frames"),
    ):
        np.savez(tmp_path / "b.npz", **{**np.load(path), "smplh:body_pose": wrong})
        with pytest.raises(FormatError, match=says):
            read_npz(tmp_path / "b.npz")
    assert again.skeleton.body_shape.pelvis == tuple(model_pelvis(52))
    np.testing.assert_allclose(again.positions(), motion.positions(), atol=1e-9)
