from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from recordings import RECORDED
from rigs import PERSON, at_rest, numbered, rig_of, with_offsets
from scipy.spatial.transform import Rotation

from gesturekit.errors import MotionError
from gesturekit.motion import Motion
from gesturekit.motion.parts import left_right_pairs
from gesturekit.motion.rotations import rotation_angles
from gesturekit.motion.skeleton import Skeleton

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
    check(Motion.load(shared_data / file))


def test_a_rig_with_meaningless_names_is_mirrored_by_its_shape(moving_person):
    expected = moving_person.mirror()
    mirrored = replace(moving_person, skeleton=numbered(moving_person.skeleton)).mirror()
    np.testing.assert_allclose(mirrored.positions(), expected.positions(), atol=1e-9)
    np.testing.assert_allclose(mirrored.rotations, expected.rotations, atol=1e-9)


def test_parallel_frames_reflect_as_vectors_do(moving_person):
    mirrored = moving_person.mirror()
    left = moving_person.rotations[:, moving_person.skeleton.index("LeftForeArm")]
    right = mirrored.rotations[:, moving_person.skeleton.index("RightForeArm")]
    np.testing.assert_allclose(right, left * [1, -1, -1, 1], atol=1e-12)


def test_mirrored_bandai_poses_are_poses_of_that_rig(shared_data):
    """A bow looks alike in a mirror, so the mirrored joints must turn as the rig's own do."""
    for style in ("angry", "sad", "masculinity"):
        motion = Motion.load(shared_data / f"motion/bandai/dataset-1_bow_{style}_001.bvh")
        apart = rotation_angles(motion.mirror().rotations, motion.rotations)
        assert np.degrees(np.median(apart, axis=0)).max() < 30


def anyhow(alike: bool, n_frames: int = 40) -> Motion:
    """A person in a pose that no person takes, a little moving; both sides alike, or not at all.

    Ends (hands, feet and head) do not turn.
    """
    motion, rng = at_rest(rig_of(PERSON), n_frames), np.random.default_rng(0)
    rig = motion.skeleton
    for j, name in enumerate(rig.names):
        if rig.is_leaf(j):
            continue
        angles = rng.normal(0, 2, 3) + rng.normal(0, 0.1, (n_frames, 3))
        if alike and name.startswith("Right"):
            other = rig.index(name.replace("Right", "Left"))
            motion.rotations[:, j] = motion.rotations[:, other] * [1, -1, -1, 1]
            continue
        angles = angles * [1, 0, 0] if alike and not name.startswith("Left") else angles
        motion.rotations[:, j] = Rotation.from_rotvec(angles).as_quat()
    return motion


def reframed(motion: Motion, kinds: list[int], seed: int, along: bool) -> Motion:
    """The same motion on a rig whose joints have other axes.

    `kinds` gives for each joint by which reflection of its axes left becomes right: of x, y or z,
    or of all three. With `along` the x axes of the left side lie along its bones.
    """
    rig, rng, x = motion.skeleton, np.random.default_rng(seed), np.diag([-1, 1, 1])
    mirror = np.array([[-1, 1, 1], [1, -1, 1], [1, 1, -1], [-1, -1, -1]])
    axes = []
    for j, (name, kind) in enumerate(zip(rig.names, kinds, strict=True)):
        if name.startswith("Right"):
            left = axes[rig.index(name.replace("Right", "Left"))].as_matrix()
            axes.append(Rotation.from_matrix(x @ left @ np.diag(mirror[kind])))
        elif name.startswith("Left") and along and not rig.is_leaf(j):
            bone = Rotation.align_vectors([rig.offsets[rig.children(j)[0]]], [[1, 0, 0]])[0]
            axes.append(bone * Rotation.from_euler("x", rng.uniform(0, 6)))
        elif name.startswith("Left"):
            axes.append(Rotation.random(rng=rng))
        else:  # the reflected axis lies across the body
            across = Rotation.from_matrix(np.roll(np.eye(3), -kind, axis=0))
            axes.append(Rotation.from_euler("x", rng.uniform(0, 6)) * across)
    offsets, rotations = rig.offsets.copy(), np.empty_like(motion.rotations)
    for j, parent in enumerate(rig.parents):
        above = axes[parent] if parent >= 0 else Rotation.identity()
        offsets[j] = above.inv().apply(rig.offsets[j]) if j else rig.offsets[j]
        local = Rotation.from_quat(motion.rotations[:, j])
        rotations[:, j] = (above.inv() * local * axes[j]).as_quat()
    return replace(motion, skeleton=replace(rig, offsets=offsets), rotations=rotations)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("size", [1.0, 50.0])
