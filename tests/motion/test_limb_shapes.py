"""Limbs of a nameless stick figure, found by shape or refused, at limits worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rigs import PERSON, Bones, rig_of, with_offsets

from gesturekit.errors import MotionError
from gesturekit.motion import Skeleton
from gesturekit.motion.parts import find_parts
from gesturekit.motion.parts.limb_shapes import find_limbs

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
REACH = 0.1 + 0.42 + 0.4 + np.hypot(0.05, 0.14)
"""Metres from the pelvis to the toes; to the head are 0.7 m, to the hands 1.19 m."""
REACH = max(REACH, 0.5 + 0.15 + 0.29 + 0.25)
SHANKS = dict.fromkeys(("l1", "l2"), (np.array([0.0, -0.4, 0.0]),))
TIPS = {"head": (np.array([0.0, 0.15, 0.0]),)}


def test_limbs_of_a_thousand_bones_are_compared_without_recursion():
    """Two chains of one shape, which begin at the root: a pair of limbs, but not of a person's."""
    parents = [-1, 0, 0, *(j - 2 for j in range(3, 1999))]
    offsets = [[0, 0, 0], [0.1, 0, 0], [-0.1, 0, 0], *[[0, -0.1, 0]] * 1996]
    names = tuple(f"n{j}" for j in range(len(parents)))
    with pytest.raises(MotionError, match="1 pair of limbs of equal length, not 2"):
        find_limbs(Skeleton(names, tuple(parents), np.array(offsets)))


def figure(tips: dict | None = None, **offsets: tuple[float, float, float]) -> Skeleton:
    """The figure with other offsets; those of a name without a number are mirrored."""
    both = {}
    for name, (x, y, z) in offsets.items():
        both |= {name: (x, y, z)} if name in FIGURE else {f"{name}1": (x, y, z)}
        both |= {} if name in FIGURE else {f"{name}2": (-x, y, z)}
    return with_offsets(rig_of(FIGURE, end_sites=TIPS | (tips or {})), **both)


def hands(length: float) -> dict:
    return {f"c{n}": (np.array([x * length, 0, 0]),) for n, x in ((1, 1), (2, -1))}


def test_sides_limbs_and_head_of_a_figure():
    found = find_limbs(figure())
    names = {part: tuple(FIGURE)[joint] for part, joint in found.joints.items()}
    limbs = {"shoulder": "a", "elbow": "b", "wrist": "c", "hip": "k", "knee": "l", "ankle": "m"}
    limbs |= {"toe": "n"}
    assert names == {
        f"{side}_{part}": f"{joint}{number}"
        for side, number in (("left", 1), ("right", 2))
        for part, joint in limbs.items()
    }
    assert tuple(FIGURE)[found.head] == "head"
    pairs = {(tuple(FIGURE)[a], tuple(FIGURE)[b]) for a, b in found.pairs}
    assert {frozenset(pair) for pair in pairs} == {frozenset((f"{c}1", f"{c}2")) for c in "abcklmn"}
    # A sole that goes back from the ball of the foot, but not as far as the ankle, points ahead.
    soles = {f"o{n}": (f"n{n}", (0.0, 0.0, -0.1)) for n in "12"}
    assert find_limbs(without(**soles)).joints == found.joints
    # Feet that point to -Z exchange left and right.
    turned = find_limbs(figure(n=(0.0, -0.05, -0.14))).joints
    assert {tuple(FIGURE)[turned[f"left_{part}"]] for part in limbs} == {
        f"{c}2" for c in limbs.values()
    }


