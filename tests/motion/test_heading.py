"""Heading and side axis of bodies with hips, with shoulders alone, and without either."""

import numpy as np
import pytest
from rigs import PERSON, at_rest, rig_of, with_offsets
from scipy.spatial.transform import Rotation

from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.root_path import heading, side_axis

RIG = rig_of(PERSON)
POST = Skeleton(("post", "tip"), (-1, 0), np.array([[0, 0, 0], [0, 1.0, 0]]))


def turned(motion: Motion, *turns: Rotation) -> Motion:
    """The motion whose root turns by one rotation a frame."""
    motion.rotations[:, 0] = [turn.as_quat() for turn in turns]
    return motion


def about(axis: str, degrees: float) -> Rotation:
    return Rotation.from_euler(axis, degrees, degrees=True)


@pytest.mark.parametrize("kept", [RIG.names, [n for n in RIG.names if "Leg" not in n]])
@pytest.mark.parametrize("degrees", [0.0, 30.0, -100.0, 170.0])
def test_a_body_faces_away_from_the_line_of_its_hips_or_shoulders(kept, degrees):
    kept = [name for name in kept if "Foot" not in name or len(kept) == RIG.n_joints]
    motion = at_rest(RIG, 1).keep(kept)
    assert np.degrees(heading(turned(motion, about("y", degrees)))) == pytest.approx(degrees)
    # Leaning forward or aside by less than a right angle changes nothing.
    for lean in (about("x", 50), about("z", 50)):
        leaning = turned(motion, about("y", degrees) * lean)
        assert np.degrees(heading(leaning)) == pytest.approx(degrees)


def test_the_heading_of_a_motion_is_that_of_its_mean_side():
    """Mean side of 0, 0 and 90 degrees: atan(1 / 2)."""
    motion = turned(at_rest(RIG, 3), about("y", 0), about("y", 0), about("y", 90))
    assert heading(motion) == pytest.approx(np.arctan2(1, 2))
    assert heading(turned(at_rest(POST, 1), about("y", 90))) == 0.0


@pytest.mark.parametrize("legs", [True, False])
def test_the_side_axis_is_the_line_of_the_hips_in_the_frame_of_the_root(legs):
    """One hip 0.1 m before the other: the side lies atan(0.1 / 0.2) about Y from +X."""
    name = "LeftUpLeg" if legs else "LeftShoulder"
    rig = with_offsets(RIG, **{name: (0.1 if legs else 0.05, -0.05 if legs else 0.15, 0.1)})
    rows = rig.names if legs else [n for n in RIG.names if "Leg" not in n and "Foot" not in n]
    motions = [at_rest(rig, 2).keep(rows) for _ in range(2)]
    motions[1] = turned(motions[1], about("y", 70), about("x", 40))
    width = 0.2 if legs else 0.34
    expected = np.array([width, 0, 0.1]) / np.hypot(width, 0.1)
    assert side_axis(motions, 0) == pytest.approx(expected)
    assert np.linalg.norm(side_axis(motions, 0)) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("turn", "side"),
    [
        (about("y", 80), [1, 0, 0]),
        # z points up: x and y are level, and the first counts.
        (about("x", 90), [1, 0, 0]),
        # x points up: the most level axis is y or z.
        (about("z", 90), [0, 1, 0]),
        # x is nearly upright, or not.
        (about("z", 80), [0, 0, 1]),
        (about("z", 40), [1, 0, 0]),
    ],
)
def test_a_rig_without_sides_has_its_x_axis_or_the_most_level_one(turn, side):
    motion = turned(at_rest(POST, 2), turn, about("y", 40) * turn)
    assert side_axis([motion, motion], 0).tolist() == side
