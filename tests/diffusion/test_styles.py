"""Styles as they are asked for: names, weights, spans, and all of them together."""

from __future__ import annotations

import numpy as np
import pytest

from gesturekit.diffusion.sampling.expert_weights import style_weights
from gesturekit.errors import ModelError

NAMES = ("old", "angry", "calm:1")


@pytest.mark.parametrize(
    ("wanted", "weights"),
    [
        ("angry", (0, 1, 0)),
        ("old:0.25,angry:0.75", (0.25, 0.75, 0)),
        ("old:-0.25, angry:1.25", (-0.25, 1.25, 0)),
        ("old,angry", (0.5, 0.5, 0)),
        ("calm:1", (0, 0, 1)),
        ("calm:1:0.5,old:.5", (0.5, 0, 0.5)),
    ],
)
def test_one_mixture_at_all_times(wanted, weights):
    found = style_weights(NAMES, wanted, 40, 30.0)
    np.testing.assert_allclose(found, np.tile(weights, (40, 1)))


def test_mixtures_in_spans_become_one_another():
    found = style_weights(NAMES, "old:-0.5@0-4,angry:1.5@0-4,angry@4-8", 240, 30.0)
    np.testing.assert_allclose(found[:100], np.tile([-0.5, 1.5, 0], (100, 1)), atol=1e-6)
    np.testing.assert_allclose(found[140:], np.tile([0, 1, 0], (100, 1)), atol=1e-6)
    assert (np.diff(found[104:136, 0]) > 0).all()
    np.testing.assert_allclose(found.sum(axis=1), 1, atol=1e-6)


@pytest.mark.parametrize(
    ("wanted", "told"),
    [
        ("odl", "style 'odl': unknown; the model has old, angry"),
        ("old:0.25,angry:0.5", r"weights add up to 0\.75"),
        ("old:0.5@0-4,angry@4-8", r"weights add up to 0\.5"),
        ("old:0.5,angry", "some styles have a weight and some have none"),
        ("old@0-4,angry", "some styles have a span"),
        ("old,old", "named twice"),
        ("old@4-0", "the span ends before it begins"),
        ("old:x,angry:0.5", "unknown; the model has"),
    ],
)
def test_invalid_styles_are_refused(wanted, told):
    with pytest.raises(ModelError, match=told):
        style_weights(NAMES, wanted, 40, 30.0)
