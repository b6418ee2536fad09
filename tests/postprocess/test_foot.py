"""Heel, ball and sole of feet on rigs that mark them in different ways."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gesturekit import Skeleton
from gesturekit.postprocess.foot import Anchor, Foot, find_feet

TOE, TIP = (0.0, -0.05, 0.14), (0.0, 0.0, 0.06)
HEEL, BIG, SMALL = (0.0, -0.06, -0.05), (0.02, -0.01, 0.05), (-0.03, -0.01, 0.04)


def with_joints(skeleton: Skeleton, joints: dict[str, tuple[str, tuple]], **ends) -> Skeleton:
    """The rig with more joints on either foot, {name: (parent, offset)} without their side."""
    rows = {
        f"{side}{n}": (f"{side}{p}", o)
        for side in ("Left", "Right")
        for n, (p, o) in joints.items()
    }
    names = (*skeleton.names, *rows)
    sites = {
        f"{side}{n}": tuple(map(np.array, s)) for side in ("Left", "Right") for n, s in ends.items()
    }
    return Skeleton(
        names,
        (*skeleton.parents, *(names.index(parent) for parent, _ in rows.values())),
        np.concatenate([skeleton.offsets, [o for _, o in rows.values()]])
        if rows
        else skeleton.offsets,
        end_sites=sites,
    )


def points(rig: Skeleton, found) -> list[tuple[str, tuple]]:
    return [(rig.names[joint], tuple(np.round(offset, 9).tolist())) for joint, offset in found]


def anchor(rig: Skeleton, found: Anchor | None):
    if found is None:
        return None
    return (*points(rig, [(found.joint, found.offset)])[0], tuple(sorted(found.columns)))


NONE = (0.0, 0.0, 0.0)
CASES = {
    "ankles alone": ({}, {}, ("Foot", NONE, (0,)), None, [("Foot", NONE)], 0),
    "an end site of the foot": (
        {},
        {"Foot": [TOE]},
        ("Foot", NONE, (0,)),
        ("Foot", TOE, (1,)),
        [("Foot", NONE), ("Foot", TOE)],
        0,
    ),
    "toe joints and their tips": (
        {"ToeBase": ("Foot", TOE), "Toe_End": ("ToeBase", TIP)},
        {},
        ("Foot", NONE, (0,)),
        ("ToeBase", NONE, (1,)),
        [("Foot", NONE), ("ToeBase", NONE), ("Toe_End", NONE)],
        2,
    ),
    "toe joints with end sites, and a joint at the heel": (
        {"ToeBase": ("Foot", TOE), "HeelPad": ("Foot", HEEL)},
        {"ToeBase": [TIP]},
        ("Foot", NONE, (0,)),
        ("ToeBase", NONE, (1,)),
        [("Foot", NONE), ("HeelPad", NONE), ("ToeBase", NONE), ("ToeBase", TIP)],
        2,
    ),
    "vertices of a body model": (
        {"ToeBase": ("Foot", TOE)},
        {"ToeBase": [BIG, SMALL], "Foot": [HEEL]},
        ("Foot", HEEL, (2,)),
        ("ToeBase", NONE, (0, 1)),
        [("Foot", HEEL), ("Foot", HEEL), ("ToeBase", NONE), ("ToeBase", BIG), ("ToeBase", SMALL)],
        3,
    ),
    "vertices of a body model on the foot alone": (
        {},
        {"Foot": [(0.05, -0.05, 0.2), HEEL, (-0.03, -0.05, 0.16)]},
        ("Foot", HEEL, (1,)),
        ("Foot", (0.01, -0.05, 0.18), (0, 2)),
        [
            ("Foot", HEEL),
            ("Foot", (0.05, -0.05, 0.2)),
            ("Foot", HEEL),
            ("Foot", (-0.03, -0.05, 0.16)),
        ],
        0,
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_heel_ball_and_sole(skeleton, case):
    joints, ends, heel, ball, sole, n_toes = CASES[case]
    rig = with_joints(replace(skeleton, end_sites={}), joints, **ends)
    n_columns = max(column for own in (heel, ball) if own for column in own[2]) + 1
    for side, foot in zip(("Left", "Right"), find_feet(rig), strict=True):
        first = n_columns if side == "Right" else 0
        for found, expected in ((foot.heel, heel), (foot.ball, ball)):
            if expected is not None:
                name, offset, columns = expected
                expected = (side + name, offset, tuple(first + c for c in columns))
            assert anchor(rig, found) == expected
        assert points(rig, foot.sole) == [(side + name, offset) for name, offset in sole]
        assert foot.n_toes == n_toes
        limb = [rig.names[j] for j in foot.limb]
        assert limb == [f"{side}{part}" for part in ("UpLeg", "Leg", "Foot")]
        below = {f"{side}{name}" for name in joints}
        assert {rig.names[j] for j in foot.joints} == {*limb, *below}


def test_a_foot_with_other_joint_indices_is_the_same_foot(skeleton):
    joints, ends, *_ = CASES["vertices of a body model"]
    rig = with_joints(replace(skeleton, end_sites={}), joints, **ends)
    index = {joint: 100 + joint for joint in range(rig.n_joints)}
    for foot in find_feet(rig):
        other = foot.renumbered(index)
        assert [j - 100 for j in other.limb] == foot.limb
        assert tuple(j - 100 for j in other.joints) == foot.joints
        assert (other.toe, other.n_toes) == (foot.toe + 100, foot.n_toes)
        for own, new in zip(foot.anchors, other.anchors, strict=True):
            assert (new.joint, new.columns) == (own.joint + 100, own.columns)
            assert new.offset is own.offset
        assert [(j - 100, tuple(o)) for j, o in other.sole] == [(j, tuple(o)) for j, o in foot.sole]


def test_points_turn_with_their_joint():
    """A quarter turn about Y takes an offset along +Z to +X."""
    quarter = np.array([0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5)])
    world = np.tile([[0.0, 0.0, 0.0, 1.0], quarter], (3, 1, 1))
    positions = np.tile([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]], (3, 1, 1))
    ahead = np.array([0.0, 0.0, 0.1])
    point = Anchor(1, ahead, (0,))
    expected = np.tile([1.1, 2.0, 3.0], (3, 1))
    np.testing.assert_allclose(point.positions(positions, world), expected, atol=1e-12)
    foot = Foot(0, 0, 0, None, point, None, ((0, ahead), (1, ahead)), 0)
    np.testing.assert_allclose(
        foot.sole_positions(positions, world)[2], [[0, 0, 0.1], [1.1, 2.0, 3.0]], atol=1e-12
    )
