"""Units and axes of files: found, told, and settable."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from rigs import PERSON, at_rest, nameless, rig_of, turned_at_root
from scipy.spatial.transform import Rotation

from gesturekit.errors import FormatError
from gesturekit.formats import read_bvh
from gesturekit.formats.axes import (
    AXES,
    FileAxes,
    file_axes,
    rotation_to_y_up,
    standing_axis,
    turn_axes,
)
from gesturekit.formats.plausibility import METRES
from gesturekit.motion import Motion
from gesturekit.motion.heading import heading
from gesturekit.motion.rotations import invert_quaternions


@pytest.fixture
def facing_z(gesture):
    """Four seconds that stand at +Y and face +Z, away from the origin."""
    motion = gesture(1.0)
    return replace(motion, translation=motion.translation + [0.3, 0.0, -0.2])


def in_axes(motion, up, forward):
    """`motion` as a program whose world and rigs have these axes would export it."""
    back = invert_quaternions(rotation_to_y_up(up, forward))
    return turn_axes(motion, back, back)


def same_places(one, two, atol=1e-7):
    order = [one.skeleton.index(name) for name in two.skeleton.names]
    np.testing.assert_allclose(one.positions()[:, order], two.positions(), atol=atol)


@pytest.mark.parametrize(("up", "forward"), [(u, f) for u in AXES for f in AXES if u[-1] != f[-1]])
def test_any_axes_are_found_and_turned_to_ours(facing_z, tmp_path, up, forward, save_as_others):
    path = tmp_path / "a.bvh"
    save_as_others(in_axes(facing_z, up, forward), path)
    motion = read_bvh(path)
    assert (motion.info["up"], motion.info["forward"]) == (up, forward)
    assert motion.info["guessed"] == ()
    same_places(motion, facing_z)
    # Joints' frames are turned too: the rest pose stands and faces as ours does.
    order = [motion.skeleton.index(name) for name in facing_z.skeleton.names]
    expected = facing_z.skeleton.offsets.copy()
    expected[0] = 0  # the root's OFFSET is written as zero
    np.testing.assert_allclose(motion.skeleton.offsets[order], expected, atol=1e-7)
    same_places(read_bvh(path, up=up, forward=forward), facing_z)


@pytest.mark.parametrize(("up", "forward"), [("y", "x"), ("y", "-z"), ("z", "-y"), ("z", "x")])
def test_a_quadruped_faces_from_tail_to_head(quadruped, tmp_path, save_as_others, up, forward):
    motion = in_axes(at_rest(quadruped, 30, [0.0, 0.75, 0.0]), up, forward)
    save_as_others(motion, tmp_path / "dog.bvh")
    read = read_bvh(tmp_path / "dog.bvh", unit="cm")
    assert (read.info["up"], read.info["forward"]) == (up, forward)
    assert "forward" not in read.info["guessed"] and heading(read) == pytest.approx(0, abs=1e-6)
    head, tail = (read.positions()[0, read.skeleton.index(name)] for name in ("Head", "Tail2"))
    assert head[2] - tail[2] > 1


def test_where_a_body_walks_and_looks_is_left_alone(facing_z, tmp_path, save_as_others):
    about = Rotation.from_euler("y", 170, degrees=True)
    turned = turned_at_root(facing_z, about.as_quat())
    turned = replace(turned, translation=about.apply(facing_z.translation))
    save_as_others(turned, tmp_path / "a.bvh")
    again = read_bvh(tmp_path / "a.bvh")
    assert again.info["forward"] == "z"
    assert abs(np.degrees(heading(again))) > 160
    same_places(again, turned)


def test_a_rig_that_faces_backwards_can_be_kept_so(facing_z, tmp_path, save_as_others):
    backwards = in_axes(facing_z, "y", "-z")
    save_as_others(backwards, tmp_path / "a.bvh")
    same_places(read_bvh(tmp_path / "a.bvh"), facing_z)
    same_places(read_bvh(tmp_path / "a.bvh", forward="z"), backwards)


def test_a_root_that_lays_an_upright_rig_over(facing_z, tmp_path, save_as_others):
    """Rest pose Y up, world Z up: as exported with the armature's turn in the root's channels."""
    to_z = invert_quaternions(rotation_to_y_up("z", "-y"))
    save_as_others(turn_axes(facing_z, to_z, np.array([0.0, 0, 0, 1])), tmp_path / "a.bvh")
    motion = read_bvh(tmp_path / "a.bvh")
    assert motion.info["up"] == "z"
    same_places(motion, facing_z)
    chest = motion.skeleton.index("Chest")
    np.testing.assert_allclose(motion.skeleton.offsets[chest], [0, 0.2, 0], atol=1e-7)


def test_a_body_that_lies_down_is_not_stood_up(facing_z, tmp_path, save_as_others):
    down = Rotation.from_euler("x", 90, degrees=True)  # on the back, the head towards +Z
    lying = turned_at_root(facing_z, down.as_quat())
    lying = replace(lying, translation=facing_z.translation * [1, 0, 1] + [0, 0.15, 0])
    save_as_others(lying, tmp_path / "a.bvh")
    motion = read_bvh(tmp_path / "a.bvh")
    assert (motion.info["up"], motion.info["forward"]) == ("y", "z")
    same_places(motion, lying)


def test_an_implausible_rest_pose_makes_the_axes_a_guess(shared_data):
    motion = read_bvh(shared_data / "motion/bandai/dataset-1_bow_active_001.bvh")
    assert (motion.info["up"], motion.info["forward"]) == ("y", "z")
    assert motion.info["guessed"] == ("forward",)


@pytest.mark.parametrize("unit", sorted(METRES))
@pytest.mark.parametrize("size", [0.75, 1.0, 1.2])
def test_units_are_told_from_the_size_of_the_body(facing_z, tmp_path, unit, size, save_as_others):
    scaled = facing_z.scaled(size)
    save_as_others(scaled, tmp_path / "a.bvh", unit=unit)
    motion = read_bvh(tmp_path / "a.bvh")
    assert (motion.info["unit"], motion.info["guessed"]) == (unit, ())
    same_places(motion, scaled)


def test_a_body_of_no_persons_size_is_a_guess(facing_z, tmp_path, save_as_others):
    giant = replace(facing_z, skeleton=facing_z.skeleton.scaled(3))
    save_as_others(giant, tmp_path / "a.bvh")
    assert read_bvh(tmp_path / "a.bvh").info["guessed"] == ("unit",)
    assert read_bvh(tmp_path / "a.bvh", unit="cm").info["guessed"] == ()


def test_a_rig_of_unknown_parts_is_read_as_it_is(facing_z, tmp_path, save_as_others):
    save_as_others(nameless(facing_z)[0], tmp_path / "a.bvh")
    motion = read_bvh(tmp_path / "a.bvh")
    assert motion.info["unit"] == "cm"
    assert motion.info["guessed"] == ("unit", "up", "forward")
    found = motion.positions()[:, motion.skeleton.index("Joint4")]
    np.testing.assert_allclose(found, facing_z.positions()[:, 4], atol=1e-7)


@pytest.mark.parametrize(
    ("half", "unit"), [(3.9, "m"), (4.1, "cm"), (249.0, "cm"), (251.0, "mm"), (4000.0, "mm")]
)
def test_the_unit_of_a_body_without_known_parts_is_that_of_its_reach(
    tmp_path, half, unit, save_as_others
):
    """Two chains that end `half` ahead and behind; the far joint above them holds no bone.

    Up to 8 it is in metres, up to 500 in centimetres.
    """
    bones = {"world": (None, (0, 0, 0)), "body": ("world", (0, 9e4, 0))}
    for name, z in (("fore", half), ("aft", -half)):
        bones |= {name: ("body", (0, 0, z / 2)), f"{name}_tip": (name, (0, 0, z / 2))}
    save_as_others(at_rest(rig_of(bones), 2), tmp_path / "a.bvh", unit="m")
    motion = read_bvh(tmp_path / "a.bvh")
    assert (motion.info["unit"], "unit" in motion.info["guessed"]) == (unit, True)
    assert motion.skeleton.offsets[2, 2] == pytest.approx(half / 2 * METRES[unit])


def test_axes_that_cannot_be(facing_z, tmp_path, save_as_others):
    save_as_others(facing_z, tmp_path / "a.bvh")
    for options in ({"up": "w"}, {"forward": "+z"}, {"up": "z", "forward": "-z"}):
        with pytest.raises(FormatError, match="axis '"):
            read_bvh(tmp_path / "a.bvh", **options)


TOES = {f"{side}ToeBase": (f"{side}Foot", (0, -0.05, 0.12)) for side in ("Left", "Right")}


@pytest.mark.parametrize(
    ("up", "forward", "found"),
    [
        ("auto", "auto", FileAxes("y", "z")),
        ("y", "auto", FileAxes("y", "z")),
        ("z", "auto", FileAxes("z", "-y", guessed=("forward",))),
        ("-y", "auto", FileAxes("-y", "-z", guessed=("forward",))),
        ("auto", "x", FileAxes("y", "x")),
        ("auto", "-y", FileAxes("z", "-y")),
        ("x", "-z", FileAxes("x", "-z")),
    ],
)
def test_axes_that_are_given_count_more_than_what_is_found(up, forward, found):
    motion = at_rest(rig_of(PERSON | TOES), 3, (0, 0.94, 0))
    assert file_axes(motion, up, forward) == found


def test_a_rest_pose_with_left_and_right_exchanged_shows_no_forward():
    """The toes would point backwards."""
    swap = {"Left": "Right", "Right": "Left"}
    mirrored = {
        re.sub("^(Left|Right)", lambda m: swap[m[0]], name): (
            above and re.sub("^(Left|Right)", lambda m: swap[m[0]], above), offset,
        )
        for name, (above, offset) in (PERSON | TOES).items()
    }  # fmt: skip
    motion = at_rest(rig_of(mirrored), 3, (0, 0.94, 0))
    assert file_axes(motion) == FileAxes("y", "z", guessed=("forward",))


@pytest.mark.parametrize(
    ("lying", "height", "axis"), [(4, 0.0, "y"), (5, 0.0, None), (6, 0.0, "z"), (6, 0.32, None)]
)
def test_a_body_stands_along_the_axis_of_most_frames_if_its_feet_are_on_the_floor(
    lying, height, axis
):
    """Some of ten frames are turned to Z, with the ankles at a height; legs are 0.84 m long."""
    motion = at_rest(rig_of(PERSON), 10, (0, 0.89, 0))
    motion.rotations[:lying, 0] = Rotation.from_euler("x", 90, degrees=True).as_quat()
    motion.translation[:lying] = [0, 0, 0.89 + height]
    assert standing_axis(motion) == axis
    upright = at_rest(rig_of(PERSON), 10, (0, 5.0, 0))
    assert standing_axis(upright) == "y", "as the rest pose shows, whatever the floor"


def test_one_foot_on_the_floor_is_enough_and_one_deep_frame_no_matter():
    """Six of ten frames are turned to Z, the left leg lifted by 60 degrees in all."""
    motion = at_rest(rig_of(PERSON), 10, (0, 0.89, 0))
    lifted = Rotation.from_euler("x", -60, degrees=True).as_quat()
    motion.rotations[:, motion.skeleton.index("LeftUpLeg")] = lifted
    motion.rotations[:6, 0] = Rotation.from_euler("x", 90, degrees=True).as_quat()
    motion.translation[:6] = [0, 0, 0.89]
    motion.translation[0, 2] = -5.0
    assert standing_axis(motion) == "z"


def limb(way: tuple[float, float, float], *names: str) -> dict:
    """Return the joints of a limb of `PERSON` whose bones all go one way."""
    return {name: (PERSON[name][0], way) for name in names}


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        # A person with hanging arms that leans back is no quadruped, whose trunk is level.
        (
            limb((0, -0.28, 0), "LeftForeArm", "LeftHand", "RightForeArm", "RightHand")
            | {"Spine": ("Hips", (0, 0.1, -0.03)), "Chest": ("Spine", (0, 0.2, -0.06))},
            FileAxes("y", "z"),
        ),
        # Hips that are no axis apart, and legs that stand along none.
        (
            {"LeftUpLeg": ("Hips", (0.1, 0, 0.1)), "RightUpLeg": ("Hips", (-0.1, 0, -0.1))},
            FileAxes("y", "z", guessed=("forward",)),
        ),
        (
            limb((0, -0.3, 0.3), "LeftLeg", "LeftFoot", "RightLeg", "RightFoot"),
            FileAxes("y", "z", guessed=("up", "forward")),
        ),
        # Toes straight down, up to a thousandth of their length.
        ({f"{side}ToeBase": (f"{side}Foot", (0, -1.0, -0.0005)) for side in ("Left", "Right")},
         FileAxes("y", "z")),
        ({"LeftToeBase": ("LeftFoot", (0, -0.1, -0.00015))},
         FileAxes("y", "z", guessed=("forward",))),
        ({"LeftToeBase": ("LeftFoot", (0, -10, -0.015))},
         FileAxes("y", "z", guessed=("forward",))),
    ],
)  # fmt: skip
def test_a_rest_pose_shows_its_axes_if_its_parts_agree(changes, found):
    assert file_axes(at_rest(rig_of(PERSON | TOES | changes), 3, (0, 0.94, 0))) == found


UPPER = {name: bone for name, bone in PERSON.items() if not name.endswith(("Leg", "Foot"))}


@pytest.mark.parametrize(("up", "forward"), [("y", "z"), ("-z", "x"), ("x", "-y")])
def test_a_body_without_legs_shows_its_axes_by_trunk_and_arms(up, forward):
    hanging = limb((0, -0.28, 0), "LeftForeArm", "LeftHand", "RightForeArm", "RightHand")
    for bones in (UPPER, UPPER | hanging):
        motion = at_rest(rig_of(bones), 3, (0, 0.94, 0))
        assert file_axes(in_axes(motion, up, forward)) == FileAxes(up, forward)


@pytest.mark.parametrize(
    "changes",
    [
        {"LeftForeArm": ("LeftArm", (-0.28, 0, 0))},
        {"RightForeArm": ("RightArm", (0.28, 0, 0))},
        {"Head": ("Neck", (0, 0, 0.9))},
        {"LeftArm": ("LeftShoulder", (0.1, 0, 0.3)), "RightArm": ("RightShoulder", (-0.1, 0, 0))},
        {"LeftArm": ("LeftShoulder", (0, 0.9, 0)), "RightArm": ("RightShoulder", (0, -0.9, 0))},
    ],
    ids=["left arm", "right arm", "neck", "shoulders askew", "shoulders upright"],
)
def test_a_body_without_legs_whose_parts_disagree_shows_no_forward(changes):
    motion = at_rest(rig_of(UPPER | changes), 3, (0, 0.94, 0))
    assert file_axes(motion) == FileAxes("y", "z", guessed=("forward",))


def test_turned_axes_turn_every_place(skeleton):
    rng = np.random.default_rng(0)
    turns = Rotation.random(4 * skeleton.n_joints, random_state=1).as_quat()
    moving = {"LeftHand": rng.normal(size=(4, 3))}
    motion = Motion(
        skeleton, turns.reshape(4, -1, 4), rng.normal(size=(4, 3)), 30.0, joint_translations=moving
    )
    world, rest = Rotation.random(2, random_state=2)
    found = turn_axes(motion, world.as_quat(), rest.as_quat())
    places = motion.positions()
    expected = world.apply(places.reshape(-1, 3)).reshape(places.shape)
    np.testing.assert_allclose(found.positions(), expected, atol=1e-9)
    for name, ends in motion.end_positions().items():
        expected = world.apply(ends.reshape(-1, 3)).reshape(ends.shape)
        np.testing.assert_allclose(found.end_positions()[name], expected, atol=1e-9)
    np.testing.assert_allclose(found.skeleton.offsets[1:], rest.apply(skeleton.offsets[1:]))
    still = np.array([0.0, 0, 0, 1])
    assert turn_axes(motion, still, still) is motion
    assert turn_axes(motion, world.as_quat(), still) is not motion
