"""Paths over the ground: their deltas, other frame rates, smoothing."""

from __future__ import annotations

import numpy as np
import pytest
from rigs import at_rest, rig_of

from gesturekit.errors import MotionError
from gesturekit.motion import Motion
from gesturekit.motion.heading import headings_of_sides
from gesturekit.motion.root_path import RootPath
from gesturekit.motion.rotations import (
    multiply_quaternions,
    quaternion_from_rotation_vector,
    rotate_vectors,
)


def wandering(n_frames: int = 600, fps: float = 30.0) -> RootPath:
    rng = np.random.default_rng(3)
    steps = np.cumsum(0.01 * rng.standard_normal((n_frames, 3)), axis=0)
    return RootPath(np.cumsum(0.05 * steps[:, :2], axis=0) + 2.0, 3.0 + steps[:, 2], fps)


def circle(radius: float = 2.0, speed: float = 1.2, fps: float = 30.0, n: int = 600) -> RootPath:
    """To the left, starting at the origin towards +Z, looking where it goes."""
    angle = speed / radius * np.arange(n) / fps
    x, z = radius * (1 - np.cos(angle)), radius * np.sin(angle)
    return RootPath(np.stack([x, z], axis=-1), angle, fps)


def about_y(angles: np.ndarray) -> np.ndarray:
    return quaternion_from_rotation_vector(np.outer(angles, [0.0, 1.0, 0.0]))


def test_deltas_lead_back_to_the_path():
    path = wandering(2000)
    start = (*path.positions[0], path.headings[0])
    again = RootPath.from_deltas(path.deltas(), path.fps, start)
    assert np.abs(again.positions - path.positions).max() < 1e-9
    assert np.abs(again.headings - path.headings).max() < 1e-9


def test_deltas_match_the_movement_of_the_body():
    turn, forward, lateral = circle().deltas().T
    assert turn == pytest.approx(1.2 / 2.0 / 30)
    assert np.abs(lateral).max() < 1e-9, "who walks a circle takes no side steps"
    assert forward == pytest.approx(2 * 2.0 * np.sin(0.5 * 1.2 / 2.0 / 30))
    # A step to the left of a body that faces +X goes towards -Z.
    aside = RootPath(np.array([[0.0, 0.0], [0.0, -0.1]]), np.full(2, np.pi / 2), 30.0)
    assert aside.deltas() == pytest.approx(np.tile([0.0, 0.0, 0.1], (2, 1)))


def test_the_mirror_changes_the_sign_of_turn_and_lateral():
    path = wandering(50)
    assert path.mirror().deltas() == pytest.approx(path.deltas() * [-1, 1, -1])


@pytest.mark.parametrize("fps", [24.0, 60.0, 100.0])
def test_another_frame_rate_is_the_same_path_at_the_same_times(fps):
    path = circle()
    made = path.resample(fps)
    assert made.n_frames == round(path.duration * fps)
    at = np.minimum(np.arange(made.n_frames) / fps, (path.n_frames - 1) / path.fps)
    angle = 1.2 / 2.0 * at
    assert np.abs(made.headings - angle).max() < 1e-9
    exact = np.stack([2.0 * (1 - np.cos(angle)), 2.0 * np.sin(angle)], axis=-1)
    assert np.abs(made.positions - exact).max() < 1e-3
    assert made.speeds[: round(19.9 * fps)] == pytest.approx(1.2, rel=0.01)


def test_half_a_frame_counts_as_one():
    """49 and 47 frames at 30 fps are 24.5 and 23.5 at 15 fps; one frame is never none."""
    path = wandering(49)
    assert [path.resample(15.0).n_frames, path.slice(0, 47).resample(15.0).n_frames] == [25, 24]
    assert path.slice(0, 1).resample(10.0).n_frames == 1


def test_a_path_that_is_asked_for_longer_stands_at_its_end():
    path = circle(n=10).resample(30.0, 15)
    assert path.n_frames == 15
    assert (path.positions[10:] == path.positions[9]).all()
    assert (path.headings[10:] == path.headings[9]).all()


def test_a_path_may_be_read_from_between_two_frames():
    path = RootPath(np.outer(np.arange(60), [0.01, 0.0]), 0.02 * np.arange(60), 60.0)
    late = path.resample(30.0, start=0.125)
    assert late.n_frames == 26
    assert late.positions[:26, 0] == pytest.approx(0.6 * (0.125 + np.arange(26) / 30))
    assert late.headings[3] == pytest.approx(1.2 * 0.225)


