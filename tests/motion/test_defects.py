from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gesturekit.motion import Motion
from gesturekit.motion.defects import (
    defective_joints,
    find_jumps,
    find_pops,
    frozen_runs,
    jitter_share,
)
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


def test_defects_are_those_of_the_joints_that_jump_or_pop(moving_person):
    names = moving_person.skeleton.names
    assert not defective_joints(moving_person).any()
    assert defective_joints(moving_person[:1]).shape == (1, len(names))
    off = np.zeros(60)
    off[[20, 41]] = [0.5, -0.6]
    found = defective_joints(turned(moving_person, "LeftForeArm", off))
    frames, joints = np.nonzero(found)
    assert (frames.tolist(), [names[j] for j in joints]) == ([20, 41], ["LeftForeArm"] * 2)
    # The hands are carried away by the trunk; the legs stay.
    step = np.where(np.arange(60) < 30, 0.0, 1.5)
    found = defective_joints(turned(moving_person, "Spine", step))
    assert np.flatnonzero(found.any(axis=1)).tolist() == [30]
    assert found[30, names.index("LeftHand")] and not found[30, names.index("LeftLeg")]


def test_fast_human_movement_is_not_a_pop(moving_person):
    times = moving_person.times
    shaken = turned(moving_person, "LeftHand", np.radians(25) * np.sin(2 * np.pi * 5 * times))
    assert find_pops(shaken) is None
    # A turn that is made for good is a jump, not a pop.
    step = np.where(np.arange(60) < 30, 0.0, 1.5)
    assert find_pops(turned(moving_person, "Spine", step)) is None
    assert find_jumps(turned(moving_person, "Spine", step)).frames == (30,)


def test_jitter(moving_person):
    noise = np.zeros(60)
    noise[20:40] = 0.02 * (-1.0) ** np.arange(20)
    share = jitter_share(turned(moving_person, "Spine", noise))
    assert 0.2 < share < 0.34
    # Noise too small to be seen is none.
    assert jitter_share(turned(moving_person, "Spine", noise / 20)) == 0


def test_jitter_is_not_measured_at_low_frame_rates(moving_person):
    places = moving_person.translation.copy()
    places[::2] += [0.02, 0.0, 0.0]
    for fps, found in ((30.0, True), (15.0, True), (5.9, False)):
        assert (jitter_share(replace(moving_person, translation=places, fps=fps)) > 0.5) == found


def test_a_pop_next_to_a_jump_is_counted_once(moving_person):
    off = np.zeros(60)
    off[41] = 0.6
    motion = turned(moving_person, "LeftForeArm", off)
    places = motion.translation.copy()
    places[20] += [0.6, 0.0, 0.0]
    motion = replace(motion, translation=places)
    jumps = find_jumps(motion)
    assert jumps.frames == (20, 21)
    assert find_pops(motion).frames == (20, 41) and find_pops(motion, jumps).frames == (41,)


def test_real_recordings(shared_data):
    """The finding of a look at each: one clip of eight shakes its hand as nobody can."""
    clean = ("bow_sad", "bow_happy", "bye_normal", "bye_old")
    for name in clean:
        motion = Motion.load(shared_data / f"motion/bandai/dataset-1_{name}_001.bvh")
        assert find_pops(motion) is None and jitter_share(motion) == 0
    pops = find_pops(Motion.load(shared_data / "motion/bandai/dataset-1_bye_angry_001.bvh"))
    assert pops.joint == "Hand_R"
