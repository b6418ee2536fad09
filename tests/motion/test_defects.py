from dataclasses import replace

import numpy as np
import pytest
from rigs import PERSON, at_rest, rig_of

from gesturekit.motion import Motion
from gesturekit.motion.defects import find_jumps, find_pops, frozen_runs, jitter_share
from gesturekit.motion.rotations import multiply_quaternions, quaternion_from_rotation_vector


def turned(motion: Motion, joint: str, angles: np.ndarray) -> Motion:
    """A joint turned further about x by (T,) radians."""
    vector = np.stack([angles, 0 * angles, 0 * angles], axis=-1)
    rotations = motion.rotations.copy()
    j = motion.skeleton.index(joint)
    rotations[:, j] = multiply_quaternions(rotations[:, j], quaternion_from_rotation_vector(vector))
    return replace(motion, rotations=rotations)


def test_a_good_motion_has_no_defects(moving_person):
    assert find_jumps(moving_person) is None and find_pops(moving_person) is None
    assert jitter_share(moving_person) == 0 and frozen_runs(moving_person) == []
    for n in (1, 2, 3):
        short = moving_person[:n]
        assert (find_jumps(short), find_pops(short), jitter_share(short)) == (None, None, 0.0)
        assert frozen_runs(short) == []


@pytest.mark.parametrize("fps", [30.0, 120.0])
def test_a_joint_displaced_for_one_frame(moving_person, fps):
    motion = moving_person.resample(fps)
    off = np.zeros(motion.n_frames)
    off[[20, 41]] = [0.5, -0.6]
    pops = find_pops(turned(motion, "LeftForeArm", off))
    assert pops.frames == (20, 41) and pops.joint == "LeftForeArm"
    assert pops.angle == pytest.approx(0.6, abs=0.05)
    places = motion.translation.copy()
    places[30, 0] += 0.2
    pops = find_pops(replace(motion, translation=places))
    assert pops.frames == (30,) and (pops.joint, pops.angle) == ("Hips", 0.0)


def test_fast_human_movement_is_not_a_pop(moving_person):
    times = moving_person.times
    shaken = turned(moving_person, "LeftHand", np.radians(25) * np.sin(2 * np.pi * 5 * times))
    assert find_pops(shaken) is None
    # A turn that is made for good is a jump, not a pop.
    step = np.where(np.arange(60) < 30, 0.0, 1.5)
    assert find_pops(turned(moving_person, "Spine", step)) is None
    assert find_jumps(turned(moving_person, "Spine", step)).frames == (30,)


REFERENCE = rig_of(PERSON).scaled(1.4 / 1.44)
"""A person whose `body_scale` is 1."""


def carried(path: np.ndarray, fps: float = 30.0, size: float = 1.0) -> Motion:
    """Return the person at rest, carried along x by (T,) metres, scaled."""
    motion = at_rest(REFERENCE, len(path), path[:, None] * [1.0, 0, 0], fps)
    return motion.scaled(size)


@pytest.mark.parametrize("size", [1.0, 3.0])
@pytest.mark.parametrize("fps", [30.0, 60.0])
def test_jumps_are_faster_than_people_on_bodies_of_any_size(size, fps):
    for speed in (6, 15):
        step = np.where(np.arange(9) < 4, 0.0, speed / fps)[:, None] * [0.0, 0.6, 0.8]
        still = carried(np.zeros(9), fps)
        found = find_jumps(replace(still, joint_translations={"Head": step}).scaled(size))
        assert (found is None) == (speed == 6)
    assert (found.frames, found.joint) == ((4,), "Head")
    assert found.speed == pytest.approx(15 * size) and found.limit < found.speed


@pytest.mark.parametrize(("fps", "slow", "fast"), [(30.0, 10, 40), (60.0, 2, 15), (24.0, 15, 50)])
def test_a_turn_for_one_frame_is_a_pop_if_nobody_can_turn_so_fast(fps, slow, fast):
    """A person cannot turn by 40 degrees, there and back, in two frames of 30 fps."""
    for degrees in (slow, fast):
        turn = np.radians(degrees) * (np.arange(9) == 4)
        motion = turned(carried(np.zeros(9), fps), "LeftForeArm", turn)
        found = find_pops(motion)
        assert (found is None) == (degrees == slow)
    assert (found.frames, found.joint) == ((4,), "LeftForeArm")
    assert found.angle == pytest.approx(np.radians(fast))
    assert find_pops(motion[3:6]).frames == (1,) and find_pops(motion[4:]) is None


@pytest.mark.parametrize("size", [1.0, 3.0])
def test_jitter_is_trembling_by_millimetres(size):
    """A third of the frames goes to and fro; those at its ends may count or not."""
    third = pytest.approx(1 / 3, abs=0.1)
    for metres, share in ((0.0003, 0.0), (0.003, third)):
        path = np.zeros(60)
        path[20:40] = metres * (-1.0) ** np.arange(20)
        assert jitter_share(carried(path, size=size)) == share
    nods = {"Head": path[:, None] * [0, 0, 1.0]}  # a single joint trembles
    nodding = replace(carried(0 * path), joint_translations=nods).scaled(size)
    assert jitter_share(nodding) == third
    assert jitter_share(carried(path, fps=8.0)) == 0.0, "people move so between few frames"


def test_frozen_runs_last_a_second_in_which_nothing_moves():
    for frames, expected in ((20, []), (40, [(10, 50)])):
        path = 0.01 * np.arange(60.0)
        path[10 : 10 + frames] = path[10]
        assert frozen_runs(carried(path, fps=30.0)) == expected
    still, nod = carried(np.zeros(60)), np.zeros((60, 3))
    nod[20] = [0.0, 0.0, 0.01]
    for motion in (
        turned(still, "Head", np.where(np.arange(60) == 20, 1e-4, 0.0)),
        replace(still, joint_translations={"Head": nod}),
    ):
        assert frozen_runs(motion) == [(21, 60)]