@pytest.mark.parametrize("n_frames", [1, 2, 4, 11, 300])
def test_smoothing_keeps_both_ends_and_a_straight_walk(n_frames):
    n = np.arange(n_frames)
    straight = RootPath(np.outer(n, [0.03, 0.01]), 0.02 * n, 30.0)
    smooth = straight.smoothed()
    assert smooth.n_frames == n_frames
    assert np.abs(smooth.positions - straight.positions).max() < 1e-12
    assert np.abs(smooth.headings - straight.headings).max() < 1e-12
    rough = wandering(n_frames)
    assert rough.smoothed().positions[[0, -1]] == pytest.approx(rough.positions[[0, -1]])


def test_smoothing_takes_out_what_is_shorter_than_ten_frames():
    n = np.arange(300)
    places = np.stack([0.02 * np.sin(2 * np.pi * n / 10), 0.04 * n], axis=-1)
    path = RootPath(places, 0 * n, fps=30.0)
    smooth = path.smoothed()
    assert np.abs(smooth.positions[20:-20, 0]).max() < 1e-12
    assert smooth.positions[20:-20, 1] == pytest.approx(0.04 * n[20:-20]), "nothing is delayed"
    with pytest.raises(MotionError, match="0"):
        path.smoothed(0)


def test_headings_that_jump_by_a_turn_are_unwrapped():
    angles = np.linspace(0, 6 * np.pi, 300)
    wrapped = (angles + np.pi) % (2 * np.pi) - np.pi
    assert RootPath(np.zeros((300, 2)), wrapped, 30.0).headings == pytest.approx(angles)


def test_a_path_looks_where_it_goes_and_turns_while_it_stands():
    path = circle()
    found = RootPath.looking_ahead(path.positions, 30.0).headings
    assert found[1:-1] == pytest.approx(path.headings[1:-1], abs=1e-6)
    there = np.concatenate([np.linspace([0, 0], [0, 1], 30), np.tile([[0.0, 1.0]], (20, 1))])
    back = np.concatenate([there, np.linspace([0, 1], [1, 1], 30)])
    headings = RootPath.looking_ahead(back, 30.0).headings
    assert headings[0] == pytest.approx(0.0)
    assert headings[-1] == pytest.approx(np.pi / 2)
    assert np.diff(headings).max() < 0.1, "no jump in between"
    assert not RootPath.looking_ahead(np.zeros((5, 2)), 30.0).headings.any()


@pytest.mark.parametrize(
    ("speed", "scale", "goes"),
    [(0.045, 1.0, False), (0.055, 1.0, True), (0.09, 2.0, False), (0.11, 2.0, True)],
)
def test_who_moves_slower_than_a_twentieth_of_a_metre_a_second_stands(speed, scale, goes):
    """A speed on the reference body; a body twice as large stands at twice the speed."""
    along_x = np.outer(np.arange(10), [speed / 30.0, 0.0])
    headings = RootPath.looking_ahead(along_x, 30.0, scale).headings
    assert headings == pytest.approx(np.pi / 2 if goes else 0.0)


def test_the_path_of_a_motion_is_that_of_its_hips(gesture):
    motion = gesture(4.0)
    path = circle(n=motion.n_frames)
    motion.rotations[:, 0] = about_y(path.headings)
    motion.translation[:, [0, 2]] = path.positions
    made = RootPath.of(motion)
    assert np.abs(made.positions - path.positions).max() < 1e-12
    assert np.abs(made.headings - path.headings).max() < 1e-9
    assert RootPath.of(motion.mirror()).headings == pytest.approx(-path.headings)


def test_a_body_that_lies_down_keeps_its_heading(gesture):
    """Beyond 90 degrees of roll the left hip is on the right, where it would turn the heading."""
    motion = gesture(1.0)
    roll = np.radians(np.concatenate([np.linspace(0, 92, 15), np.linspace(92, 0, 15)]))
    rolled = quaternion_from_rotation_vector(np.outer(roll, [0.0, 0.0, 1.0]))
    motion.rotations[:, 0] = multiply_quaternions(about_y(np.array([0.8])), rolled)
    assert RootPath.of(motion).headings == pytest.approx(0.8)


