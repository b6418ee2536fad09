"""Motions of any length: windows leave no seams and take no more memory."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from gesturekit.diffusion.sampler import tiles_of
from gesturekit.errors import ModelError


@pytest.mark.parametrize("size", [4, 100, 240, 9000])
@pytest.mark.parametrize("n_frames", [1, 99, 241, 1000])
def test_windows_cover_every_frame_once_in_sum(n_frames, size):
    tiles = tiles_of(n_frames, size)
    total = np.zeros(n_frames)
    for frames, weights in tiles:
        assert 0 <= frames.start < frames.stop <= n_frames
        assert len(weights) == frames.stop - frames.start <= size
        assert weights.min() >= 0
        total[frames] += weights
    np.testing.assert_allclose(total, 1, atol=1e-6)
    assert len(tiles) <= 1 + 2 * n_frames / size
    starts = [frames.start for frames, _ in tiles]
    assert starts == sorted(set(starts))
    for (before, falling), (after, rising) in itertools.pairwise(tiles):
        # One fades out while the next one fades in.
        shared = before.stop - after.start
        assert shared > 0
        assert (np.diff(rising[:shared]) >= 0).all()
        assert (np.diff(falling[-shared:]) <= 0).all()
    with pytest.raises(ModelError, match=r"(?=.*\b3\b)(?=.*\b4\b)"):
        tiles_of(n_frames, 3)


def test_a_long_motion_has_no_seams(untrained):
    model = untrained(styles=("old", "angry"))
    asked = {"seconds": 25.0, "style": "old@0-12,angry@12-25", "steps": 6, "foot_lock": False}
    whole, long = model.generate(**asked), replace(model, window=240).generate(**asked)
    # The root's steps add up, so that the least difference would show at the end.
    np.testing.assert_allclose(long.rotations, whole.rotations, atol=1e-3)
    np.testing.assert_allclose(long.translation, whole.translation, atol=1e-3)
