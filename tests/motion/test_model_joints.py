"""Modelled joints of a rig, and the constant pose of all others, worked out by hand."""

import json
from dataclasses import replace

import numpy as np
import pytest
from rigs import PERSON, at_rest, below_a_root, rig_of, with_offsets
from scipy.spatial.transform import Rotation

from gesturekit.errors import MotionError
from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.model_joints import ModelJoints, first_moving_joint

# A still stage and a still lift carry a body of three joints; the flag hangs beside it.
STAGE = Skeleton(
    ("stage", "lift", "body", "arm", "hand", "flag"),
    (-1, 0, 1, 2, 3, 1),
    np.array([[9, 9, 9], [0, 1, 0], [0, 0, 0.5], [0, 1, 0], [0, 1, 0], [1, 0, 0]], dtype=float),
)
TURNS = {"stage": (0.0, 0.5, 0.0), "lift": (0.3, 0.0, 0.0), "flag": (0.0, 0.0, 1.0)}


def on_stage(n_frames: int = 5, place: tuple[float, ...] = (4.0, 0.0, -1.0)) -> Motion:
    """The body swings its arm; what carries it is turned, and stands."""
    motion = at_rest(STAGE, n_frames, place)
    for name, turn in TURNS.items():
        motion.rotations[:, STAGE.index(name)] = Rotation.from_rotvec(turn).as_quat()
    angles = np.linspace(0, 0.4, n_frames)
    for name in ("body", "arm"):
        swing = Rotation.from_rotvec(np.outer(angles, [1.0, 0, 0])).as_quat()
        motion.rotations[:, STAGE.index(name)] = swing
    return motion


def fitted(*motions: Motion, joints="all") -> ModelJoints:
    return ModelJoints(**ModelJoints.fit_fields(motions, joints))


def test_joints_are_those_at_and_below_the_first_that_moves():
    assert fitted(on_stage()).joints == ("body", "arm", "hand")
    assert fitted(on_stage(), joints=["hand", "flag"]).joints == ("body", "hand")
    assert fitted(on_stage(), joints=[]).joints == ("body",)
    person = at_rest(below_a_root(rig_of(PERSON), 0.9), 3)
    person.rotations[1, 1] = [1, 0, 0, 0]
    body = fitted(person, joints="body")
    assert body.joints == tuple(PERSON) and (body.root, body.indices[-1]) == (1, len(PERSON))
    for wrong, says in (("bodies", r"(?=.*'bodies').*\bbody\b"), (["head"], "(?=.*'head').*hand")):
        with pytest.raises(MotionError, match=says):
            fitted(on_stage(), joints=wrong)
    with pytest.raises(MotionError, match="motion"):
        fitted()


def test_what_is_not_modelled_has_its_mean_over_all_frames():
    """A flag that turns about z by 0.2 rad in 4 frames and by 0.8 rad in 12 others, of either sign:
    the mean quaternion is at 2 a = atan2(sum sin 2a, sum cos 2a), a near 0.65 rad. It hangs at its
    rest place for 4 frames, and at x = 2 for 12.
    """
    still, other = on_stage(4), on_stage(12)
    for motion, angle in ((still, 0.2), (other, 0.8)):
        motion.rotations[:, 5] = Rotation.from_rotvec([0, 0, angle]).as_quat()
    other.rotations[::2, 5] *= -1
    other = replace(other, joint_translations={"flag": np.tile([2.0, 0, 0], (12, 1))})
    model = fitted(still, other, joints=["arm"])
    angle = np.arctan2(4 * np.sin(0.2) + 12 * np.sin(0.8), 4 * np.cos(0.2) + 12 * np.cos(0.8))
    found = Rotation.from_quat(model.fixed_rotations[5]).as_rotvec()
    assert found == pytest.approx([0, 0, angle], abs=1e-9)
    assert model.fixed_translations.keys() == {"flag"}
    assert model.fixed_translations["flag"] == pytest.approx([(4 * 1 + 12 * 2) / 16, 0, 0])
    assert (model.fixed_pose(3) == model.fixed_rotations).all() and len(model.fixed_pose(3)) == 3


