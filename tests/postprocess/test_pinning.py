"""Pins of a point that stands at x = 0 on a floor of height 0, at 100 fps, worked out by hand.

Corrections fade by the smoothstep 3 x^2 - 2 x^3 within 0.15 s, or more slowly if they would be
faster than 0.3 m/s.
"""

from __future__ import annotations

import numpy as np
import pytest

from gesturekit.postprocess.pinning import pin, soft_clamp

FPS, RADIUS, FASTEST = 100.0, 0.4, 0.3
SMALL = 0.01
"""Metres; a correction that fades within 0.15 s, 15 frames."""


def pinned(places, *spans, radius: float = RADIUS, lifts=0.0, fps: float = FPS):
    return pin(places, list(spans), 0.0, fps, radius, FASTEST, lifts)


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


def test_without_spans_nothing_is_corrected():
    offset, hold = pinned(np.ones((60, 3)))
    assert not offset.any() and not hold.any()


@pytest.mark.parametrize(
    ("length", "kept"),
    [
        (0.02, 0.02),
        (0.075, 0.075),
        # Beyond 3/4 of the radius the rest is compressed: 0.075 + 0.025 (1 - exp(-1)) ...
        (0.1, 0.0908),
        (0.125, 0.09662),  # ... and with exp(-2)
        (3.0, 0.1),
    ],
)
def test_large_corrections_are_compressed_to_the_radius(length, kept):
    offset = length * np.array([[0.6, 0.0, -0.8], [0.0, 1.0, 0.0]])
    expected = kept * np.array([[0.6, 0.0, -0.8], [0.0, 1.0, 0.0]])
    np.testing.assert_allclose(soft_clamp(offset, 0.1), expected, atol=1e-5)
    # Half of the frames at x, half at -x: their mean lies between.
    places = np.zeros((60, 3))
    places[:, 0] = np.repeat([length, -length], 30)
    corrected, _ = pinned(places, (0, 60), radius=0.1)
    np.testing.assert_allclose(corrected[:, 0], np.repeat([-kept, kept], 30), atol=1e-5)


def test_no_correction_stays_none():
    assert not soft_clamp(np.zeros((3, 3)), 0.1).any()


@pytest.mark.parametrize(
    ("height", "frames"),
    [(SMALL, 15), (0.06, 30), (0.12, 60)],  # 1.5 * 0.06 m / 0.3 m/s = 0.3 s
)
def test_corrections_fade_in_a_smoothstep_of_limited_speed(height, frames):
    """A point below the floor is raised while it stands, and a little before and after."""
    offset, hold = pinned(at_heights(300, (0, 300, -height)), (100, 200))
    assert offset[100:200, 1] == pytest.approx(height)
    assert not offset[:, [0, 2]].any()
    beside = offset[:, 1] > 1e-12
    assert np.flatnonzero(beside).tolist() == list(range(100 - frames, 200 + frames))
    np.testing.assert_allclose(offset[:, 1], offset[::-1, 1], atol=1e-12)
    np.testing.assert_allclose(offset[:, 1] / height, hold, atol=1e-12)
    # Frame k after the span has the share (k + 1) / (frames + 1) of the way behind it: smoothstep
    # is 5/32 at a quarter and 1/2 at a half.
    behind = np.arange(frames + 2) / (frames + 1)
    way = np.interp([0.25, 0.5, 0.75], behind, hold[199:][: frames + 2])
    assert way == pytest.approx([27 / 32, 1 / 2, 5 / 32], abs=0.004)
    assert speeds(offset).max() < 0.3
    assert speeds(offset).max() > 0.28 or height == SMALL


def test_fades_begin_at_the_first_and_last_correction_of_a_contact():
    """A point slides at 0.4 m/s: the first and last of 20 frames are 0.038 m off their mean.

    1.5 * 0.038 m / 0.3 m/s are 19 frames; the middle one has half of that.
    """
    places = np.zeros((100, 3))
    places[:, 0] = 0.004 * np.arange(100)
    offset, _ = pinned(places, (40, 60))
    assert offset[[40, 59], 0] == pytest.approx([0.038, -0.038])
    assert offset[[30, 69], 0] == pytest.approx([0.019, -0.019])
    assert offset[[20, 79], 0] == pytest.approx([0.0, 0.0], abs=1e-12)


def test_a_point_above_the_floor_is_lowered_only_while_it_stands():
    """A point in flight would be pulled to the floor, and slide there."""
    offset, hold = pinned(at_heights(120, (0, 120, SMALL)), (40, 80))
    assert not offset[:40].any() and not offset[80:].any()
    np.testing.assert_allclose(offset[:, 1], offset[::-1, 1], atol=1e-12)
    assert offset[55:65, 1] == pytest.approx(-SMALL)
    # Frame k of the span has the share (k + 1) / 16 of 15 frames behind it: 1/16, 1/2, 15/16.
    shares = [(3 - 2 / 16) / 16**2, 1 / 2, 1 - (3 - 2 / 16) / 16**2]
    assert offset[[40, 47, 54], 1] == pytest.approx(-SMALL * np.array(shares))
    expected = [0, shares[0], 1 / 2, 1, 1, 1 / 2, 0]
    assert hold[[24, 25, 32, 40, 79, 87, 95]] == pytest.approx(expected, abs=1e-12)


def test_a_short_contact_is_lowered_by_its_middle():
    """A contact of 10 frames leaves 5 for either side: 1/6, 2/6, ... of the way down."""
    offset, _ = pinned(at_heights(120, (0, 120, SMALL)), (50, 60))
    way = np.arange(1, 6) / 6
    expected = -SMALL * way**2 * (3 - 2 * way)
    np.testing.assert_allclose(offset[50:60, 1], [*expected, *expected[::-1]], atol=1e-12)


