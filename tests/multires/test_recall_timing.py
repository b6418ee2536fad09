"""Recalled pieces at other times than recorded: stretched, and begun before the motion."""

from __future__ import annotations

import itertools
import time
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import torch

from gesturekit.multires.recall.library import time_offsets
from gesturekit.multires.recall.pieces import Pieces

FPS = 10.0


def bump(middle: float, n_frames: int = 60) -> np.ndarray:
    return 3 * np.exp(-0.5 * ((np.arange(n_frames) - middle) / 2) ** 2)


def noise(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(shape)


@pytest.mark.parametrize("late", [-6, -3, 0, 2, 4])
def test_a_gesture_is_moved_to_the_wanted_time_by_up_to_two_fifths_of_a_second(late):
    """The bump of frame 30 is asked for `late` frames later; at 10 fps, 4 frames are the most."""
    offsets = time_offsets(bump(30)[None], bump(30 + late)[None], FPS, 0.25)
    middle = 30 + np.clip(late, -4, 4)
    shown = np.interp(np.arange(60) + offsets, np.arange(60), bump(30))
    assert shown[middle - 1 : middle + 2].min() > 2.5
    assert np.abs(offsets).max() <= 4
    assert late or not offsets.any()


@pytest.mark.parametrize("stretch", [0.1, 0.25, 0.5])
def test_no_tempo_but_the_three_is_played(stretch):
    offsets = time_offsets(noise(1, 200), noise(1, 200, seed=1), FPS, stretch)
    tempos = np.unique(np.round(np.diff(offsets), 9))
    np.testing.assert_allclose(tempos, [-stretch, 0.0, stretch], atol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_of_all_paths_the_one_with_the_lowest_cost_is_found(seed):
    """Two curves of 7 frames, offsets of up to 1 frame in halves; every path is tried."""
    own, asked = 2 * noise(2, 2, 7, seed=seed)
    costs = {}
    for path in itertools.product(range(-2, 3), repeat=7):
        tempos = np.diff(path)
        if np.abs(tempos).max() <= 1:
            times = np.arange(7) + np.array(path) / 2
            shown = np.stack([np.interp(times, np.arange(7), curve) for curve in own])
            costs[path] = ((shown - asked) ** 2).sum() + 0.1 * (np.diff(tempos) ** 2).sum()
    best = np.array(min(costs, key=costs.get)) / 2
    np.testing.assert_allclose(time_offsets(own, asked, 2.5, 0.5), best, atol=1e-9)


@pytest.mark.parametrize("n_frames", [1, 2, 3])
def test_short_motions(n_frames):
    offsets = time_offsets(noise(2, n_frames), noise(2, n_frames, seed=1), FPS, 0.25)
    assert offsets.shape == (n_frames,) and np.isfinite(offsets).all()


def test_an_hour_takes_seconds_and_little_memory():
    n = 50_000  # at 14 frames per second
    own, asked = noise(2, 3, n)
    tracemalloc.start()
    began = time.process_time()
    offsets = time_offsets(own, asked, 14.0, 0.25)
    seconds, peak = time.process_time() - began, tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(offsets) == n and seconds < 20 and peak < 50e6


def times(n: int, of: int) -> np.ndarray:
    """Frame times, in frames of `of`, of `n` frames over the same duration."""
    return (np.arange(n) + 0.5) * of / n - 0.5


@pytest.mark.parametrize("power", [1, 2])
@pytest.mark.parametrize("rate", [1.0, 3.0])
def test_frames_between_recorded_ones_lie_on_a_curve(power, rate):
    """A recording of its own time, or of its square, is exact at all times."""
    offsets = 2 * np.sin(np.arange(24) / 5)
    pieces = Pieces(np.array([0, 0]), np.array([5, 15]), 10, 4, 24, offsets=offsets)
    curve = torch.arange(48.0, dtype=torch.float64)[None] ** power
    made = pieces.blend([curve], (48,), round(24 * rate))[0]
    at = times(round(24 * rate), 24)
    shown = 5 + at + np.interp(at, np.arange(24), offsets)
    np.testing.assert_allclose(made, shown**power, rtol=1e-9)


def test_a_part_of_the_frames_is_that_part_of_all():
    offsets = noise(24)
    pieces = Pieces(np.array([0, 1, 0]), np.array([5, 2, 9]), 8, 4, 24, first=3, offsets=offsets)
    curves = [torch.from_numpy(noise(3, 40, seed=k)) for k in (1, 2)]
    whole = pieces.blend(curves, (40, 40), 60)
    part = pieces.blend(curves, (40, 40), 60, slice(17, 41))
    torch.testing.assert_close(part, whole[:, 17:41], atol=1e-12, rtol=0)


def test_a_motion_may_begin_within_its_first_piece():
    curves = [10.0 * torch.arange(12)[None], 100.0 + torch.arange(12)[None]]
    whole = Pieces(np.array([0, 1]), np.array([2, 4]), hop=3, overlap=2, n_frames=8)
    rest = whole.beginning_at(2)
    assert rest.n_frames == 6
    made, every = (pieces.blend(curves, (12, 12), pieces.n_frames) for pieces in (rest, whole))
    torch.testing.assert_close(made, every[:, 2:])


def test_recorded_frames_are_counted_through_all_recordings():
    whole = Pieces(np.array([1, 0]), np.array([2, 4]), hop=3, overlap=2, n_frames=8)
    assert whole.recorded_frames((12, 12)).tolist() == [14, 15, 16, 4, 5, 6, 7, 8]
    later = replace(whole.beginning_at(2), offsets=np.full(6, 0.5))
    assert later.recorded_frames((12, 12)).tolist() == [16.5, 4.5, 5.5, 6.5, 7.5, 8.5]


@pytest.mark.parametrize("offset", [-9.0, 9.0])
def test_offsets_beyond_both_ends_hold_the_recording(offset):
    pieces = Pieces(np.array([0]), np.array([0]), 6, 0, 6, offsets=np.full(6, offset))
    made = pieces.blend([torch.arange(6.0)[None]], (6,), 6)
    assert set(made[0].tolist()) == {0.0 if offset < 0 else 5.0}
