from dataclasses import replace

import numpy as np
from rigs import PERSON, rig_of

from gesturekit.motion import Skeleton
from gesturekit.motion.contacts import foot_points
from gesturekit.motion.parts.body_size import real_end_sites
from gesturekit.postprocess.foot_lock import find_feet


def with_ends(skeleton: Skeleton, **ends: tuple[float, float, float]) -> Skeleton:
    return replace(skeleton, end_sites={name: (np.array(end),) for name, end in ends.items()})


def test_ends_of_real_bones_stay(skeleton):
    assert real_end_sites(skeleton).keys() == skeleton.end_sites.keys()


def test_an_end_as_long_as_its_bone_that_points_elsewhere_is_made_up(skeleton):
    # Blender's: the bone to the hand is 0.25 m along x, to the foot 0.42 m down.
    ends = {"LeftHand": (0.0, 0.25, 0.0), "LeftFoot": (0.0, 0.42, 0.0)}
    assert real_end_sites(with_ends(skeleton, **ends)) == {}
    going_on = {"LeftHand": (0.25, 0.0, 0.0)}
    assert real_end_sites(with_ends(skeleton, **going_on)).keys() == {"LeftHand"}


def test_one_vector_at_every_end_is_made_up_where_it_does_not_go_on(skeleton):
    names = ("Head", "LeftHand", "RightHand", "LeftFoot", "RightFoot")
    rig = with_ends(skeleton, **dict.fromkeys(names, (0.0, 0.1, 0.0)))
    assert real_end_sites(rig).keys() == {"Head"}
    # Left and right alone may be alike, as feet are.
    feet = dict.fromkeys(("LeftFoot", "RightFoot"), (0.0, -0.05, 0.1))
    assert real_end_sites(with_ends(skeleton, **feet)).keys() == feet.keys()


def test_ends_as_long_as_a_shin_and_beyond_an_end_joint_are_made_up(skeleton):
    assert real_end_sites(with_ends(skeleton, RightHand=(-0.5, 0.0, 0.0))) == {}
    rig = rig_of(PERSON | {"HeadTop_End": ("Head", (0.0, 0.2, 0.0))})
    assert real_end_sites(with_ends(rig, HeadTop_End=(0.0, 0.05, 0.0))) == {}


def test_made_up_ends_are_no_points_of_a_foot(skeleton):
    up = {"LeftFoot": (0.0, 0.42, 0.0), "RightFoot": (0.0, 0.42, 0.0)}
    rig = with_ends(skeleton, **up)
    assert [point.joint for point in foot_points(rig)] == ["LeftFoot", "RightFoot"]
    assert all(len(foot.sole) == len(foot.anchors) == 1 for foot in find_feet(rig)[2])
