"""Motions of any length: windows leave no seams and take no more memory."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gesturekit.diffusion.sampling.experts import Expert, ProductOfExperts
from gesturekit.diffusion.sampling.tiling import OVERLAP, tiled, tiles_of
from gesturekit.errors import ModelError
from gesturekit.training.seeds import rng_for


@pytest.mark.parametrize("size", [4, 100, 240, 9000])
@pytest.mark.parametrize("n_frames", [1, 99, 101, 241, 1000, 20011])
def test_windows_cover_every_frame_once_in_sum(n_frames, size):
    tiles = tiles_of(n_frames, size)
    total = np.zeros(n_frames)
    for tile in tiles:
        assert 0 <= tile.first < tile.last <= n_frames
        assert len(tile.weights) == tile.last - tile.first <= size
        assert tile.weights.min() >= 0
        total[tile.first : tile.last] += tile.weights
    np.testing.assert_allclose(total, 1, atol=1e-6)
    overlap = min(OVERLAP, size // 4)
    assert len(tiles) <= max(1, -(-n_frames // (size - overlap)))
    # As few and as short as that, evenly spaced.
    lengths = {len(tile.weights) for tile in tiles}
    assert len(lengths) == 1
    if n_frames > size:
        short = (len(tiles) - 1) * (size - overlap) + overlap
        assert short < n_frames
        spare = len(tiles) * min(lengths) - (len(tiles) - 1) * overlap - n_frames
        assert 0 <= spare < len(tiles)
        steps = np.diff([tile.first for tile in tiles])
        assert np.ptp(steps) <= 1 and tiles[0].first == 0 and tiles[-1].last == n_frames
    for k in range(0, len(tiles) - 1, 1 + len(tiles) // 50):
        before, after = tiles[k : k + 2]
        # Of the frames that two share, each third counts as one, both and the other.
        shared = before.last - after.first
        assert shared >= overlap
        share = np.clip(3 * (np.arange(shared) + 0.5) / shared - 1, 0, 1)
        np.testing.assert_allclose(after.weights[:shared], share, atol=1e-6)
        np.testing.assert_allclose(before.weights[-shared:], 1 - share, atol=1e-6)
    with pytest.raises(ModelError, match="at least 4"):
        tiles_of(n_frames, 3)


def test_a_windowed_prediction_is_that_of_the_whole(untrained):
    """Frames at a window's border see less than they should: none of them may count."""
    model = untrained(styles=("old",))
    rng = rng_for("windows")
    condition = torch.randn(1, 700, 1, generator=rng)
    noisy = torch.randn(1, 700, model.network.n_motion, generator=rng)
    product = ProductOfExperts([Expert(model.network, model.schedule, condition)], [1.0])
    whole = product.predict(noisy, 40)
    torch.testing.assert_close(tiled(product, 240)(noisy, 40), whole, atol=2e-5, rtol=0)
    cut = torch.cat([product.part(k, k + 140).predict(noisy[:, k : k + 140], 40)
                     for k in range(0, 700, 140)], 1)  # fmt: skip
    assert (cut - whole).abs().max() > 2e-3


def test_a_long_motion_has_no_seams_and_its_windows_stay_short(untrained, monkeypatch):
    model = untrained(styles=("old", "angry"))
    asked = {"seconds": 25.0, "style": "old@0-12,angry@12-25", "steps": 6, "foot_lock": False}
    whole = model.generate(**asked)
    seen = []
    for_condition = type(model.network).for_condition

    def watched(network, condition, steps):
        seen.append(condition.shape[1])
        return for_condition(network, condition, steps)

    monkeypatch.setattr(type(model.network), "for_condition", watched)
    model = replace(model, window=240)
    long = model.generate(**asked)
    assert max(seen) <= 240 < len(long.rotations) == 750
    # The root's steps add up, so that the least difference would show at the end.
    np.testing.assert_allclose(long.rotations, whole.rotations, atol=1e-3)
    np.testing.assert_allclose(long.translation, whole.translation, atol=1e-3)
    # Each style runs where it has a say: fewer windows than twice as many.
    n_tiles = len(tiles_of(750, 240))
    assert n_tiles * 6 < len(seen) < 2 * n_tiles * 6
    seen.clear()
    replace(model, window=749).generate(**asked | {"steps": 1})
    assert max(seen) <= 749, "two tiles"
