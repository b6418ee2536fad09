"""Contact spans of made-up foot paths, with limits worked out by hand.

The limits on the reference body: a foot stands below 0.2 m/s (0.6 m/s if labelled) and within 3 cm
of its floor.
"""

import numpy as np
import pytest

from gesturekit.postprocess.foot_lock import contact_frames, contact_spans, split_at_movement

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


@pytest.mark.parametrize("scale", [1.0, 2.0])
@pytest.mark.parametrize(("label", "limit"), [(None, 0.2), (0.6, 0.6)])
def test_a_foot_stands_below_a_speed_that_grows_with_the_body(scale, label, limit):
    labels = None if label is None else np.full(60, label)
    for share in (0.7, 1.4):
        stands, floor = contact_frames(sliding(share * limit * scale), FPS, scale, labels)
        assert stands.all() == stands.any() == (share < 1)
        assert floor == pytest.approx(0.05)


@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_the_floor_is_where_the_foot_stands_longest(scale):
    places = [0.0, 0.0, 0.0, 0.0, 0.0, 0.02, -0.02, 0.05]
    height = 0.05 + scale * np.repeat(places, 15)
    stands, floor = contact_frames(path(0.0, height, 120), FPS, scale, np.ones(120))
    assert floor == pytest.approx(0.05)
    # The first frame at another height is too fast, at 50 fps: 0.02 m are 1 m/s.
    expected = mask(120, (0, 75), (76, 90), (91, 105))
    np.testing.assert_array_equal(stands, expected)


@pytest.mark.parametrize(
    ("stands", "spans"),
    [
        ([(0, 20), (40, 60)], [(0, 20), (40, 60)]),
        ([(3, 20), (22, 40)], [(3, 40)]),  # a gap of 2 frames
        ([(3, 20), (30, 40)], [(3, 20), (30, 40)]),  # a gap of 10 frames, 0.2 s
        ([(3, 5), (20, 30)], [(20, 30)]),
        ([(3, 6), (8, 11), (13, 16)], [(3, 16)]),
        ([], []),
    ],
)
def test_short_gaps_close_and_short_spans_go(stands, spans):
    assert contact_spans(mask(60, *stands), FPS) == spans


def steps(n_frames: int, *at: tuple[int, float]) -> np.ndarray:
    """(T, 1, 3) positions of a point that jumps along x, by metres at frames."""
    x = np.zeros(n_frames)
    for frame, size in at:
        x[frame:] += size
    return path(x, 0.0, n_frames)[:, None]


@pytest.mark.parametrize(
    ("n_frames", "jump", "size", "pieces"),
    [
        (60, 30, 0.1, [(0, 60)]),  # 0.05 m to either side of the mean
        (60, 30, 0.3, [(0, 30), (30, 60)]),
        (60, 10, 0.3, [(0, 10), (10, 60)]),
        (60, 50, 0.3, [(0, 50), (50, 60)]),
        (60, 4, 5.0, [(0, 10), (10, 60)]),  # no piece is shorter than 0.2 s
        (12, 6, 0.3, [(0, 12)]),
    ],
)
def test_a_foot_that_shifts_stands_at_two_places(n_frames, jump, size, pieces):
    moving = steps(n_frames, (jump, size))
    assert split_at_movement([(0, n_frames)], moving, FPS, np.array([0.1])) == pieces
    far = np.concatenate([np.zeros((7, 1, 3)), moving])
    later = [(start + 7, stop + 7) for start, stop in pieces]
    assert split_at_movement([(7, n_frames + 7)], far, FPS, np.array([0.1])) == later
