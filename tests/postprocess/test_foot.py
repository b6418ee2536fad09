"""Heel, ball and sole of feet on rigs that mark them in different ways."""

import numpy as np
import pytest
from rigs import PERSON, rig_of

from gesturekit import Skeleton
from gesturekit.postprocess.foot_lock import Anchor, find_feet

TOE, TIP = (0.0, -0.05, 0.14), (0.0, 0.0, 0.06)
HEEL, BIG, SMALL = (0.0, -0.06, -0.05), (0.02, -0.01, 0.05), (-0.03, -0.01, 0.04)


def with_joints(joints: dict[str, tuple[str, tuple]], ends: dict[str, list]) -> Skeleton:
    """A person with more joints on either foot, {name: (parent, offset)} without their side."""
    sides = ("Left", "Right")
    rows = {f"{s}{name}": (f"{s}{above}", o) for s in sides for name, (above, o) in joints.items()}
    sites = {f"{s}{name}": tuple(map(np.array, at)) for s in sides for name, at in ends.items()}
    return rig_of(PERSON | rows, end_sites=sites)


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
        [("Foot", HEEL), ("ToeBase", NONE), ("ToeBase", BIG), ("ToeBase", SMALL)],
        3,
    ),
    "vertices of a body model on the foot alone": (
        {},
        {"Foot": [(0.05, -0.05, 0.2), HEEL, (-0.03, -0.05, 0.16)]},
        ("Foot", HEEL, (1,)),
        ("Foot", (0.01, -0.05, 0.18), (0, 2)),
        [("Foot", p) for p in (HEEL, (0.05, -0.05, 0.2), (-0.03, -0.05, 0.16))],
        0,
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_heel_ball_and_sole(case):
    joints, ends, heel, ball, sole, n_toes = CASES[case]
    rig = with_joints(joints, ends)
    n_columns = max(column for own in (heel, ball) if own for column in own[2]) + 1
    _, legs, feet = find_feet(rig)
    expected_joints = {"Hips"}
    for side, foot in zip(("Left", "Right"), feet, strict=True):
        first = n_columns if side == "Right" else 0
        for found, expected in zip((*foot.anchors, None), (heel, ball)):
            if expected is not None:
                name, offset, columns = expected
                expected = (side + name, offset, tuple(first + c for c in columns))
            assert anchor(legs, found) == expected
        assert set(points(legs, foot.sole)) == {(side + name, offset) for name, offset in sole}
        assert foot.n_toes == n_toes
        limb = [legs.names[j] for j in foot.limb]
        assert limb == [f"{side}{part}" for part in ("UpLeg", "Leg", "Foot")]
        below = {f"{side}{name}" for name in joints}
        expected_joints |= {*limb, *below}
    assert set(legs.names) == expected_joints
