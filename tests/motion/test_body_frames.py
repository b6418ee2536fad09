"""Anatomical frames of a rig at rest, worked out by hand: feet, hands and lengths of limbs."""

from dataclasses import replace

import numpy as np
import pytest
from rigs import at_rest, with_offsets

from gesturekit.motion import Skeleton
from gesturekit.motion.retarget.body_frames import BodyFrames

FOOT = 0.15


def frames_of(rig: Skeleton) -> BodyFrames:
    return BodyFrames(rig, at_rest(rig, 1).rotations[0])


def with_feet(rig: Skeleton, bone: tuple[float, float, float]) -> Skeleton:
    return with_offsets(rig, LeftToeBase=bone, RightToeBase=bone)


def with_soles(rig: Skeleton, bone: tuple[float, float, float]) -> Skeleton:
    """The rig whose feet end in an end site instead of a toe joint."""
    kept = at_rest(rig, 1).keep([name for name in rig.names if "Toe" not in name]).skeleton
    ends = dict.fromkeys(("LeftFoot", "RightFoot"), (np.array(bone),))
    return replace(kept, end_sites=ends)


@pytest.mark.parametrize("size", [1.0, 30.0])
@pytest.mark.parametrize("build", [with_feet, with_soles])
@pytest.mark.parametrize(
    ("pitch", "least", "most"),
    [(-5, 15, 40), (0, 15, 40), (20, 19.9, 20.1), (50, 49.9, 50.1), (80, 15, 40)],
)
def test_a_foot_drawn_level_or_pointing_down_stands_as_most_do(
    person, build, pitch, least, most, size
):
    """A slope from ankle to toes that a level foot may have is taken as drawn."""
    slope = np.radians(pitch)
    rig = build(person, (0.0, -FOOT * np.sin(slope), FOOT * np.cos(slope))).scaled(size)
    for side in ("left", "right"):
        ankle, toes = frames_of(rig).foot_heights(side)
        assert least < np.degrees(np.arcsin(ankle / (size * FOOT))) < most
        assert toes == pytest.approx(0)


def test_legs_are_measured_along_their_bones_and_estimated_without(person):
    uneven = with_offsets(person, LeftLeg=(0.0, -0.32, 0.24), RightFoot=(0.0, -0.4, 0.0))
    frames = frames_of(uneven)
    assert frames.leg_lengths() == pytest.approx({"left": 0.8, "right": 0.82})
    assert frames.leg_length() == pytest.approx(0.81)
    legs = ("Leg", "Foot", "Toe")
    bust = [name for name in person.names if not any(word in name for word in legs)]
    frames = frames_of(at_rest(person, 1).keep(bust).skeleton)
    assert frames.leg_length() == pytest.approx(0.82, rel=0.1), "those that were removed"