def test_side_vectors_within_three_degrees_of_the_vertical_give_no_heading():
    """asin(0.05) is 2.87 degrees: between two frames that face +Z and -X, one is interpolated."""
    tilt = np.radians([2.8, 2.95])
    for angle, middle in zip(tilt, (-np.pi / 4, np.pi / 2), strict=True):
        # The left is at +X, then nearly straight up with a trace of -Z, then at +Z.
        sides = [[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, 0, 1]]
        found = headings_of_sides(0.2 * np.array(sides))
        assert found == pytest.approx([0.0, middle, -np.pi / 2])


def test_a_rig_without_legs_faces_where_its_root_does():
    bones = {
        "Root": (None, (0, 0, 0)),
        "Chest": ("Root", (0, 0.3, 0)),
        "Head": ("Chest", (0, 0, 0)),
    }
    angles = np.linspace(0, 2.5, 40)
    motion = at_rest(rig_of(bones), 40)
    motion.rotations[:, 0] = about_y(angles)
    assert RootPath.of(motion).headings == pytest.approx(angles)


def test_the_path_of_real_walks_has_no_jumps(shared_data):
    for file in ("motion/bandai/dataset-1_bow_active_001.bvh", "motion/reactidle/003_genuine.bvh"):
        path = RootPath.of(Motion.load(shared_data / file))
        assert np.abs(np.diff(path.headings)).max() < 0.3
        assert np.ptp(path.positions, axis=0).max() > 0.01, "Hips moves, not joint_Root"


@pytest.mark.parametrize(
    ("positions", "headings", "fps", "said"),
    [
        (np.zeros((4, 3)), np.zeros(4), 30.0, r"\(4, 3\)"),
        (np.zeros((0, 2)), np.zeros(0), 30.0, r"\(0, 2\)"),
        (np.zeros((4, 2)), np.zeros(3), 30.0, r"\(3,\)"),
        (np.full((4, 2), np.nan), np.zeros(4), 30.0, "position in frame 0"),
        (np.zeros((4, 2)), np.array([0, 0, np.inf, 0]), 30.0, "heading in frame 2"),
        (np.zeros((4, 2)), np.zeros(4), 0.0, "fps"),
    ],
)
def test_invalid_paths_are_refused(positions, headings, fps, said):
    with pytest.raises(MotionError, match=said):
        RootPath(positions, headings, fps)


@pytest.mark.parametrize(
    ("frames", "own_fps", "fps", "expected"),
    [
        (11, 1.0, 30.0, 301),
        (600, 60.0, 30.0, 300),
        (300, 30.0, 30.0, 300),
        (1, 30.0, 25.0, 1),
        # The last frame at 29.97 fps, a rounded 30000 / 1001, ends 0.0003 frames after the path's.
        (300, 30_000 / 1001, 29.97, 300),
        (301, 30.0, 30.0 * (1 - 0.0009 / 300), 301),
        (301, 30.0, 30.0 * (1 - 0.0011 / 300), 300),
    ],
)
def test_a_path_ends_at_its_last_place(frames, own_fps, fps, expected):
    along = np.stack([np.zeros(frames), np.arange(frames) / own_fps], axis=-1)
    path = RootPath(along, np.zeros(frames), own_fps)
    assert path.frames_within(fps) == expected
    walked = path.resample(fps, expected).positions[-1, 1]
    assert walked <= along[-1, 1] + 1e-9
    assert walked > along[-1, 1] - 1.001 / fps


def test_a_part_of_a_path_is_some_of_its_frames():
    path = wandering(5)
    for start, stop in ((0, 5), (1, 3), (4, 5)):
        part = path.slice(start, stop)
        np.testing.assert_array_equal(part.positions, path.positions[start:stop])
        np.testing.assert_allclose(part.headings, path.headings[start:stop])
        assert part.fps == path.fps and part.duration == (stop - start) / 30
    for start, stop in ((-1, 3), (2, 2), (3, 2), (0, 6)):
        with pytest.raises(MotionError, match=f"frames {start} to {stop} of a path of 5 frames"):
            path.slice(start, stop)


