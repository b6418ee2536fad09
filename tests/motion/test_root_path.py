"""Paths over the ground: their deltas, other frame rates, smoothing."""

import numpy as np
import pytest

from gesturekit.errors import MotionError
from gesturekit.motion.root_path import RootPath
from gesturekit.motion.rotations import quaternion_from_rotation_vector


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


@pytest.mark.parametrize(
    ("turn_first", "forward", "lateral"), [(True, 1.0, 0.0), (False, 0.5**0.5, 0.5**0.5)]
)
def test_a_step_is_seen_after_the_turn_or_half_way_through_it(turn_first, forward, lateral):
    """A quarter turn to the left, from +Z to +X, and a metre to +X; halfway its left is +X, -Z."""
    path = RootPath(np.array([[2.0, 3.0], [3.0, 3.0]]), np.array([0.0, np.pi / 2]), 30.0)
    deltas = path.deltas(turn_first=turn_first)
    assert deltas[1] == pytest.approx([np.pi / 2, forward, lateral], abs=1e-12)
    again = RootPath.from_deltas(deltas, 30.0, turn_first=turn_first)
    assert again.positions == pytest.approx(np.array([[0.0, 0.0], [1.0, 0.0]]), abs=1e-12)
    assert again.headings == pytest.approx([0.0, np.pi / 2])


@pytest.mark.parametrize("fps", [24.0, 60.0, 100.0])
def test_another_frame_rate_is_the_same_path_at_the_same_times(fps):
    path = circle()
    made = path.resample(fps)
    assert made.n_frames == round(path.n_frames / path.fps * fps)
    at = np.minimum(np.arange(made.n_frames) / fps, (path.n_frames - 1) / path.fps)
    angle = 1.2 / 2.0 * at
    assert np.abs(made.headings - angle).max() < 1e-9
    exact = np.stack([2.0 * (1 - np.cos(angle)), 2.0 * np.sin(angle)], axis=-1)
    assert np.abs(made.positions - exact).max() < 1e-3
    assert made.speeds[: round(19.9 * fps)] == pytest.approx(1.2, rel=0.01)


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


def test_the_path_of_a_motion_is_that_of_its_hips(gesture):
    motion = gesture(4.0)
    path = circle(n=motion.n_frames)
    motion.rotations[:, 0] = about_y(path.headings)
    motion.translation[:, [0, 2]] = path.positions
    made = RootPath.of(motion)
    assert np.abs(made.positions - path.positions).max() < 1e-12
    assert np.abs(made.headings - path.headings).max() < 1e-9
    assert RootPath.of(motion.mirror()).headings == pytest.approx(-path.headings)


@pytest.mark.parametrize(
    ("positions", "headings", "fps", "said"),
    [
        (np.zeros((4, 3)), np.zeros(4), 30.0, r"\(4, 3\)"),
        (np.zeros((0, 2)), np.zeros(0), 30.0, r"\(0, 2\)"),
        (np.zeros((4, 2)), np.zeros(3), 30.0, r"\(3,\)"),
        (np.full((4, 2), np.nan), np.zeros(4), 30.0, "(?=.*position).*frame 0"),
        (np.zeros((4, 2)), np.array([0, 0, np.inf, 0]), 30.0, "(?=.*heading).*frame 2"),
        (np.zeros((4, 2)), np.zeros(4), 0.0, "fps"),
    ],
)
def test_invalid_paths_are_refused(positions, headings, fps, said):
    with pytest.raises(MotionError, match=said):
        RootPath(positions, headings, fps)


@pytest.mark.parametrize(("fps", "half"), [(3.0, 0), (6.0, 1), (9.0, 1), (12.0, 2)])
def test_smoothing_is_a_centred_average_over_a_third_of_a_second(fps, half):
    """At 9 fps these are three frames."""
    pulse = np.zeros((11, 2))
    pulse[5] = 1.0, 2.0
    smooth = RootPath(pulse, 0.1 * pulse[:, 1], fps).smoothed()
    found = smooth.positions[:, 0]
    assert np.flatnonzero(found > 1e-12).tolist() == list(range(5 - half, 6 + half))
    assert found.sum() == pytest.approx(1) and found.max() == found[5]
    np.testing.assert_allclose(found, found[::-1], atol=1e-12)
    np.testing.assert_allclose(smooth.positions[:, 1], 2 * found, atol=1e-12)
    np.testing.assert_allclose(smooth.headings, 0.2 * found, atol=1e-12)


def test_a_path_starts_late_and_may_be_over():
    path = RootPath(np.outer(np.arange(6), [1.0, -2.0]), np.zeros(6), 2.0)
    late = path.resample(4.0, start=1.0)
    assert late.n_frames == 8, "two seconds of three"
    np.testing.assert_allclose(late.positions[:, 0], [2, 2.5, 3, 3.5, 4, 4.5, 5, 5])
    assert path.resample(4.0, start=5.0).positions.tolist() == [[5.0, -10.0]]
