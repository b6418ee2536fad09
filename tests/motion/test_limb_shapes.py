"""Limbs of a nameless stick figure, found by shape or refused, and of a rig with absurd bones."""

import numpy as np
import pytest
from rigs import PERSON, Bones, rig_of, with_offsets

from gesturekit.errors import MotionError
from gesturekit.motion import Skeleton
from gesturekit.motion.parts import find_parts, left_right_pairs

FIGURE: Bones = {
    "pelvis": (None, (0.0, 1.0, 0.0)),
    "chest": ("pelvis", (0.0, 0.5, 0.0)),
    "neck": ("chest", (0.0, 0.1, 0.0)),
    "head": ("neck", (0.0, 0.1, 0.0)),
    **{
        f"{joint}{side}": (parent if parent in ("pelvis", "chest") else f"{parent}{side}", offset)
        for side, x in (("1", 1), ("2", -1))
        for joint, parent, offset in (
            ("a", "chest", (0.15 * x, 0.0, 0.0)),
            ("b", "a", (0.29 * x, 0.0, 0.0)),
            ("c", "b", (0.25 * x, 0.0, 0.0)),
            ("k", "pelvis", (0.1 * x, 0.0, 0.0)),
            ("l", "k", (0.0, -0.42, 0.0)),
            ("m", "l", (0.0, -0.4, 0.0)),
            ("n", "m", (0.0, -0.05, 0.14)),
        )
    },
}
TIPS = {"head": (np.array([0.0, 0.15, 0.0]),)}


def figure(tips: dict | None = None, **offsets: tuple[float, float, float]) -> Skeleton:
    """The figure with other offsets; those of a name without a number are mirrored."""
    both = {}
    for name, (x, y, z) in offsets.items():
        both |= {name: (x, y, z)} if name in FIGURE else {f"{name}1": (x, y, z)}
        both |= {} if name in FIGURE else {f"{name}2": (-x, y, z)}
    return with_offsets(rig_of(FIGURE, end_sites=TIPS | (tips or {})), **both)


def test_sides_limbs_and_head_of_a_figure():
    parts = find_parts(figure())
    assert (parts.head, parts.spine, parts.neck) == ("head", ("chest",), "neck")
    for side, n in (("left", 1), ("right", 2)):
        arm, leg = parts.arms[side], parts.legs[side]
        assert (arm.shoulder, arm.elbow, arm.wrist) == (f"a{n}", f"b{n}", f"c{n}")
        assert (leg.hip, leg.knee, leg.ankle, leg.toe) == tuple(f"{c}{n}" for c in "klmn")
    pairs = {frozenset(pair) for pair in left_right_pairs(figure())}
    assert pairs == {frozenset((f"{c}1", f"{c}2")) for c in "abcklmn"}
    # Feet that point to -Z exchange left and right.
    assert find_parts(figure(n=(0.0, -0.05, -0.14))).legs["left"].knee == "l2"


def without(*names: str, **more: tuple[str, tuple[float, float, float]]) -> Skeleton:
    rows = {name: bone for name, bone in FIGURE.items() if name not in names} | more
    return rig_of(rows, end_sites=TIPS)


HANDS = {f"c{n}": (np.array([x * 0.25, 0, 0]),) for n, x in ((1, 1), (2, -1))}


@pytest.mark.parametrize(
    ("rig", "says"),
    [
        (figure(b1=(0.2, 0.0, 0.0)), r"(?=.*\b1 pair).*\b2"),
        (without(prop=("c1", (0.05, 0, 0))), "1 pair "),
        (without(a3=("chest", (0, 0, 0.15)), b3=("a3", (0, 0, 0.29)), c3=("b3", (0, 0, 0.25))),
         "'chest'"),
        (figure(HANDS), "(?=.*'a1').*longest"),
        (figure(c=(0.12, 0.0, 0.0)), "'a1'.* one "),
        (figure(n=(0.0, -0.05, 0.01)), "feet"),
        (without("n1", "n2"), "feet"),
        (figure(l=(0.0, -0.05, 0.41), m=(0.0, -0.05, 0.39)), "trunk"),
        (figure(k1=(0.03, 0, 0.1), k2=(-0.03, 0, -0.1)), "(?=.*left).*right"),
        (figure(a1=(0.03, 0, 0.1), a2=(-0.03, 0, -0.1)), "(?=.*left).*right"),
    ],
)  # fmt: skip
def test_shapes_of_no_person_are_refused_with_the_reason(rig, says):
    for size in (1.0, 100.0):
        with pytest.raises(MotionError, match=says):
            find_parts(rig.scaled(size))


def person(**offsets: tuple[float, float, float]) -> Skeleton:
    toes = {f"{s}ToeBase": (f"{s}Foot", (0.0, -0.05, 0.14)) for s in ("Left", "Right")}
    both = {}
    for name, (x, y, z) in offsets.items():
        both |= {f"Left{name}": (x, y, z), f"Right{name}": (-x, y, z)}
    return with_offsets(rig_of(PERSON | toes), **both)


@pytest.mark.parametrize(
    ("rig", "says"),
    [
        (person(Foot=(0.0, -0.3, 0.0)), ""),
        (person(Foot=(0.0, -0.06, 0.0)), r"(?=.*'LeftLeg')(?=.*0.42\b).*0.06 m"),
        (person(Hand=(0.04, 0.0, 0.0)), r"(?=.*'LeftForeArm')(?=.*0.28\b).*0.04 m"),
        (with_offsets(person(), LeftFoot=(0.0, -1.1, 0.0)), r"(?=.*left leg)(?=.*1.52 m).*\b0.84"),
        (with_offsets(person(), RightHand=(-0.65, 0.0, 0.0)), r"(?=.*left arm)(?=.*0.53 m).*0.93"),
        (person(ToeBase=(0.0, -0.05, -0.14)), "(?=.*'LeftUpLeg').*toes"),
        (with_offsets(person(), LeftToeBase=(0.0, -0.05, -0.14)), ""),
        # Legs that do not lie opposite the trunk tell nothing.
        (person(ToeBase=(0, 0, -0.14), Leg=(0, -0.2, 0.37), Foot=(0, -0.2, 0.37)), ""),
    ],
)  # fmt: skip
def test_limbs_named_by_hand_are_checked(rig, says):
    by_hand = {"left_knee": "LeftLeg"}
    if not says:
        assert find_parts(rig.with_parts(by_hand)).legs["left"].knee == "LeftLeg"
        return
    with pytest.raises(MotionError, match=says):
        find_parts(rig.with_parts(by_hand))
