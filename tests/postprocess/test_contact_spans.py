"""Contact spans of made-up foot paths, with limits worked out by hand.

The limits on the reference body: a foot stands below 0.2 m/s (0.6 m/s if labelled) and within 3 cm
of its floor; landing and leaving last at most 0.1 s, below 0.4 m/s and within 1.5 cm.
"""

from __future__ import annotations

import numpy as np
import pytest

from gesturekit.postprocess.contact_spans import (
    contact_frames,
    contact_spans,
    include_landing,
    point_speed,
    split_at_movement,
)

FPS = 50.0


def path(x: np.ndarray | float, height: np.ndarray | float, n_frames: int = 60) -> np.ndarray:
    """(T, 3) positions of a point at x and height."""
    place = np.zeros((n_frames, 3))
    place[:, 0], place[:, 1] = x, height
    return place


def sliding(speed: float, n_frames: int = 60) -> np.ndarray:
    return path(speed * np.arange(n_frames) / FPS, 0.05, n_frames)


def mask(n_frames: int, *spans: tuple[int, int]) -> np.ndarray:
    stands = np.zeros(n_frames, dtype=bool)
    for start, stop in spans:
        stands[start:stop] = True
    return stands


def test_speed_is_since_the_previous_frame():
    positions = np.array([[0.0, 0.0, 0.0], [0.3, 0.4, 0.0], [0.3, 0.4, 1.0]])
    assert point_speed(positions, 10.0) == pytest.approx([5.0, 5.0, 10.0])
    assert point_speed(positions[:2], 10.0) == pytest.approx([5.0, 5.0])
    assert point_speed(positions[:1], 10.0).tolist() == [0.0]


@pytest.mark.parametrize("scale", [1.0, 2.0])
@pytest.mark.parametrize(("label", "limit"), [(None, 0.2), (0.6, 0.6)])
def test_a_foot_stands_below_a_speed_that_grows_with_the_body(scale, label, limit):
    labels = None if label is None else np.full(60, label)
    for share in (0.98, 1.02):
        stands, floor = contact_frames(sliding(share * limit * scale), FPS, scale, labels)
        assert stands.all() == stands.any() == (share < 1)
        assert floor == pytest.approx(0.05)


def test_only_labels_above_one_half_are_contacts():
    labels = np.repeat([0.5, 0.51, 0.2], 20)
    stands, _ = contact_frames(sliding(0.0), FPS, 1.0, labels)
    assert np.flatnonzero(stands).tolist() == list(range(20, 40))


def test_a_trembling_foot_stands_unless_its_labels_say_that_it_moves():
    """8 mm to and fro in each frame are 0.8 m/s at 50 fps; smoothed, the foot is still."""
    trembling = path(0.008 * (-1.0) ** np.arange(60), 0.05)
    stands, _ = contact_frames(trembling, FPS, 1.0)
    assert stands.all()
    stands, _ = contact_frames(trembling, FPS, 1.0, np.ones(60))
    assert not stands.any()


def test_smoothing_does_not_make_a_standing_foot_leave_early():
    walks_off = path(np.maximum(np.arange(60) - 29, 0) * 2.0 / FPS, 0.05)
    stands, _ = contact_frames(walks_off, FPS, 1.0)
    assert np.flatnonzero(stands).tolist() == list(range(30))


@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_the_floor_is_where_the_foot_stands_longest(scale):
    places = [0.0, 0.0, 0.0, 0.0, 0.0, 0.028, -0.028, 0.032]
    height = 0.05 + scale * np.repeat(places, 15)
    stands, floor = contact_frames(path(0.0, height, 120), FPS, scale, np.ones(120))
    assert floor == pytest.approx(0.05)
    # The first frame at another height is too fast, at 50 fps: 0.028 m are 1.4 m/s.
    expected = mask(120, (0, 75), (76, 90), (91, 105))
    np.testing.assert_array_equal(stands, expected)


def test_a_foot_in_flight_has_its_floor_at_the_tenth_percentile():
    stands, floor = contact_frames(path(0.0, np.linspace(0, 2.0, 101), 101), FPS, 1.0)
    assert not stands.any()
    assert floor == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("speed", "height", "scale", "grows"),
    [
        (0.38, 0.014, 1.0, True),
        (0.42, 0.0, 1.0, False),
        (0.0, 0.016, 1.0, False),
        (0.0, -0.016, 1.0, False),
        (0.78, 0.028, 2.0, True),
        (0.82, 0.0, 2.0, False),
        (0.0, 0.032, 2.0, False),
    ],
)
def test_landing_and_leaving_last_a_tenth_of_a_second(speed, height, scale, grows):
    """At 50 fps, five frames on either side of the span, at 4 fps one."""
    stands = mask(60, (20, 30))
    place = path(speed * np.arange(60) / FPS, 0.05 + height)
    found = include_landing(stands, place, 0.05, FPS, scale)
    np.testing.assert_array_equal(found, mask(60, (15, 35)) if grows else stands)
    place = path(speed * np.arange(60) / 4.0, 0.05 + height)
    found = include_landing(stands, place, 0.05, 4.0, scale)
    np.testing.assert_array_equal(found, mask(60, (19, 31)) if grows else stands)