def test_steps_of_one_and_two_frames():
    path = RootPath(np.array([[1.0, 2.0], [1.3, 2.4]]), np.array([0.0, 0.2]), 10.0)
    assert path.speeds == pytest.approx([5.0, 5.0])
    one = path.slice(0, 1)
    assert one.speeds.tolist() == [0.0] and one.deltas().tolist() == [[0.0, 0.0, 0.0]]
    assert RootPath.looking_ahead(one.positions, 10.0).headings.tolist() == [0.0]
    start = (1.0, 2.0, 0.5)
    again = RootPath.from_deltas(np.array([[9.0, 9.0, 9.0], [np.pi, 0.4, 0.3]]), 10.0, start)
    # Half of the turn, and 0.5: forward is (cos 0.5, -sin 0.5), to the left (-sin 0.5, -cos 0.5).
    sine, cosine = np.sin(0.5), np.cos(0.5)
    end = [1.0 + 0.4 * cosine - 0.3 * sine, 2.0 - 0.4 * sine - 0.3 * cosine]
    np.testing.assert_allclose(again.positions, [[1.0, 2.0], end])
    np.testing.assert_allclose(again.headings, [0.5, 0.5 + np.pi])
    origin = RootPath.from_deltas(np.zeros((1, 3)), 10.0)
    assert (origin.positions.tolist(), origin.headings.tolist()) == ([[0.0, 0.0]], [0.0])


@pytest.mark.parametrize(
    ("frames", "weights"),
    [(1, [1]), (2, [1, 2, 1]), (3, [1, 1, 1]), (4, [1, 2, 2, 2, 1]), (None, [1, 1, 1])],
)
def test_smoothing_is_an_average_over_its_window(frames, weights):
    """A third of a second at 9 fps is three frames; the ends of an even window count half."""
    pulse = np.zeros((11, 2))
    pulse[5] = 1.0, 2.0
    smooth = RootPath(pulse, 0.1 * pulse[:, 1], 9.0).smoothed(frames)
    expected = np.zeros(11)
    half = len(weights) // 2
    expected[5 - half : 6 + half] = np.array(weights) / sum(weights)
    np.testing.assert_allclose(smooth.positions, np.outer(expected, [1.0, 2.0]), atol=1e-12)
    np.testing.assert_allclose(smooth.headings, 0.2 * expected, atol=1e-12)


def test_a_path_of_one_frame_a_second_is_not_smoothed():
    path = wandering(9, fps=1.0)
    np.testing.assert_allclose(path.smoothed().positions, path.positions)


def test_a_larger_body_goes_farther():
    path = wandering(5)
    larger = path.scaled(1.5)
    np.testing.assert_allclose(larger.positions, 1.5 * path.positions)
    np.testing.assert_allclose(larger.headings, path.headings)
    np.testing.assert_allclose(path.mirror().positions, path.positions * [-1.0, 1.0])


@pytest.mark.parametrize("n_frames", [0, -1, 10**9])
def test_a_path_has_one_frame_and_no_more_than_memory_holds(n_frames):
    with pytest.raises(MotionError, match=f"{n_frames} frames of a path; expected 1 to "):
        wandering(5).resample(30.0, n_frames)
    assert wandering(5).resample(30.0, 1).n_frames == 1


def test_a_path_starts_late_and_may_be_over():
    path = RootPath(np.outer(np.arange(6), [1.0, -2.0]), np.zeros(6), 2.0)
    late = path.resample(4.0, start=1.0)
    assert late.n_frames == 8, "two seconds of three"
    np.testing.assert_allclose(late.positions[:, 0], [2, 2.5, 3, 3.5, 4, 4.5, 5, 5])
    assert path.resample(4.0, start=5.0).positions.tolist() == [[5.0, -10.0]]


def test_the_path_of_another_joint_and_side(gesture):
    motion = gesture(1.0)
    joint = motion.skeleton.index("Head")
    path = RootPath.of(motion, joint, np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(path.positions, motion.positions()[:, joint][:, [0, 2]])
    left = rotate_vectors(motion.global_rotations()[:, joint], np.tile([0.0, 0.0, 1.0], (30, 1)))
    # The left of a body that faces +Z is +X; of one that faces +X it is -Z.
    expected = np.unwrap(np.arctan2(-left[:, 2], left[:, 0]))
    np.testing.assert_allclose(path.headings, expected)
