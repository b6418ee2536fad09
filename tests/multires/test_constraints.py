"""Constraints of one level, worked out by hand: clips, keyframes and paths in motion vectors.

What is beside a clip is blended to it, within half a second or so.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from rigs import at_rest, below_a_root, turned_at_root

from audio_features import level_lengths
from gesturekit import Motion
from gesturekit.errors import ModelError
from gesturekit.motion.face import smplx_face
from gesturekit.motion.root_path import RootPath, heading
from gesturekit.motion.rotations import quaternion_from_rotation_vector, rotate_vectors
from gesturekit.multires import MultiresRepresentation, Normaliser, resample
from gesturekit.multires.constraints import (
    InbetweenConstraint,
    PathConstraint,
)
from gesturekit.multires.keyframes import (
    KeyframeConstraint,
    ground_positions,
    keep_unedited,
    moved,
    root_through_keyframes,
)
from gesturekit.multires.motion_vector import fastest_second, turned, turned_plane
from gesturekit.training.clips import InbetweenClips, mixed_motions

FPS = 25.0
HAND = "LeftHand"
"""A joint that is not modelled."""


@pytest.fixture(scope="module")
def recorded(gesture) -> Motion:
    """Four seconds of a tall person, who sways."""
    motion = gesture(4.0, FPS).scaled(1.25)
    phase = 2 * np.pi * 0.5 * motion.times[:, None] + [0.0, 0.0, 1.0]
    return replace(motion, translation=motion.translation + 0.1 * np.sin(phase) * [1, 0, 1])


@pytest.fixture(scope="module")
def representation(recorded) -> MultiresRepresentation:
    joints = [name for name in recorded.skeleton.names if name != HAND]
    found = MultiresRepresentation.fit([recorded], joints)
    assert abs(found.scale - 1) > 0.05
    return found


@pytest.fixture(scope="module")
def normaliser(recorded, representation) -> Normaliser:
    return Normaliser.fit([representation.encode(recorded)], representation, FPS)


def about_y(angle: float) -> np.ndarray:
    return quaternion_from_rotation_vector(np.array([0.0, angle, 0.0]))


def turned_about(motion: Motion, angle: float) -> Motion:
    """The whole motion turned about the origin."""
    place = rotate_vectors(about_y(angle), motion.translation)
    return replace(turned_at_root(motion, about_y(angle)), translation=place)


def posed(representation, n_frames: int, place=(0.0, 1.1, 0.0), rise: float = 0.0) -> Motion:
    """A person who faces +Z at rest, and rises by so many metres a frame."""
    motion = at_rest(representation.skeleton, n_frames, place, FPS)
    motion.translation[:, 1] += rise * np.arange(n_frames)
    return motion


def test_turned_vectors_are_those_of_the_turned_motion(recorded, representation):
    values = representation.encode(recorded)
    before = values.copy()
    expected = representation.encode(turned_about(recorded, 0.8))
    for angle in (0.8, np.full(100, 0.8)):
        found = turned(values, angle, representation.layout)
        np.testing.assert_allclose(found, expected, atol=1e-9)
    np.testing.assert_array_equal(values, before)


@pytest.mark.parametrize(
    ("steps", "speed"),
    [
        ([0.0] * 3 + [0.5] * 4 + [0.1] * 3, 2.0),  # four frames of a second
        ([0.5, 0.5], 2.0),  # half a second
        ([0.5, -0.5] * 5, 0.0),  # to and fro
        ([0.5], 2.0),
        ([], 0.0),
    ],
)
def test_the_fastest_second_is_a_way_over_the_ground(steps, speed):
    """In steps of 3 : 4 at 4 frames per second."""
    ways = np.outer(steps, [0.6, -0.8])
    assert fastest_second(ways.reshape(-1, 2), 4.0) == pytest.approx(speed)


@pytest.mark.parametrize("below", [False, True])
def test_a_moved_motion_is_elsewhere_and_no_pose_changes(recorded, below):
    motion = recorded
    if below:
        # Hips that move below a reference which faces elsewhere.
        rig = below_a_root(recorded.skeleton, 0.2)
        motion = at_rest(rig, recorded.n_frames)
        motion.rotations[:, 0] = about_y(1.2)
        motion.rotations[:, 1:] = recorded.rotations
        motion = replace(motion, joint_translations={"Hips": recorded.translation.copy()})
    representation = MultiresRepresentation.fit([motion])
    assert (representation.root > 0) == below
    start = motion.positions()[:, representation.root][:, [0, 2]]
    np.testing.assert_allclose(ground_positions(representation, motion), start)
    steady, changing = np.array([0.3, -0.5]), np.outer(motion.times, [0.1, 0.2])
    for offset in (steady, changing):
        found = moved(representation, motion, offset)
        way = np.broadcast_to(offset, (motion.n_frames, 2))[:, None] @ [[1, 0, 0], [0, 0, 1]]
        body = motion.positions()[:, representation.root :]
        np.testing.assert_allclose(
            found.positions()[:, representation.root :], body + way, atol=1e-9
        )
        np.testing.assert_array_equal(found.rotations, motion.rotations)


def test_an_edited_frame_is_reached_and_others_stay(representation, normaliser):
    n = 40
    values = representation.encode(posed(representation, n))
    edited = np.zeros(values.shape, bool)
    edited[20:23, 5] = True
    constraint = KeyframeConstraint(values, edited, representation, normaliser)
    # The level is off by the same everywhere: what is missing is known in every frame.
    output = normaliser.from_values(values) - 0.5
    share = (constraint(0, output) - output)[0].numpy() / 0.5
    rows = share[np.delete(np.arange(len(share)), np.r_[representation.layout.contacts])]
    np.testing.assert_allclose(rows[:, 20:23], 1, atol=5e-3)
    np.testing.assert_allclose(rows[:, np.r_[:16, 27:n]], 0, atol=5e-3)
    assert (np.diff(rows[:, 22:27]) < 0).all() and (np.diff(rows[:, 16:21]) > 0).all()
    assert not share[representation.layout.contacts].any(), "edited files have no labels"


def test_only_slow_differences_to_keyframes_are_removed(representation, normaliser):
    """Slow is what keyframes of every fourth frame can hold."""
    n = 40
    values = representation.encode(posed(representation, n))
    constraint = KeyframeConstraint(values, np.ones(values.shape, bool), representation, normaliser)
    given = resample(normaliser.from_values(values), 4 * n)
    shares = []
    for period in (5, 12, 40):
        wave = 0.3 * torch.sin(2 * torch.pi * torch.arange(4 * n) / period)
        left = (constraint(1, given + wave) - given)[0, 0, 40:120]
        shares.append(float(left.std() / wave[40:120].std()))
    assert shares[0] > 0.8 and 0.05 < shares[1] < 0.5 and shares[2] < 0.02


def test_feet_are_free_where_legs_or_the_root_were_edited(representation, normaliser):
    n, layout = 20, representation.layout
    values = representation.encode(posed(representation, n))
    arm, leg = (representation.joint_columns(name).start for name in ("LeftArm", "RightLeg"))

    def free(frames: slice, *columns: int) -> np.ndarray:
        edited = np.zeros(values.shape, bool)
        edited[frames, columns] = True
        constraint = KeyframeConstraint(values, edited, representation, normaliser)
        return constraint.edited_feet(2 * n)

    assert not free(slice(8, 12), arm).any() and not free(slice(8, 12), layout.contacts.start).any()
    for column in (leg, *layout.root_xz, layout.root_height, 0):
        found = free(slice(8, 12), column)
        # Frames 17 to 22 of 40 lie between the centres of 8 and 11 of 20.
        assert (found[17:23] == 1).all() and not found[:7].any() and not found[33:].any()
        assert 0.2 < found[15] < 1 and 0.2 < found[24] < 1
    assert not free(slice(None), leg).any(), "feet that were edited throughout are locked"


def test_unedited_values_are_the_networks(representation):
    """Differences of a thousandth, and of a hundredth of a millimetre of a step, are rounding."""
    read = np.zeros((3, representation.n_features))
    generated = read + 5.0
    edited = read.copy()
    x = representation.layout.root_xz[0]
    edited[0, [3, x]] = 0.001, -0.00001
    edited[1, [3, x]] = -0.05, 0.001
    values, changed = keep_unedited(edited, generated, read, representation)
    assert np.argwhere(changed).tolist() == [[1, 3], [1, x]]
    np.testing.assert_array_equal(values, np.where(changed, edited, 5.0))
    edited[[0, 2], 3] = 1.0
    values, changed = keep_unedited(edited, generated, read, representation)
    np.testing.assert_array_equal(values, edited)
    assert changed.all(), "no frame is as it was"


def test_the_root_passes_through_edited_frames(representation):
    """Keyframes 2 and 6 of 10 are at frames 9.5 and 25.5 of 40."""
    free = posed(representation, 40)
    free.translation[:, 0] += 0.01 * np.arange(40)
    drifted = moved(representation, free, np.outer(np.arange(40), [0.003, -0.002]))
    wanted = replace(free, fps=FPS / 4)[::4]
    wanted.translation[:] = [5.0, 1.1, -5.0]
    wanted.translation[2], wanted.translation[6] = [1.0, 1.1, -0.5], [1.5, 1.1, 0.5]

    def found(*edited: int) -> np.ndarray:
        frames = np.isin(np.arange(10), edited)
        made = root_through_keyframes(representation, drifted, free, wanted, frames)
        return ground_positions(representation, made)

    only = found(2)
    expected = ground_positions(representation, free) + [1.0 - 0.095, -0.5]
    np.testing.assert_allclose(only, expected, atol=1e-9)
    both = found(2, 6) - ground_positions(representation, free)
    np.testing.assert_allclose(both[:2], [[0.905, -0.5]] * 2, atol=1e-3)
    np.testing.assert_allclose(both[-4:], [[1.245, 0.5]] * 4, atol=1e-3)
    # Half way between them, after 17.5 frames, it is half way there.
    np.testing.assert_allclose(both[17:19].mean(axis=0), [1.075, 0.0], atol=1e-3)
    assert (np.diff(both, axis=0) > -1e-9).all(), "without overshoot"
    # Smoothed by a Gaussian of 0.1 s, 2.5 frames, the way begins before the keyframe.
    assert 1e-3 < both[8, 0] - both[0, 0] < 0.03


def straight(n_frames: int, step: tuple[float, float], angle: float) -> RootPath:
    places = np.outer(np.arange(n_frames), step) + [4.0, -3.0]
    return RootPath(places, np.full(n_frames, angle), FPS)


@pytest.mark.parametrize("margin", [0, 7])
def test_a_level_gets_the_steps_of_the_path_in_its_own_world(representation, normaliser, margin):
    """The body faces 0.3 rad, the path 1.0 rad: it is turned by 0.7 rad in the end."""
    path = straight(50, (0.012, -0.004), 1.0)
    lengths = level_lengths(50 + 2 * margin, 2)
    constraint = PathConstraint(path, representation, normaliser, lengths, margin)
    values = representation.encode(turned_about(posed(representation, lengths[1]), 0.3))
    step = turned_plane(np.array([[0.012, -0.004]]), -0.7)
    for level, n_frames in enumerate(lengths):
        output = normaliser.from_values(values[:n_frames])
        found = normaliser.to_values(constraint(level, output))
        own = np.tile(step, (n_frames, 1))
        np.testing.assert_allclose(found[:, representation.layout.root_xz], own, atol=1e-6)
        others = np.delete(np.arange(values.shape[1]), representation.layout.root_xz)
        np.testing.assert_allclose(found[:, others], values[:n_frames, others], atol=1e-6)
    placed = constraint.placed(found)
    made = representation.decode(placed, FPS)
    assert heading(made[:1]) == pytest.approx(1.0)
    way = ground_positions(representation, made)[-1] - ground_positions(representation, made)[0]
    frames = lengths[1] - 1
    np.testing.assert_allclose(way, frames * representation.scale * np.array([0.012, -0.004]))


def test_steps_that_are_far_too_fast_are_limited_below_the_finest_level(representation, normaliser):
    path = straight(50, (2.0, 0.0), 0.0)
    lengths = level_lengths(50, 2)
    constraint = PathConstraint(path, representation, normaliser, lengths)
    x = representation.layout.root_xz[0]
    for level, n_frames in enumerate(lengths):
        values = representation.encode(posed(representation, n_frames))
        found = constraint(level, normaliser.from_values(values))[0, x]
        fast = (2.0 - float(normaliser.mean[x])) / float(normaliser.scale[x])
        assert fast > 10
        assert found.max() < 5 if level == 0 else np.allclose(found, fast, rtol=1e-5)


def test_clips_begin_at_the_nearest_frame_and_may_touch(representation):
    """0.5 of a frame is rounded up."""
    clip = posed(representation, 10)
    clips = InbetweenClips({0.42: clip, 0.02: clip}, representation, FPS)
    assert [begin for begin, _ in clips.clips] == [1, 11] and clips.end == 21
    clips.check_end(21)
    with pytest.raises(ModelError, match=r"(?=.*\b0\.84 s)(?=.*\b0\.8 s)"):
        clips.check_end(20)
    with pytest.raises(ModelError, match=r"(?=.*\b0\.38 s)(?=.*\b0\.44 s)"):
        InbetweenClips({0.38: clip, 0.02: clip}, representation, FPS)
    other = InbetweenClips({0.0: replace(clip, fps=50.0)}, representation, FPS)
    assert other.end == 5, "0.2 s"
    for second in (-0.01, float("inf"), float("nan")):
        with pytest.raises(ModelError, match=f"{second:g} s"):
            InbetweenClips({second: clip}, representation, FPS)


def test_the_speed_between_clips_is_that_from_end_to_begin(representation):
    """From the last frame of one, 49, to the first of the next, 100, are 51 frames."""
    walks = posed(representation, 50)
    walks.translation[:, 0] += 0.1 * np.arange(50)
    there = posed(representation, 50, (4.9 + 0.3, 1.1, 0.4))
    later = posed(representation, 10, (4.9 + 0.3, 1.1, 0.5))
    clips = InbetweenClips({0.0: walks, 4.0: there, 8.0: later}, representation, FPS)
    assert clips.fastest_gap() == pytest.approx(0.5 * FPS / 51)
    assert InbetweenClips({1.0: walks}, representation, FPS).fastest_gap() == 0.0


def hand_at(motion: Motion, angle: float) -> Motion:
    """The motion with the hand that is not modelled turned about Z."""
    turn = quaternion_from_rotation_vector(np.array([0.0, 0.0, angle]))
    motion.rotations[:, motion.skeleton.index(HAND)] = turn
    return motion


def with_face(motion: Motion, level: float) -> Motion:
    return replace(motion, face=smplx_face(np.full((motion.n_frames, 10), level)))


def test_clips_are_given_back_with_what_is_not_modelled_blended_to_them(representation):
    """A hand is at 0 rad in the motion and at 0.8 rad in two clips, the face at 1 and at 3."""
    motion = with_face(hand_at(posed(representation, 60), 0.0), 1.0)
    arm = motion.skeleton.index("LeftArm")
    clip = with_face(hand_at(posed(representation, 10, (1.0, 1.2, 0.0)), 0.8), 3.0)
    clip.rotations[:, arm] = about_y(0.5)
    made = InbetweenClips({0.6: clip, 1.2: clip}, representation, FPS).restored(motion)
    inside = np.r_[15:25, 30:40]
    np.testing.assert_allclose(made.rotations[inside], np.tile(clip.rotations, (2, 1, 1)))
    np.testing.assert_array_equal(made.translation[inside], np.tile(clip.translation, (2, 1)))
    outside = np.setdiff1d(np.arange(60), inside)
    others = np.delete(np.arange(motion.skeleton.n_joints), motion.skeleton.index(HAND))
    np.testing.assert_array_equal(
        made.rotations[outside][:, others], motion.rotations[outside][:, others]
    )
    np.testing.assert_array_equal(made.translation[outside], motion.translation[outside])
    q = made.rotations[:, motion.skeleton.index(HAND)]
    share = 2 * np.arctan2(q[:, 2], q[:, 3]) / 0.8
    np.testing.assert_allclose(share[inside], 1, atol=1e-6)
    np.testing.assert_allclose(share[np.r_[:3, 52:60]], 0, atol=1e-6)
    assert (np.diff(share[8:16]) > 0).all() and (np.diff(share[39:47]) < 0).all()
    assert (share[25:30] > 0.5).all(), "between the clips"
    np.testing.assert_allclose(made.face.values[:, 4], 1 + 2 * share, atol=1e-6)
    assert (motion.face.values == 1).all(), "the motion itself does not change"


def test_a_hand_beside_a_clip_is_not_blended_to_the_clip_before(representation):
    """Clips at 0.8 and -0.4 rad with one frame between them: after both, no angle is above 0."""
    motion = hand_at(posed(representation, 40), 0.0)
    clips = {0.4: hand_at(posed(representation, 5), 0.8)}  # frames 10 to 14
    clips[16 / FPS] = hand_at(posed(representation, 2), -0.4)  # 16 and 17
    made = InbetweenClips(clips, representation, FPS).restored(motion)
    q = made.rotations[:, motion.skeleton.index(HAND)]
    angle = 2 * np.arctan2(q[:, 2], q[:, 3])
    x = np.arange(9, 0, -1) / 10  # the blend takes 10 frames
    fall = x * x * (3 - 2 * x)
    np.testing.assert_allclose(angle[18:27], -0.4 * fall, atol=1e-6)
    np.testing.assert_allclose(angle[1:10], 0.8 * fall[::-1], atol=1e-6)
    np.testing.assert_allclose(angle[[0, 27, 39]], 0, atol=1e-6)
    assert -0.4 < angle[15] < 0.8


def test_weights_beside_clips_and_the_mixture_that_they_give(representation):
    """At 10 fps the blend takes 4 frames: shares 27/32, 1/2, 5/32."""
    own = replace(posed(representation, 2), fps=10.0)
    clips = InbetweenClips({0.2: own, 0.6: own, 1.5: own}, representation, 10.0)
    a, b, c = 27 / 32, 1 / 2, 5 / 32
    given = clips.given(16 + 2)
    np.testing.assert_allclose(given, [b, a, 1, 1, a, a, 1, 1, a, b, c, 0, c, b, a, 1, 1, a])
    locked = posed(representation, 3, (0.0, 0.0, 0.0))
    motion = turned_at_root(posed(representation, 3, (2.0, 2.0, 2.0)), about_y(0.8))
    mixed = mixed_motions(locked, motion, np.array([0.0, 0.25, 1.0]))
    np.testing.assert_allclose(mixed.translation[:, 0], [0.0, 0.5, 2.0])
    np.testing.assert_allclose(heading_of(mixed), [0.0, 0.2, 0.8], atol=1e-9)
    np.testing.assert_array_equal(mixed.rotations[2], motion.rotations[2])
    np.testing.assert_array_equal(mixed.rotations[0], locked.rotations[0])


def heading_of(motion: Motion) -> np.ndarray:
    return 2 * np.arctan2(motion.rotations[:, 0, 1], motion.rotations[:, 0, 3])


def constrained(representation, normaliser, clips, n_frames: int, margin: int = 0, level: int = 2):
    """The values (T_i, D) of a level whose network gave the same pose in every frame."""
    found = InbetweenClips(clips, representation, FPS)
    lengths = level_lengths(n_frames + 2 * margin, 3)
    constraint = InbetweenConstraint(found, representation, normaliser, lengths, margin)
    values = representation.encode(posed(representation, lengths[level]))
    return values, normaliser.to_values(constraint(level, normaliser.from_values(values)))


def test_beside_a_clip_pose_and_velocity_go_on(representation, normaliser):
    """A clip that rises by 1 cm a frame and ends 0.2 m higher than the level's own pose."""
    scale, height = representation.scale, representation.layout.root_height
    clip = posed(representation, 11, (0.0, 1.2, 0.0), rise=0.01)
    for margin in (0, 4):
        own, found = constrained(representation, normaliser, {0.8: clip}, 60, margin)
        np.testing.assert_allclose(own[:, height], 1.1 / scale)
        found = found[margin:][:60, height] * scale - 1.1
        np.testing.assert_allclose(found[20:31], 0.1 + 0.01 * np.arange(11), atol=1e-6)
        assert (np.abs(np.diff(found, 2)[9:42]) < 0.02).all(), "no leap of 0.2 m"
        assert found[31] > found[30] and found[19] < found[20], "it goes on rising"
        # Half way through the blend of 10 frames: half of 0.2 m, a quarter of 5 frames' rise.
        assert found[35] == pytest.approx(0.5 * 0.2 + 0.25 * 5 * 0.01)
        np.testing.assert_allclose(found[np.r_[:7, 44:60]], 0.0, atol=1e-6)


