from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from recordings import BANDAI, ZEGGS
from rigs import at_rest
from scipy.spatial.transform import Rotation

from gesturekit.errors import MotionError
from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.body_shape import BodyShape
from gesturekit.motion.model_joints import first_moving_joint
from gesturekit.motion.parts import body_joints
from gesturekit.multires.kinematics import VectorKinematics
from gesturekit.multires.motion_vector import MultiresRepresentation


def check(motion: Motion, names: list[str]) -> Motion:
    """What stays lies and turns in the world as before."""
    kept = motion.keep(names)
    assert set(kept.skeleton.names) == set(names)
    before = [motion.skeleton.index(name) for name in kept.skeleton.names]
    np.testing.assert_allclose(kept.positions(), motion.positions()[:, before], atol=1e-5)
    same = np.abs((kept.global_rotations() * motion.global_rotations()[:, before]).sum(axis=-1))
    np.testing.assert_allclose(same, 1, atol=1e-9)
    return kept


def test_removed_leaf_joints_become_end_sites(moving_person):
    kept = check(moving_person, [n for n in moving_person.skeleton.names if "Toe" not in n])
    toe = moving_person.skeleton.index("LeftToeBase")
    ends = kept.end_positions()
    np.testing.assert_allclose(ends["LeftFoot"][:, 0], moving_person.positions()[:, toe])
    # A hand that has an end site already gets no other one.
    assert len(kept.skeleton.end_sites["LeftHand"]) == 1
    assert not kept.joint_translations


def test_a_joint_whose_parent_is_removed_is_attached_to_the_next_ancestor(moving_person):
    names = [n for n in moving_person.skeleton.names if n not in ("Chest", "LeftArm")]
    kept = check(moving_person, names)
    assert kept.skeleton.names[kept.skeleton.parents[kept.skeleton.index("Neck")]] == "Spine"
    # The chest turned under them, so they move under the spine.
    assert {"Neck", "LeftForeArm", "RightArm"} == set(kept.joint_translations)


def test_a_single_name_is_one_joint(moving_person):
    np.testing.assert_allclose(
        moving_person.keep("Head").positions()[:, 0],
        moving_person.positions()[:, moving_person.skeleton.index("Head")],
    )
    with pytest.raises(MotionError, match="no joint 'head'; did you mean Head"):
        moving_person.keep("head")


def test_another_root_moves_as_it_did(moving_person):
    rig = moving_person.skeleton
    spine = rig.index("Spine")
    moving = replace(moving_person, joint_translations={"Spine": moving_person.translation})
    kept = check(moving, [rig.names[j] for j in (spine, *rig.descendants(spine))])
    assert kept.skeleton.names[0] == "Spine" and not kept.joint_translations
    np.testing.assert_allclose(kept.skeleton.offsets[0], [0.0, 0.9 + 0.2, 0.0])
    # Where the root went, and another parent with it.
    kept = check(moving, ["Spine", "LeftForeArm", "LeftHand"])
    assert set(kept.joint_translations) == {"LeftForeArm"}


def test_what_is_known_of_kept_joints_is_kept(person):
    orders = tuple(("ZXY", "XYZ", "YZX")[j % 3] for j in range(person.n_joints))
    parts, shape = {"head": "Neck", "left_wrist": "LeftHand"}, BodyShape((0.5,), "female")
    rig = replace(person, rotation_orders=orders, parts=parts, body_shape=shape)
    names = [name for name in rig.names if name not in ("Chest", "LeftHand")]
    kept = at_rest(rig, 3).keep(names[::-1])
    assert kept.skeleton.names == tuple(names) and not kept.joint_translations
    assert kept.skeleton.rotation_orders == tuple(orders[rig.index(name)] for name in names)
    assert kept.skeleton.parts == {"head": "Neck"}
    assert kept.skeleton.body_shape.to_json() == shape.to_json()
    for name in ("Neck", "RightArm"):
        expected = rig.offsets[rig.index(name)] + rig.offsets[rig.index("Chest")]
        np.testing.assert_allclose(kept.skeleton.offsets[kept.skeleton.index(name)], expected)


