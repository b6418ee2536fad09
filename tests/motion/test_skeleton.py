import json
from dataclasses import replace

import numpy as np
import pytest

from gesturekit.errors import MotionError
from gesturekit.motion import Skeleton
from gesturekit.motion.skeleton import BodyShape


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"names": ("a", "b", "b")}, "'b'"),
        ({"parents": (-1, -1, 1)}, "(?=.*root).*'b'"),
        ({"parents": (0, 0, 1)}, "root"),
        ({"offsets": np.zeros((2, 3))}, r"(?=.*\(2, 3\)).*\(3, 3\)"),
        ({"offsets": np.full((3, 3), np.nan)}, "joint 0"),
        ({"end_sites": {"z": (np.zeros(3),)}}, "'z'"),
        ({"rotation_orders": ("ZXY", "ZXY", "ZXZ")}, "'ZXZ'"),
        ({"names": ("a", "b\n", "c")}, r"b\\n"),
        ({"names": ("a", "b" * 201, "c")}, r"\b200\b"),
        ({"names": (), "parents": (), "offsets": np.zeros((0, 3))}, "joint"),
        ({"parents": (-1, 0)}, r"(?=.*\b3\b).*\b2\b"),
        ({"parents": (-1, 1, 1)}, r"(?=.*'b').*\b1"),
        ({"parents": (-1, 0, 2)}, r"(?=.*'c').*\b2"),
        ({"names": ("a", " ", "c")}, "' '"),
        ({"offsets": [[0, 0, 0], [0, 0, 0], [0, -1.001e9, 0]]}, "joint 2"),
        ({"end_sites": {"c": (np.array([0, 0, -1.001e9]),)}}, "(?=.*end).*'c'"),
    ],
)
def test_invalid_skeletons_are_refused(change, says):
    rig = {"names": ("a", "b", "c"), "parents": (-1, 0, 1), "offsets": np.zeros((3, 3))}
    with pytest.raises(MotionError, match=says):
        Skeleton(**rig | change)
    assert len(Skeleton(**rig | {"names": ("a", "b" * 200, "c")}).names[1]) == 200


def test_unknown_joint_names_the_nearest(person):
    with pytest.raises(MotionError, match="(?=.*'LeftArn').*LeftArm"):
        person.index("LeftArn")


@pytest.mark.parametrize("factor", [0.0, -1.0, float("inf"), float("nan")])
def test_factors_that_are_no_size_are_refused(person, factor):
    with pytest.raises(MotionError, match=f"factor .*{factor}"):
        person.scaled(factor)


def test_json_round_trip(person):
    again = Skeleton.from_json(json.loads(json.dumps(person.to_json())))
    assert (again.names, again.parents) == (person.names, person.parents)
    assert again.rotation_orders == person.rotation_orders
    np.testing.assert_array_equal(again.offsets, person.offsets)
    np.testing.assert_array_equal(again.end_sites["Head"], person.end_sites["Head"])
    shape = BodyShape((0.5, -1.0), "female")
    orders = ("XYZ", *("YZX",) * (person.n_joints - 1))
    whole = replace(person, parts={"head": "Neck"}, body_shape=shape, rotation_orders=orders)
    again = Skeleton.from_json(json.loads(json.dumps(whole.to_json())))
    assert (again.parts, again.body_shape.to_json()) == ({"head": "Neck"}, shape.to_json())
    assert again.rotation_orders == orders
    fields = ("format", "names", "parents", "offsets")
    least = Skeleton.from_json({name: person.to_json()[name] for name in fields})
    assert (least.end_sites, least.parts, least.body_shape.to_json()) == ({}, {}, {})
    np.testing.assert_array_equal(least.offsets, person.offsets)


@pytest.mark.parametrize(
    ("broken", "says"),
    [
        ({"format": 2}, r"(?=.*format 2).*\b1"),
        ({"names": None}, "read"),
        ({"offsets": "x"}, "(?=.*read).*'x'"),
        ({"end_sites": 3}, "read"),
        ({"parents": [0.5]}, r"(?=.*\b19\b).*\b1\b"),
        ({"names": ["a"] * 19}, "'a'"),
    ],
)
def test_json_that_is_no_skeleton(person, broken, says):
    with pytest.raises(MotionError, match=says):
        Skeleton.from_json(person.to_json() | broken)
    for field in ("names", "parents", "offsets"):
        values = {k: v for k, v in person.to_json().items() if k != field}
        with pytest.raises(MotionError, match=f"'{field}'"):
            Skeleton.from_json(values)
    with pytest.raises(MotionError, match="list"):
        Skeleton.from_json([])


def test_tree(person):
    chest = person.index("Chest")
    assert [person.names[j] for j in person.children(chest)] == ["Neck", "LeftArm", "RightArm"]
    assert [person.names[j] for j in person.ancestors(chest)] == ["Spine", "Hips"]
    below = person.descendants(person.index("LeftArm"))
    assert {person.names[j] for j in below} == {"LeftForeArm", "LeftHand"}
    assert person.depth[chest] == 2
    assert person.common_ancestor(*map(person.index, ("LeftHand", "RightArm", "Neck"))) == chest
    assert person.common_ancestor(chest, person.index("LeftHand")) == chest