def test_at_coarse_levels_clips_are_shorter_and_keep_their_pose(representation, normaliser):
    """At level 1 frame k of 18 is at (k + 0.5) 32 / 18 - 0.5 of 32."""
    clip = posed(representation, 9, (0.0, 1.3, 0.0))
    height = representation.layout.root_height
    _, found = constrained(representation, normaliser, {0.4: clip}, 32, level=0)
    assert len(found) == 18
    at = (np.arange(18) + 0.5) * 32 / 18 - 0.5
    up = found[:, height] * representation.scale - 1.1
    inside = (at > 9.5) & (at < 18.5)
    assert inside.sum() == 5
    np.testing.assert_allclose(up[inside], 0.2, atol=1e-6)
    last = np.flatnonzero(inside)[-1]
    assert (np.diff(up[last : last + 5]) < 0).all() and up[-1] == pytest.approx(0, abs=1e-6)
    assert up[last + 3] == pytest.approx(0.1), "half way through the blend of 0.4 s, 5.6 frames"
    pose = posed(representation, 1, (0.0, 1.3, 0.0))
    for second, frame in ((0.48, 7), (0.0, 0), (31 / FPS, 17)):
        _, found = constrained(representation, normaliser, {second: pose}, 32, level=0)
        up = found[:, height] * representation.scale - 1.1
        assert np.abs(at - second * FPS).argmin() == frame
        np.testing.assert_allclose(up[frame], 0.2, atol=1e-6)
        assert (np.delete(up, frame) < 0.199).all()


