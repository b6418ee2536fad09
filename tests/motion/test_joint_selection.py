from dataclasses import replace

import numpy as np
import pytest
from rigs import at_rest

from gesturekit.errors import MotionError
from gesturekit.motion import Motion
from gesturekit.motion.skeleton import BodyShape


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


def test_joints_that_cannot_be_removed_are_errors(moving_person):
    with pytest.raises(MotionError, match="(?=.*'LeftArm')(?=.*'RightArm').*'Chest'"):
        moving_person.keep(["LeftArm", "RightArm"])
    with pytest.raises(MotionError, match="(?=.*'Leftarm').*LeftArm"):
        moving_person.keep(["Leftarm"])
    with pytest.raises(MotionError, match="joint"):
        moving_person.keep([])
    assert moving_person.keep(["Hips"]).skeleton.n_joints == 1
