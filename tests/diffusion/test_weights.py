"""Weights of experts over time, as they are asked for."""

from __future__ import annotations

import numpy as np
import pytest

from gesturekit.diffusion.sampling.expert_weights import weight_track, weights_over_time
from gesturekit.errors import ModelError


def test_spans_are_cross_faded_and_weights_are_zero_outside_of_them():
    found = weight_track("-0.5@4-8, 1.5@8-12", 480, 30.0)
    np.testing.assert_array_equal(found[:104], 0)
    np.testing.assert_allclose(found[140:220], -0.5)
    np.testing.assert_allclose(found[260:340], 1.5)
    np.testing.assert_array_equal(found[376:], 0)
    assert (np.diff(found[105:135]) < 0).all() and (np.diff(found[226:254]) > 0).all()
    apart = weight_track("1@0-2,1@6-8", 240, 30.0)
    assert apart[[0, 30, 120, 210]].tolist() == [1, 1, 0, 1]


def test_experts_without_a_weight_share_the_remaining_weight():
    prior, half, own = weights_over_time(["0.5@0-4", 0.25, None], 240, 30.0)
    assert half.tolist() == [0.25]
    np.testing.assert_allclose(own, 0.75 - prior)
    np.testing.assert_allclose(prior[[0, -1]], [0.5, 0])
    assert [w.tolist() for w in weights_over_time([None, 0.4, None], 9, 30.0)] == [
        pytest.approx([0.3]), [0.4], pytest.approx([0.3]),
    ]  # fmt: skip


@pytest.mark.parametrize("text", ["@0-4", "0.5@4", "much@0-4", "0.5@0-4,0.5", "0.5@4-2", "x:1@0-4"])
def test_unreadable_weights_are_refused(text):
    with pytest.raises(ModelError, match=r"weight|span"):
        weight_track(text, 60, 30.0)
    with pytest.raises(ModelError, match="one for each frame"):
        weights_over_time([None, np.ones(7)], 60, 30.0)