def test_a_gap_shorter_than_the_blends_is_filled_from_end_to_end(representation, normaliser):
    """Three frames between two clips."""
    low, high = (posed(representation, 10, (0.0, y, 0.0)) for y in (1.0, 1.3))
    _, found = constrained(representation, normaliser, {0.0: low, 13 / FPS: high}, 40)
    up = found[:, representation.layout.root_height] * representation.scale - 1.1
    assert up[9] == pytest.approx(-0.1) and up[13] == pytest.approx(0.2)
    assert (np.diff(up[9:14]) > 0).all()


@pytest.mark.parametrize("angle", [0.0, 0.7])
def test_a_walk_goes_on_from_the_end_of_a_clip_to_the_first_frame_of_the_next(
    representation, normaliser, angle
):
    """The first frame of a clip has the step of its second one, in whichever way the clips face."""
    first, last = posed(representation, 10), posed(representation, 10, (0.5, 1.1, -1.0))
    first.translation[:, 0] += 0.02 * np.arange(10)
    last.translation[:, 2] += 0.03 * np.arange(10)
    clips = {0.0: turned_about(first, angle), 1.2: turned_about(last, angle)}
    _, found = constrained(representation, normaliser, clips, 40)
    steps = found[:, representation.layout.root_xz] * representation.scale
    np.testing.assert_allclose(steps[:10], np.tile([0.02, 0.0], (10, 1)), atol=1e-6)
    np.testing.assert_allclose(steps[30:], np.tile([0.0, 0.03], (10, 1)), atol=1e-6)
    np.testing.assert_allclose(steps[10:31].sum(axis=0), [0.5 - 0.18, -1.0], atol=1e-6)
