"""Weights of experts and of styles over time, as they are asked for."""

import re

import numpy as np
import pytest

from gesturekit.diffusion.conditions import (
    style_weights,
    weight_track,
    weights_over_time,
)
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
    assert weight_track("1@0.9-4", 60, 30.0)[[0, 50]].tolist() == [0, 1]
    # Spans in any order, one within another: none is outside of all until the tenth second.
    found = weight_track("1@12-14,0.5@4-6,0.5@0-10,+0.5@5-7", 480, 30.0)
    assert found[[15, 100, 165, 270, 330, 390, 450]] == pytest.approx([0.5, 0.5, 0.5, 0.5, 0, 1, 0])


def test_experts_without_a_weight_share_the_remaining_weight():
    prior, half, own = weights_over_time(["0.5@0-4", 0.25, None], 240, 30.0)
    assert half.tolist() == [0.25]
    np.testing.assert_allclose(own, 0.75 - prior)
    np.testing.assert_allclose(prior[[0, -1]], [0.5, 0])
    for found, expected in zip(weights_over_time([None, 0.4, None], 9, 30.0), (0.3, 0.4, 0.3)):
        assert found.tolist() == [pytest.approx(expected)]


@pytest.mark.parametrize(
    "text", ["@0-4", "0.5@4", "much@0-4", "0.5@0-4,0.5", "0.5@4-2", "0.5@2-2", "x:1@0-4"]
)
def test_unreadable_weights_are_refused(text):
    with pytest.raises(ModelError, match=re.escape(text.split(",")[-1])):
        weight_track(text, 60, 30.0)
    with pytest.raises(ModelError, match=r"(?=.*\b7\b)(?=.*\b60\b)"):
        weights_over_time([None, np.ones(7)], 60, 30.0)


NAMES = ("old", "angry", "calm:1")


@pytest.mark.parametrize(
    ("wanted", "weights"),
    [
        ("angry", (0, 1, 0)),
        ("old:0.25,angry:0.75", (0.25, 0.75, 0)),
        ("old,angry", (0.5, 0.5, 0)),
        ("old:0.333333,angry:0.666666", (0.333333, 0.666666, 0)),
        ("calm:1", (0, 0, 1)),
        ("calm:1@0-9", (0, 0, 1)),
    ],
)
def test_one_mixture_at_all_times(wanted, weights):
    found = style_weights(NAMES, wanted, 40, 30.0)
    np.testing.assert_allclose(found, np.tile(weights, (40, 1)))


@pytest.mark.parametrize(
    ("wanted", "told"),
    [
        ("odl", "(?=.*odl)(?=.*old)(?=.*angry)"),
        ("old:0.25,angry:0.5", r"0\.75"),
        ("old:0.5,angry", "(?=.*old:0.5,angry)(?=.*weight)"),
        ("old,old", "(?=.*old,old)(?=.*twice)"),
        ("old@0-1,angry", "(?=.*old@0-1,angry)(?=.*none)"),
        ("old:0.5,angry:0.50002", r"\b1\.00002\b"),
        ("old@4-0", "old@4-0.*before"),
    ],
)
def test_invalid_styles_are_refused(wanted, told):
    with pytest.raises(ModelError, match=told):
        style_weights(NAMES, wanted, 40, 30.0)