@pytest.mark.parametrize("moved", [{}, {"lift": (0.0, 3.0, 0.2)}])
def test_a_motion_is_assembled_below_joints_that_stand(moved):
    """The model's root is where and how it is wanted in the world, and its bones hang on it."""
    source = on_stage(place=(0.0, 0.0, 0.0))
    moving = {name: np.tile(place, (5, 1)) for name, place in moved.items()}
    source = replace(source, joint_translations=moving)
    model = fitted(source)
    world = Rotation.from_euler("xyz", np.random.default_rng(0).normal(size=(5, 3)))
    place = np.random.default_rng(1).normal(size=(5, 3))
    rotations = model.fixed_pose(5)
    rotations[:, 2] = world.as_quat()
    given = rotations.copy()
    made = model.assemble(rotations, place, 30.0)
    np.testing.assert_array_equal(rotations, given)
    np.testing.assert_allclose(made.positions()[:, 2], place, atol=1e-9)
    np.testing.assert_allclose(made.positions()[:, 3] - place, world.apply([0, 1, 0]), atol=1e-9)
    for joint in (0, 1, 5):  # those above and beside it are as in the source
        np.testing.assert_allclose(made.rotations[:, joint], source.rotations[:, joint], atol=1e-9)
        np.testing.assert_allclose(
            made.positions()[:, joint], source.positions()[:, joint], atol=1e-9
        )
    longer = with_offsets(STAGE, arm=(0.0, 1.5, 0.0))
    made = model.assemble(rotations, place, 30.0, longer)
    np.testing.assert_allclose(made.positions()[:, 3] - place, world.apply([0, 1.5, 0]), atol=1e-9)
    assert made.skeleton is longer and made.fps == 30.0


def test_a_model_is_read_as_it_was_written():
    moving = {"flag": np.tile([2.0, 0, 0], (5, 1))}
    model = fitted(replace(on_stage(), joint_translations=moving))
    values = json.loads(json.dumps(model.to_json()))
    again = ModelJoints(**ModelJoints.fields_from_json(STAGE, values))
    assert (again.joints, again.scale) == (model.joints, model.scale)
    np.testing.assert_array_equal(again.fixed_rotations, model.fixed_rotations)
    assert again.fixed_translations["flag"].tolist() == [2, 0, 0]
    assert ModelJoints.fields_from_json(STAGE, values | {"scale": 1e6})["scale"] == 1e6


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"scale": 0.0}, "scale"),
        ({"joints": ["body", "arm", "body"]}, "(?=.*joints).*twice"),
        ({"joints": ["leg"]}, "'leg'"),
        ({"fixed_rotations": [[0, 0, 0, 1]] * 5}, r"(?=.*fixed_rotations.*\(5, 4\)).*\(6, 4\)"),
        ({"fixed_rotations": [[0, 0, 0, float("nan")]] * 6}, "fixed_rotations"),
        ({"fixed_translations": {"leg": [0, 1, 0]}}, "'leg'"),
    ],
)
def test_models_of_other_rigs_and_wrong_numbers_are_refused(change, says):
    values = fitted(on_stage()).to_json() | change
    with pytest.raises(MotionError, match=says):
        ModelJoints.fields_from_json(STAGE, values)


@pytest.mark.parametrize(
    ("moving", "root"),
    [
        (["hand"], "hand"),
        (["arm", "hand"], "arm"),
        (["hand", "flag"], "lift"),
        (["flag"], "flag"),
        ([], "stage"),
    ],
)
def test_the_root_is_the_lowest_joint_above_all_that_move(moving, root):
    motion = at_rest(STAGE, 4)
    for name in moving:
        swing = Rotation.from_rotvec(np.outer(np.arange(4), [0.1, 0, 0])).as_quat()
        motion.rotations[:, STAGE.index(name)] = swing
    assert STAGE.names[first_moving_joint([at_rest(STAGE, 2), motion])] == root