@pytest.mark.parametrize("size", [1.0, 50.0])
@pytest.mark.parametrize(("angle", "moves"), [(1.6e-5, set()), (1.8e-5, {"LeftArm", "RightArm"})])
def test_what_varies_by_a_rounding_step_is_constant(person, angle, moves, size):
    """2.5e-6 m on a body of 1.4 m from ankle to head; the person has 1.42 m.

    Arms 0.15 m beside a chest that turns go up and down by 0.15 of the angle.
    """
    motion = at_rest(person, 4)
    turn = Rotation.from_rotvec(np.outer([0, 1, 0, 1], [0, 0, angle]))
    motion.rotations[:, person.index("Chest")] = turn.as_quat()
    kept = motion.scaled(size).keep([name for name in person.names if name != "Chest"])
    assert set(kept.joint_translations) == moves


def test_joints_that_cannot_be_removed_are_errors(moving_person):
    with pytest.raises(MotionError, match="keep 'Chest' too"):
        moving_person.keep(["LeftArm", "RightArm"])
    with pytest.raises(MotionError, match="keep '.*' too"):
        moving_person.keep(["LeftArm", "RightArm", "LeftFoot", "RightFoot"])
    with pytest.raises(MotionError, match="did you mean LeftArm"):
        moving_person.keep(["Leftarm"])
    with pytest.raises(MotionError, match="at least one"):
        moving_person.keep([])
    assert moving_person.keep(["Hips"]).skeleton.n_joints == 1


@pytest.mark.parametrize("file", [ZEGGS, BANDAI])
def test_bodies_of_real_recordings(shared_data, file, tmp_path):
    motion = Motion.load(shared_data / file)[:60]
    kept = check(motion, list(body_joints(motion.skeleton)))
    kept.save(tmp_path / "a.bvh")
    again = Motion.load(tmp_path / "a.bvh")
    np.testing.assert_allclose(again.positions(), kept.positions(), atol=1e-6)


def test_a_body_that_moves_above_the_waist_only_is_modelled_from_its_pelvis(moving_person):
    skeleton = moving_person.skeleton
    rotations = moving_person.rotations.copy()
    chest = skeleton.index("Chest")
    still = [j for j in range(skeleton.n_joints) if j not in (chest, *skeleton.descendants(chest))]
    rotations[:, still] = rotations[:1, still]
    place = np.repeat(moving_person.translation[:1], moving_person.n_frames, axis=0)
    seated = replace(moving_person, rotations=rotations, translation=place)
    assert skeleton.names[first_moving_joint([seated])] == "Hips"
    representation = MultiresRepresentation.fit([seated])
    VectorKinematics(representation, seated.fps)  # its legs hang on the model's root


def in_a_scene(body: Motion, turning: bool) -> Motion:
    """The body under a still root, on which a camera hangs too, before the body."""
    rig = body.skeleton
    skeleton = replace(
        rig,
        names=("Scene", "Camera", *rig.names),
        parents=(-1, 0, 0, *(parent + 2 for parent in rig.parents[1:])),
        offsets=np.concatenate([[[0, 0, 0], [0, 1.5, 4.0]], rig.offsets]),
        rotation_orders=("ZXY", "ZXY", *rig.rotation_orders),
    )
    still = np.tile([0.0, 0, 0, 1], (body.n_frames, 2, 1))
    if turning:
        still[:, 1] = body.rotations[:, 5]
    return replace(
        body,
        skeleton=skeleton,
        rotations=np.concatenate([still, body.rotations], axis=1),
        translation=np.zeros((body.n_frames, 3)),
        joint_translations={rig.names[0]: body.translation},
    )


@pytest.mark.parametrize("turning", [False, True])
def test_a_camera_beside_the_body_is_not_modelled(moving_person, turning):
    scene = in_a_scene(moving_person, turning)
    representation = MultiresRepresentation.fit([scene], "all")
    assert representation.joints == moving_person.skeleton.names
    VectorKinematics(representation, scene.fps)


def test_branches_of_an_unidentified_rig_that_all_move_share_the_models_root():
    skeleton = Skeleton(("hub", "a", "a2", "b", "b2"), (-1, 0, 1, 0, 3), np.ones((5, 3)))
    motion, half = at_rest(skeleton, 4), np.linspace(0, 0.4, 4)
    motion.rotations[:, [1, 3], 0] = np.sin(half)[:, None]
    motion.rotations[:, [1, 3], 3] = np.cos(half)[:, None]
    representation = MultiresRepresentation.fit([motion])
    assert representation.joints == skeleton.names
    VectorKinematics(representation, 30.0, arms=False)
