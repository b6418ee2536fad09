from __future__ import annotations

import pickle
import warnings
from dataclasses import replace

import numpy as np
import pytest

from gesturekit.errors import FormatError
from gesturekit.formats import read_npz, write_npz
from gesturekit.formats.smpl import smpl_skeleton
from gesturekit.motion import Motion
from gesturekit.motion.rotations import quaternion_from_rotation_vector, rotation_angles


def smpl_motion(n_joints: int, fps: float = 30.0) -> Motion:
    rng = np.random.default_rng(0)
    rotations = quaternion_from_rotation_vector(0.3 * rng.normal(size=(20, n_joints, 3)))
    rig = smpl_skeleton(n_joints)
    return Motion(rig, rotations, np.array([0.1, 0.9, 0.2]) + rng.normal(size=(20, 3)) * 0.1, fps)


def test_any_rig_survives_to_the_last_bit(shared_data, tmp_path):
    for file in (
        "motion/bandai/dataset-1_bye_happy_001.bvh",
        "paired/zeggs_067_Speech_2/067_Speech_2_x_1_0.bvh",
    ):
        motion = Motion.load(shared_data / file).slice(0, 100)
        motion.save(tmp_path / "a.npz")
        again = Motion.load(tmp_path / "a.npz")
        assert (again.skeleton.names, again.fps) == (motion.skeleton.names, motion.fps)
        assert again.skeleton.rotation_orders == motion.skeleton.rotation_orders
        np.testing.assert_array_equal(again.positions(), motion.positions())
        ends = motion.end_positions()
        assert set(again.end_positions()) == set(ends)
        np.testing.assert_array_equal(
            again.end_positions()["Head" if "Head" in ends else "HeadEnd"],
            ends["Head" if "Head" in ends else "HeadEnd"],
        )
        assert set(again.joint_translations) == set(motion.joint_translations)


def test_same_motion_same_bytes(tmp_path):
    write_npz(smpl_motion(55), tmp_path / "a.npz")
    write_npz(smpl_motion(55), tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


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


@pytest.mark.parametrize("n_joints", [22, 24, 52, 55])
def test_smaller_rigs_fill_the_same_165_numbers(tmp_path, n_joints):
    motion = smpl_motion(n_joints)
    write_npz(motion, tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as file:
        turned = quaternion_from_rotation_vector(file["poses"].reshape(20, 55, 3))
    whole = smpl_skeleton(55)
    for name in ("left_hip", "right_wrist", "left_index2" if n_joints > 24 else "head"):
        a = motion.rotations[:, motion.skeleton.index(name)]
        assert rotation_angles(a, turned[:, whole.index(name)]).max() < 1e-6


def foreign(path, motion, up, **change):
    """What a file by others holds: the native keys taken out."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        write_npz(motion, path, up=up)
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


def test_real_amass_style_file(shared_data, tmp_path):
    motion = Motion.load(shared_data / "smpl/glamr_running_smpl.npz")
    assert motion.skeleton.names == smpl_skeleton(24).names
    assert (motion.n_frames, motion.fps, motion.info["up"]) == (203, 30.0, "z")
    places = motion.positions()
    head, pelvis = (places[:, motion.skeleton.index(name), 1] for name in ("head", "pelvis"))
    assert (head - pelvis).min() > 0.3  # upright, in metres
    assert 0.7 < pelvis.mean() < 1.1
    assert -0.15 < places[..., 1].min() < 0.15  # and with its feet on the ground


@pytest.mark.parametrize(("fps", "says"), [(25.0, "refuses 25 fps"), (50.0, "wrong speed")])
def test_rates_that_the_blender_add_on_cannot_take(tmp_path, fps, says):
    with pytest.warns(UserWarning, match=rf"{says}.*--fps 30"):
        write_npz(smpl_motion(55, fps), tmp_path / "a.npz")
    assert read_npz(tmp_path / "a.npz").fps == fps


def test_shapes_of_a_body_are_kept(tmp_path):
    motion = replace(smpl_motion(55), info={"betas": np.arange(10.0)})
    write_npz(motion, tmp_path / "a.npz")
    np.testing.assert_array_equal(read_npz(tmp_path / "a.npz").info["betas"][:10], np.arange(10))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"poses": np.zeros((20, 99))}, "(20, 99)"),
        ({"poses": np.zeros(165)}, "(165,)"),
        ({"trans": np.zeros((19, 3))}, "(19, 3)"),
        ({"mocap_framerate": None}, "mocap_frame_rate"),
        ({"trans": None}, "'trans'"),
        ({"poses": np.full((20, 165), np.nan)}, "frame 0"),
        ({"mocap_framerate": -30.0}, "fps"),
        ({"mocap_framerate": "thirty"}, "thirty"),
    ],
)
def test_amass_files_that_are_broken(tmp_path, change, says):
    path = foreign(tmp_path / "a.npz", smpl_motion(55), "y", **change)
    with pytest.raises(FormatError) as caught:
        read_npz(path)
    assert str(path) in str(caught.value) and says in str(caught.value)


@pytest.mark.parametrize(
    "change",
    [
        {"gk_version": 2},
        {"names": np.array(["a"])},
        {"parents": np.zeros(55)},
        {"rotations": np.zeros((20, 55, 4))},
        {"rotations": np.zeros((3, 3))},
        {"fps": np.array([1.0, 2.0])},
        {"end_site_joints": np.array([99]), "end_site_offsets": np.zeros((1, 3))},
        {"moving_joints": np.array([99]), "joint_translations": np.zeros((1, 20, 3))},
    ],
)
def test_native_files_that_are_broken(tmp_path, change):
    write_npz(smpl_motion(55), tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as file:
        values = dict(file) | change
    np.savez(tmp_path / "a.npz", **values)
    with pytest.raises(FormatError, match=r"a\.npz"):
        read_npz(tmp_path / "a.npz")


def test_files_that_are_no_npz(tmp_path):
    path = tmp_path / "a.npz"
    with pytest.raises(FormatError, match="no such file"):
        read_npz(path)
    for content in (b"", b"PK\x03\x04 no zip", b"text"):
        path.write_bytes(content)
        with pytest.raises(FormatError, match="npz"):
            read_npz(path)
    write_npz(smpl_motion(24), path)
    path.write_bytes(path.read_bytes()[:-500])
    with pytest.raises(FormatError):
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
    with pytest.raises(FormatError, match="'poses'"):
        read_npz(path)
    assert not Trap.sprung
    pickle.loads(pickle.dumps(Trap()))
    assert Trap.sprung  # the trap works