def test_a_landing_ends_where_the_foot_is_in_flight():
    height = np.full(60, 0.05)
    height[:18], height[33:] = 0.2, 0.2
    height[16] = 0.05
    found = include_landing(mask(60, (20, 30)), path(0.0, height), 0.05, FPS, 1.0)
    # Frame 18 comes down from 0.2 m, at 7.5 m/s; frame 16 is low but on the other side.
    np.testing.assert_array_equal(found, mask(60, (19, 33)))


@pytest.mark.parametrize(
    ("stands", "spans"),
    [
        ([(0, 20), (40, 60)], [(0, 20), (40, 60)]),
        ([(3, 20), (24, 40)], [(3, 40)]),  # a gap of 4 frames
        ([(3, 20), (25, 40)], [(3, 20), (25, 40)]),  # a gap of 5 frames, 0.1 s
        ([(3, 7), (20, 25)], [(20, 25)]),
        ([(3, 6), (8, 11), (14, 17)], [(3, 17)]),
        ([], []),
    ],
)
def test_short_gaps_close_and_short_spans_go(stands, spans):
    assert contact_spans(mask(60, *stands), FPS) == spans


def test_at_low_frame_rates_a_single_frame_is_a_span():
    assert contact_spans(mask(9, (1, 2), (3, 4), (7, 9)), 4.0) == [(1, 2), (3, 4), (7, 9)]


def steps(n_frames: int, *at: tuple[int, float]) -> np.ndarray:
    """(T, 1, 3) positions of a point that jumps along x, by metres at frames."""
    x = np.zeros(n_frames)
    for frame, size in at:
        x[frame:] += size
    return path(x, 0.0, n_frames)[:, None]


@pytest.mark.parametrize(
    ("n_frames", "jump", "size", "pieces"),
    [
        (60, 30, 0.18, [(0, 60)]),  # 0.09 m to either side of the mean
        (60, 30, 0.22, [(0, 30), (30, 60)]),
        (60, 10, 0.3, [(0, 10), (10, 60)]),
        (60, 50, 0.3, [(0, 50), (50, 60)]),
        (60, 4, 5.0, [(0, 10), (10, 60)]),  # no piece is shorter than 0.2 s
        (20, 10, 0.3, [(0, 10), (10, 20)]),
        (19, 10, 0.3, [(0, 19)]),
    ],
)
def test_a_foot_that_shifts_stands_at_two_places(n_frames, jump, size, pieces):
    moving = steps(n_frames, (jump, size))
    assert split_at_movement([(0, n_frames)], moving, FPS, np.array([0.1])) == pieces
    far = np.concatenate([np.zeros((7, 1, 3)), moving])
    later = [(start + 7, stop + 7) for start, stop in pieces]
    assert split_at_movement([(7, n_frames + 7)], far, FPS, np.array([0.1])) == later


def test_pieces_are_at_least_two_frames_long():
    moving = steps(8, (1, 0.3), (4, 0.3), (7, 0.3))
    found = split_at_movement([(0, 8)], moving, 4.0, np.array([0.01]))
    assert found == [(0, 2), (2, 4), (4, 6), (6, 8)]


def test_movement_counts_relative_to_the_radius_of_its_point():
    """0.06 m at a radius of 0.02 m are more than 0.1 m at 0.2 m, and all spans stay in order."""
    both = np.concatenate([steps(90, (20, 0.1)), steps(90, (40, 0.06))], axis=1)
    spans = [(0, 60), (62, 90)]
    found = split_at_movement(spans, both, FPS, np.array([0.2, 0.02]))
    assert found == [(0, 40), (40, 60), (62, 90)]


def test_movement_is_that_of_one_point_in_space():
    """Two points 0.8 of their radius from their mean stay; one that is 1.13 away, in x and z, goes.

    The fastest frame is that of the point that is farthest from where it was, 20 of 60.
    """
    both = np.concatenate([steps(60, (30, 0.16))] * 2, axis=1)
    assert split_at_movement([(0, 60)], both, FPS, np.array([0.1, 0.1])) == [(0, 60)]
    aside = both.copy()
    aside[30:, 0, 2] += 0.16
    assert len(split_at_movement([(0, 60)], aside, FPS, np.array([0.1, 0.1]))) == 2
    aside = np.concatenate([steps(60, (20, 0.12), (40, 0.11)), steps(60, (40, 0.11))], axis=1)
    aside[20:, 0, 2] += 0.12
    assert split_at_movement([(0, 60)], aside, FPS, np.array([0.1, 0.1]))[0] == (0, 20)
