"""Units and axes of files: found, told, and settable."""

from dataclasses import replace

import numpy as np
import pytest
from rigs import PERSON, at_rest, rig_of, turned_at_root
from scipy.spatial.transform import Rotation

from gesturekit.formats import read_bvh
from gesturekit.formats.conventions import (
    AXES,
    METRES,
    FileAxes,
    file_axes,
    rotation_to_y_up,
    standing_axis,
    turn_axes,
)
from gesturekit.motion.root_path import heading
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


def same_places(one, two, atol=1e-5):
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
    np.testing.assert_allclose(motion.skeleton.offsets[order], expected, atol=1e-5)
    same_places(read_bvh(path, up=up, forward=forward), facing_z)


@pytest.mark.parametrize(("up", "forward"), [("y", "x"), ("y", "-z"), ("z", "-y"), ("z", "x")])
def test_a_quadruped_faces_from_tail_to_head(quadruped, tmp_path, save_as_others, up, forward):
    motion = in_axes(at_rest(quadruped, 30, [0.0, 0.75, 0.0]), up, forward)
    save_as_others(motion, tmp_path / "dog.bvh")
    read = read_bvh(tmp_path / "dog.bvh", unit="cm")
    assert (read.info["up"], read.info["forward"]) == (up, forward)
    assert "forward" not in read.info["guessed"] and heading(read) == pytest.approx(0, abs=1e-4)
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


@pytest.mark.parametrize("unit", sorted(METRES))
@pytest.mark.parametrize("size", [0.75, 1.0, 1.2])
def test_units_are_told_from_the_size_of_the_body(facing_z, tmp_path, unit, size, save_as_others):
    scaled = facing_z.scaled(size)
    save_as_others(scaled, tmp_path / "a.bvh", unit=unit)
    motion = read_bvh(tmp_path / "a.bvh")
    assert (motion.info["unit"], motion.info["guessed"]) == (unit, ())
    same_places(motion, scaled)


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


@pytest.mark.parametrize(
    ("lying", "height", "axis"), [(4, 0.0, "y"), (5, 0.0, None), (8, 0.0, "z"), (8, 0.5, None)]
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


@pytest.mark.parametrize(("up", "forward"), [("y", "z"), ("-z", "x")])
def test_a_body_without_legs_shows_its_axes_by_trunk_and_arms(up, forward):
    upper = {name: bone for name, bone in PERSON.items() if not name.endswith(("Leg", "Foot"))}
    motion = in_axes(at_rest(rig_of(upper), 3, (0, 0.94, 0)), up, forward)
    assert file_axes(motion) == FileAxes(up, forward)