@pytest.mark.parametrize("alike", [False, True])
def test_a_mirrored_motion_is_the_same_whatever_the_axes_of_joints(seed, size, alike):
    """The relation of left and right shows in the offsets below a joint. Where these are along the
    x axis alone, it shows in a body that does the same on both sides. Ends go with their parent.
    """
    motion = anyhow(alike)
    rig, rng = motion.skeleton, np.random.default_rng(10 + seed)
    kinds: list[int] = []
    for j, name in enumerate(rig.names):
        if rig.is_leaf(j):
            kinds.append(kinds[rig.parents[j]])
        elif name.startswith("Right"):
            kinds.append(kinds[rig.index(name.replace("Right", "Left"))])
        else:
            kinds.append(int(rng.integers(4 if name.startswith("Left") else 3)))
    other, expected = (reframed(m, kinds, seed, alike) for m in (motion, motion.mirror()))
    np.testing.assert_allclose(other.positions(), motion.positions(), atol=1e-9)
    assert rotation_angles(other.scaled(size).mirror().rotations, expected.rotations).max() < 1e-6


def test_bandai_clips_agree_on_how_left_and_right_relate(shared_data):
    """A mirrored clip of one style and another clip are of one rig: axes mean the same."""
    signs = set()
    for path in sorted((shared_data / "motion/bandai").glob("*.bvh")):
        offsets = Motion.load(path).mirror().skeleton.offsets
        signs.add(tuple(np.sign(np.round(offsets[3:], 3)).ravel()))
    assert len(signs) == 1


def nameless(motion: Motion) -> Motion:
    """No name tells a side, and feet that point nowhere leave the shape without one."""
    down = (0.0, -0.1, 0.0)
    skeleton = numbered(with_offsets(motion.skeleton, LeftToeBase=down, RightToeBase=down))
    return replace(motion, skeleton=replace(skeleton, end_sites={}))


def test_sides_named_by_hand(moving_person):
    person, motion = moving_person.skeleton, nameless(moving_person)
    by_hand = {
        f"{side.lower()}_{part}": f"Joint{person.index(side + name)}"
        for side in ("Left", "Right")
        for part, name in (("wrist", "Hand"), ("toe", "ToeBase"))
    }
    motion = motion.with_parts(by_hand)
    left, right = person.index("LeftForeArm"), person.index("RightForeArm")
    assert (f"Joint{left}", f"Joint{right}") in left_right_pairs(motion.skeleton)
    check(motion)
    assert motion.mirror().skeleton.parts == by_hand


def test_a_rig_without_sides_is_refused(moving_person):
    with pytest.raises(MotionError, match="cannot tell left from right .* left_elbow: JOINT"):
        nameless(moving_person).mirror()


@pytest.mark.parametrize("parents, is_same", [((-1, 0, 1), True), ((-1, 0, 0), False)])
def test_a_rig_without_limbs_has_no_sides_and_one_with_two_of_unknown_sides_is_refused(
    parents, is_same
):
    offsets = [[0, 0, 0], [0, 1, 0], [0, 1, 0.5]]
    tail = at_rest(Skeleton(("a", "b", "c"), parents, offsets), 2)
    if is_same:
        np.testing.assert_allclose(tail.mirror().positions(), tail.positions(), atol=1e-12)
    else:
        with pytest.raises(MotionError, match="cannot tell left from right"):
            tail.mirror()
