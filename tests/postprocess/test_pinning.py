"""Pins of a point that stands at x = 0 on a floor of height 0, at 100 fps, worked out by hand.

Corrections fade within 0.15 s, or more slowly if they would be faster than 0.3 m/s.
"""

import numpy as np
import pytest

from gesturekit.postprocess.foot_lock import pin, soft_clamp

FPS, RADIUS, FASTEST = 100.0, 0.4, 0.3
SMALL = 0.01
"""Metres; a correction that fades within 0.15 s, 15 frames."""


def pinned(places, *spans, radius: float = RADIUS, lifts=0.0, fps: float = FPS):
    return pin(places, list(spans), 0.0, fps, radius, FASTEST, np.broadcast_to(lifts, len(places)))


def at_heights(n_frames: int, *heights: tuple[int, int, float]) -> np.ndarray:
    """(T, 3) positions of a point at heights from one frame to another, else on the floor."""
    places = np.zeros((n_frames, 3))
    for start, stop, height in heights:
        places[start:stop, 1] = height
    return places


def speeds(offset: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.diff(offset, axis=0), axis=-1) * FPS


def test_a_point_stays_at_its_mean_place_on_the_floor():
    rng = np.random.default_rng(0)
    places = rng.uniform(-0.01, 0.01, (60, 3))
    offset, hold = pinned(places, (0, 60))
    there = places + offset
    np.testing.assert_allclose(there[:, [0, 2]], np.tile(places.mean(axis=0)[[0, 2]], (60, 1)))
    np.testing.assert_allclose(there[:, 1], 0, atol=1e-12)
    assert (hold == 1).all()


def test_large_corrections_are_compressed_to_the_radius():
    lengths = np.linspace(0, 0.5, 101)
    for way in ([0.6, 0.0, -0.8], [0.0, 1.0, 0.0]):
        clamped = soft_clamp(np.outer(lengths, way), 0.1)
        kept = clamped @ way
        np.testing.assert_allclose(clamped, np.outer(kept, way), atol=1e-12)
        np.testing.assert_allclose(kept[lengths < 0.06], lengths[lengths < 0.06])
        assert (np.diff(kept) >= 0).all() and 0.09 < kept[-1] <= 0.1
        assert np.diff(kept).max() < 0.0051, "no faster than what is compressed"
    # Half of the frames at x, half at -x: their mean lies between.
    for length, least in ((0.02, 0.02), (3.0, 0.09)):
        places = np.zeros((60, 3))
        places[:, 0] = np.repeat([length, -length], 30)
        moved = pinned(places, (0, 60), radius=0.1)[0][:, 0] * np.repeat([-1, 1], 30)
        assert least - 1e-9 <= moved.min() and moved.max() <= min(length, 0.1) + 1e-9


@pytest.mark.parametrize("height", [SMALL, 0.06, 0.12])
def test_corrections_fade_smoothly_at_a_limited_speed(height):
    """A point below the floor is raised while it stands, and a little before and after."""
    offset, hold = pinned(at_heights(300, (0, 300, -height)), (100, 200))
    assert offset[100:200, 1] == pytest.approx(height)
    assert not offset[:, [0, 2]].any()
    assert not offset[[0, -1]].any()
    np.testing.assert_allclose(offset[:, 1], offset[::-1, 1], atol=1e-12)
    np.testing.assert_allclose(offset[:, 1] / height, hold, atol=1e-12)
    assert (np.diff(hold[199:]) <= 0).all() and np.abs(np.diff(hold, 2)).max() < 0.04
    assert speeds(offset).max() < 0.3
    if height == SMALL:  # 1 - x² (3 - 2x) at 4, 8, 12 and 16 sixteenths
        assert hold[[203, 207, 211, 215]] == pytest.approx([27 / 32, 1 / 2, 5 / 32, 0])


def test_a_foot_is_lowered_while_it_stands_and_not_in_flight():
    offset, hold = pinned(at_heights(300, (0, 300, SMALL)), (100, 200))
    assert not offset[:100].any() and not offset[200:].any()
    assert offset[[196, 192, 188, 184], 1] == pytest.approx(
        [-SMALL * x / 32 for x in (5, 16, 27, 32)]
    )
    assert hold[[203, 207]] == pytest.approx([27 / 32, 1 / 2])
    np.testing.assert_allclose(offset, offset[::-1], atol=1e-12)


def test_a_point_that_descends_comes_down_within_twice_the_blend():
    """It keeps its height for 0.15 s of its span, and loses it in as much time."""
    places = at_heights(400, (90, 140, SMALL), (260, 310, SMALL))
    offset = pinned(places, (100, 300))[0][:, 1]
    there = [-SMALL * x / 27 for x in (0, 7, 20, 27, 27)]  # x² (3 - 2x) at 0, 1/3, 2/3 and 1
    assert offset[[115, 120, 125, 130, 139]] == pytest.approx(there, abs=1e-12)
    np.testing.assert_allclose(offset, offset[::-1], atol=1e-12)
    places = at_heights(300, (0, 40, SMALL), (260, 300, SMALL))
    shown = pinned(places, (0, 300))[0][:, 1]
    assert shown[[0, 39, 260, 299]] == pytest.approx(-SMALL), "neither its landing nor its leaving"


def test_across_a_short_gap_the_correction_goes_from_one_to_the_other():
    """From -4 mm to 4 mm within 20 frames."""
    places = at_heights(140, (0, 70, 0.004), (70, 140, -0.004))
    offset, hold = pinned(places, (0, 60), (80, 140))
    assert offset[:60, 1] == pytest.approx(-0.004) and offset[80:, 1] == pytest.approx(0.004)
    assert (hold == 1).all()
    between = offset[59:81, 1]
    assert (np.diff(between) > 0).all()
    np.testing.assert_allclose(between, -between[::-1], atol=1e-12)
    assert np.abs(np.diff(offset[:, 1], 2)).max() < 1e-4, "smoothly: a jump would be 8 mm"
    assert between[7] == pytest.approx(-0.004 + 0.008 * 7 / 27)  # a third of the 21 frames
