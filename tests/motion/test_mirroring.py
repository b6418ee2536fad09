from dataclasses import replace

import numpy as np
import pytest
from recordings import RECORDED
from rigs import numbered, with_offsets

from gesturekit.errors import MotionError
from gesturekit.motion import Motion
from gesturekit.motion.parts import left_right_pairs
from gesturekit.motion.rotations import rotation_angles

MIRROR = np.array([-1.0, 1.0, 1.0])


def check(motion: Motion) -> None:
    mirrored, rig = motion.mirror(), motion.skeleton
    to_other = dict(left_right_pairs(rig))
    to_other |= {right: left for left, right in to_other.items()}
    other = [rig.index(to_other.get(name, name)) for name in rig.names]
    found = mirrored.positions()[:, other]
    np.testing.assert_allclose(found, motion.positions() * MIRROR, atol=1e-9)
    ends, seen = motion.end_positions(), mirrored.end_positions()
    for name, places in ends.items():
        name = motion.skeleton.names[other[motion.skeleton.index(name)]]
        np.testing.assert_allclose(seen[name], places * MIRROR, atol=1e-9)
    twice = mirrored.mirror()
    np.testing.assert_allclose(twice.positions(), motion.positions(), atol=1e-9)
    assert rotation_angles(twice.rotations, motion.rotations).max() < 1e-7


def test_every_joint_lies_where_the_mirror_shows_its_counterpart(moving_person):
    check(moving_person)
    path = 0.1 * np.random.default_rng(0).normal(size=(60, 3))
    check(replace(moving_person, joint_translations={"LeftArm": path, "Spine": 2 * path}))


@pytest.mark.parametrize("file", [*RECORDED, "motion/bandai/dataset-1_bow_feminine_001.bvh"])
def test_real_rigs(shared_data, file):
    check(Motion.load(shared_data / file)[:100])


def test_a_rig_with_meaningless_names_is_mirrored_by_its_shape(moving_person):
    expected = moving_person.mirror()
    mirrored = replace(moving_person, skeleton=numbered(moving_person.skeleton)).mirror()
    np.testing.assert_allclose(mirrored.positions(), expected.positions(), atol=1e-9)
    np.testing.assert_allclose(mirrored.rotations, expected.rotations, atol=1e-9)


def test_a_rig_without_sides_is_refused(moving_person):
    """No name tells a side, and feet that point nowhere leave the shape without one."""
    down = (0.0, -0.1, 0.0)
    rig = numbered(with_offsets(moving_person.skeleton, LeftToeBase=down, RightToeBase=down))
    motion = replace(moving_person, skeleton=replace(rig, end_sites={}))
    with pytest.raises(MotionError, match="(?=.*left)(?=.*right).*parts"):
        motion.mirror()
