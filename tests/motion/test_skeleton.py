from __future__ import annotations

import json

import numpy as np
import pytest

from gesturekit.errors import MotionError
from gesturekit.motion import Skeleton


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"names": ("a", "b", "b")}, "two joints are called 'b'"),
        ({"parents": (-1, 2, 1)}, "'b'"),
        ({"parents": (-1, -1, 1)}, "second root, 'b'"),
        ({"parents": (0, 0, 1)}, "root"),
        ({"offsets": np.zeros((2, 3))}, "(2, 3)"),
        ({"offsets": np.full((3, 3), np.nan)}, "'a'"),
        ({"end_sites": {"z": (np.zeros(3),)}}, "'z'"),
        ({"rotation_orders": ("ZXY", "ZXY", "ZXZ")}, "'ZXZ'"),
        ({"names": ("a", "b\n", "c")}, "b\\n"),
    ],
)
def test_invalid_skeletons_are_refused(change, says):
    rig = {"names": ("a", "b", "c"), "parents": (-1, 0, 1), "offsets": np.zeros((3, 3))}
    with pytest.raises(MotionError) as caught:
        Skeleton(**rig | change)
    assert says in str(caught.value)


def test_unknown_joint_names_the_nearest(person):
    with pytest.raises(MotionError, match="LeftForeArm"):
        person.index("LeftForearm")


def test_json_round_trip(person):
    again = Skeleton.from_json(json.loads(json.dumps(person.to_json())))
    assert (again.names, again.parents) == (person.names, person.parents)
    assert again.rotation_orders == person.rotation_orders
    np.testing.assert_array_equal(again.offsets, person.offsets)
    np.testing.assert_array_equal(again.end_sites["Head"], person.end_sites["Head"])


@pytest.mark.parametrize(
    "broken",
    [{"format": 2}, {"names": None}, {"offsets": "x"}, {"end_sites": 3}, {"parents": [0.5]}],
)
def test_json_that_is_no_skeleton(person, broken):
    with pytest.raises(MotionError):
        Skeleton.from_json(person.to_json() | broken)


def test_tree(person):
    chest = person.index("Chest")
    assert [person.names[j] for j in person.children(chest)] == ["Neck", "LeftArm", "RightArm"]
    assert [person.names[j] for j in person.ancestors(chest)] == ["Spine", "Hips"]
    below = person.descendants(person.index("LeftArm"))
    assert {person.names[j] for j in below} == {"LeftForeArm", "LeftHand"}
    assert person.depth[chest] == 2
    assert person.is_leaf(person.index("Head")) and not person.is_leaf(chest)