@pytest.mark.parametrize(
    ("rig", "says"),
    [
        # Left and right bones may differ by 15 % of the longer one and 0.7 % of the reach.
        (figure(b1=(0.29 - 0.0435 - 0.0082, 0.0, 0.0)), ""),
        (figure(b1=(0.29 - 0.0435 - 0.0085, 0.0, 0.0)), "1 pair of limbs of equal length, not 2"),
        (figure(k1=(0.1, -0.05, 0.0)), ""),
        # The two long bones are 1.3 times as long as any other, and 1.69 times each other at most.
        (figure(hands(0.192)), ""),
        (figure(hands(0.193)), "no two bones of the limb at 'a1' are clearly the longest"),
        (figure(c=(0.172, 0.0, 0.0)), ""),
        (figure(c=(0.171, 0.0, 0.0)), "the limb at 'a1' has one long bone, not two"),
        # Feet together go forward by 3.5 % of the reach, the longest way from the root.
        (figure(n=(0.0, -0.05, 0.0176 * REACH)), ""),
        (figure(n=(0.0, -0.05, 0.0174 * REACH)), "its feet do not show which way is forward"),
        # From the ankles to the chest and along the trunk: a cosine of 0.7.
        (figure(l=(0.0, -0.15, 0.39), m=(0.0, -0.15, 0.37)), ""),
        (figure(l=(0.0, -0.11, 0.4), m=(0.0, -0.11, 0.38)), "legs do not lie opposite its trunk"),
        # Hips that are more before than beside each other: a cosine of 0.5 to the side.
        (figure(k1=(0.06, 0.0, 0.1), k2=(-0.06, 0.0, -0.1)), ""),
        (figure(k1=(0.055, 0.0, 0.1), k2=(-0.055, 0.0, -0.1)), "do not lie to its left and right"),
        (figure(a1=(0.06, 0.0, 0.1), a2=(-0.06, 0.0, -0.1)), ""),
        (figure(a1=(0.055, 0.0, 0.1), a2=(-0.055, 0.0, -0.1)), "do not lie to its left and right"),
    ],
)
def test_shapes_are_accepted_up_to_their_limits(rig, says):
    for size in (1.0, 100.0):
        if not says:
            assert len(find_limbs(rig.scaled(size)).joints) == 14
            continue
        with pytest.raises(MotionError, match=says):
            find_limbs(rig.scaled(size))


def without(*names: str, **more: tuple[str, tuple[float, float, float]]) -> Skeleton:
    rows = {k: v for k, v in FIGURE.items() if k not in names} | more
    return rig_of(rows, end_sites=TIPS if "head" in rows else {})


@pytest.mark.parametrize(
    ("rig", "says"),
    [
        (without(*(f"{c}{n}" for c in "lmn" for n in "12"), k1=("pelvis", (0.1, -0.9, 0)),
                 k2=("pelvis", (-0.1, -0.9, 0))), "the limb at 'k1' has fewer than two bones"),
        (replace(without("n1", "n2", "m1", "m2"), end_sites=TIPS | SHANKS), "legs have no ankles"),
        (without("n1", "n2"), "its feet do not show"),
        (without(*(f"{c}1" for c in "klmn")), "1 pair of limbs"),
        (without(prop=("c1", (0.05, 0, 0))), "1 pair of limbs"),
        (without(a3=("chest", (0, 0, 0.15)), b3=("a3", (0, 0, 0.29)), c3=("b3", (0, 0, 0.25))),
         "more than two limbs of equal length on 'chest'"),
    ],
)  # fmt: skip
def test_shapes_that_lack_something_or_have_too_much_are_refused(rig, says):
    with pytest.raises(MotionError, match=says):
        find_limbs(rig)


def test_limbs_on_two_trunks_are_refused():
    rows = {"root": (None, (0.0, 1.0, 0.0))} | FIGURE | {"pelvis": ("root", (0.0, 0.0, 0.05))}
    rows["chest"] = ("root", (0.0, 0.5, 0.0))
    with pytest.raises(MotionError, match="are not attached to one trunk"):
        find_limbs(rig_of(rows, end_sites=TIPS))


def head_of(rig: Skeleton) -> str | None:
    head = find_limbs(rig).head
    return None if head is None else rig.names[head]