def test_a_foot_that_is_put_down_and_lifted_keeps_its_height():
    """It is on its way for 0.15 s on either side: at first 3 cm above the floor, at last 2 cm."""
    places = at_heights(160)
    places[30:45, 1] = np.linspace(0.03, 0.0, 15)
    places[115:130, 1] = np.linspace(0.0, 0.02, 15)
    offset, _ = pinned(places, (30, 130))
    np.testing.assert_allclose(offset, 0, atol=1e-12)
    offset, _ = pinned(places[29:131], (1, 101))
    np.testing.assert_allclose(offset, 0, atol=1e-12)
    # A contact that lasts from the first to the last frame has no landing and no leaving.
    offset, _ = pinned(places[30:130], (0, 100))
    np.testing.assert_allclose(offset[:, 1], -places[30:130, 1], atol=1e-12)


def test_what_is_above_the_floor_in_the_middle_of_a_contact_is_no_landing():
    places = at_heights(160, (70, 80, 0.02))
    offset, _ = pinned(places, (30, 130))
    np.testing.assert_allclose(offset[:, 1], -places[:, 1], atol=1e-12)


def test_a_landing_that_lasts_is_cut_short():
    """From 0.15 to 0.3 s: at 0.21 s the share is 0.4, whose smoothstep is 0.352."""
    places = at_heights(200, (20, 55, SMALL), (145, 180, SMALL))
    offset, _ = pinned(places, (20, 180))
    height = (places + offset)[:, 1]
    assert height[20:36] == pytest.approx(SMALL)
    assert height[20 + 21] == pytest.approx(SMALL * (1 - 0.352))
    assert height[50:150] == pytest.approx(0.0)
    np.testing.assert_allclose(height[20:180], height[20:180][::-1], atol=1e-12)


def test_a_lifted_heel_stays_lifted():
    lifts = np.where(np.arange(80) >= 40, 0.03, 0.0)
    offset, _ = pinned(np.zeros((80, 3)), (10, 70), lifts=lifts)
    assert offset[10:70, 1] == pytest.approx(lifts[10:70])


def test_a_gap_long_enough_for_both_fades_returns_to_the_motion():
    """Two fades of 15 frames need a gap of 30; in one of 29 the pin goes straight across."""
    for gap, straight in ((30, False), (29, True)):
        places = at_heights(100 + gap, (0, 100 + gap, -SMALL))
        offset, hold = pinned(places, (10, 50), (50 + gap, 90 + gap))
        assert (hold[50 : 50 + gap] == 1).all() == straight
        middle = offset[50 + gap // 2, 1]
        assert middle == pytest.approx(SMALL) if straight else middle < 0.02 * SMALL


def test_across_a_short_gap_the_correction_goes_from_one_to_the_other():
    """From -4 mm to 4 mm within 20 frames; 10 cm apart would take half a second."""
    places = at_heights(140, (0, 70, 0.004), (70, 140, -0.004))
    offset, hold = pinned(places, (0, 60), (80, 140))
    assert offset[:60, 1] == pytest.approx(-0.004) and offset[80:, 1] == pytest.approx(0.004)
    assert (hold == 1).all()
    share = np.arange(1, 21) / 21
    expected = -0.004 + 0.008 * share**2 * (3 - 2 * share)
    np.testing.assert_allclose(offset[60:80, 1], expected, atol=1e-12)


@pytest.mark.parametrize(
    ("gap", "length", "before", "after"),
    [
        (10, 60, 5, 5),  # 0.2 s, 20 frames, for 4 cm: 5 more on either side
        (11, 60, 5, 5),  # 9 missing, rounded up
        (19, 60, 1, 1),
        (10, 6, 3, 3),  # half of a span at most
        (20, 60, 0, 0),
    ],
)
def test_a_gap_too_short_for_its_correction_is_extended_into_contacts(gap, length, before, after):
    n = 2 * length + gap
    places = at_heights(n, (0, length + gap // 2, 0.02), (length + gap // 2, n, -0.02))
    offset, _ = pinned(places, (0, length), (length + gap, n))
    start, stop = length - before, length + gap + after
    assert offset[:start, 1] == pytest.approx(-0.02) and offset[stop:, 1] == pytest.approx(0.02)
    share = np.arange(1, stop - start + 1) / (stop - start + 1)
    expected = -0.02 + 0.04 * share**2 * (3 - 2 * share)
    np.testing.assert_allclose(offset[start:stop, 1], expected, atol=1e-12)


def test_the_correction_goes_on_to_the_ends_if_they_are_near():
    """15 frames would be needed to fade."""
    offset, hold = pinned(at_heights(80, (0, 80, -SMALL)), (14, 66))
    assert offset[:, 1] == pytest.approx(SMALL) and (hold == 1).all()
    offset, hold = pinned(at_heights(82, (0, 82, -SMALL)), (15, 67))
    assert offset[0, 1] < 0.02 * SMALL and offset[-1, 1] < 0.02 * SMALL


def test_fades_take_a_frame_at_the_least():
    offset, hold = pinned(at_heights(9, (0, 9, -SMALL)), (3, 6), fps=3.0)
    assert hold.tolist() == [0, 0, 0.5, 1, 1, 1, 0.5, 0, 0]
    np.testing.assert_allclose(offset[:, 1], SMALL * hold, atol=1e-12)