def test_the_head_is_below_its_face_or_its_top():
    assert head_of(without("neck", "head")) is None
    assert head_of(without(prop=("chest", (0.0, 0.05, 0.05)))) == "head"  # not on the longest way
    assert head_of(figure({"head": ()})) == "head"  # no farther from the neck than that from chest
    # The last joint is farther from the one before it than that from its own, and ends in a point.
    top = figure(head=(0.0, 0.11, 0.0), tips={"head": ()})
    assert head_of(top) == "neck"
    assert head_of(figure(head=(0.0, 0.09, 0.0), tips={"head": ()})) == "head"
    for length, head in ((0.0069, "neck"), (0.0071, "head")):
        tip = {"head": (np.array([0.0, length * REACH, 0.0]),)}
        assert head_of(figure(tip, head=(0.0, 0.11, 0.0))) == head
    face = without(eye=("neck", (0.03, 0.1, 0.1)), jaw=("neck", (0.0, 0.02, 0.1)))
    assert head_of(face) == "neck"
    assert head_of(without("head", "neck", only=("chest", (0.0, 0.3, 0.0)))) == "only"


def guessed(rig: Skeleton):
    """The parts of a person one of whose joints was named by hand, so that sides are checked."""
    return find_parts(rig, {"left_knee": "LeftLeg"})


def person(**offsets: tuple[float, float, float]) -> Skeleton:
    toes = {f"{s}ToeBase": (f"{s}Foot", (0.0, -0.05, 0.14)) for s in ("Left", "Right")}
    both = {}
    for name, (x, y, z) in offsets.items():
        if f"Left{name}" in PERSON | toes:
            both |= {f"Left{name}": (x, y, z), f"Right{name}": (-x, y, z)}
        else:
            both[name] = (x, y, z)
    return with_offsets(rig_of(PERSON | toes), **both)


@pytest.mark.parametrize(
    ("rig", "says"),
    [
        # Bones of a limb differ by a factor of 3.5 at most, limbs of either side by 1.6.
        (person(Foot=(0.0, -0.121, 0.0)), ""),
        (person(Foot=(0.0, -0.119, 0.0)), "bones of 0.42 and 0.12 m"),
        (person(Hand=(0.081, 0.0, 0.0)), ""),
        (person(Hand=(0.079, 0.0, 0.0)), "bones of 0.28 and 0.08 m"),
        (person(LeftFoot=(0.0, -0.923, 0.0)), ""),
        (
            person(LeftFoot=(0.0, -0.925, 0.0)),
            "left leg would be 1.3[45] m long, the right one 0.84",
        ),
        (person(RightHand=(-0.567, 0.0, 0.0)), ""),
        (person(RightHand=(-0.569, 0.0, 0.0)), "left arm would be 0.53 m long, the right one 0.85"),
        # Both toes point back by more than a sine of 0.3.
        (person(ToeBase=(0.0, -0.095, -0.029)), ""),
        (person(ToeBase=(0.0, -0.095, -0.031)), "toes point backwards"),
        (person(LeftToeBase=(0.0, -0.05, -0.14)), ""),
        # Legs that do not lie opposite the trunk tell nothing: a cosine of 0.7.
        (person(ToeBase=(0, 0, -0.14), Leg=(0, -0.29, 0.304), Foot=(0, -0.29, 0.304)), ""),
        (
            person(ToeBase=(0, 0, -0.14), Leg=(0, -0.3, 0.294), Foot=(0, -0.3, 0.294)),
            "toes point backwards",
        ),
    ],
)
def test_named_limbs_are_checked_up_to_their_limits(rig, says):
    for size in (1.0, 100.0):
        if not says:
            assert guessed(rig.scaled(size)).legs["left"].knee == "LeftLeg"
            continue
        scaled = says if size == 1 or "m" not in says else says.split(" ")[0]
        with pytest.raises(MotionError, match=scaled):
            guessed(rig.scaled(size))
