"""Use of the recordings, as the log and the model's README give it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from gesturekit.multires import TrainingConfig
from gesturekit.multires.training.batches import usage

STEPS = TrainingConfig(batch=2, window=10.0, discriminator_steps=1, window_cache=32, renew_every=50)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        # 80 steps of two windows of 10 s are 1,600 s; two renewals of 32 windows are 640 s.
        ({}, "as real motion about 1 times (63% at least once) and to be reconstructed about "
             "0.4 times (33% at least once)"),
        # Three reconstruction steps of two windows in each of 80 iterations are 4,800 s.
        ({"window_cache": None, "reconstruction_steps": 3, "discriminator_steps": 2},
         "as real motion about 2 times (86% at least once) and to be reconstructed about "
         "3 times (95% at least once)"),
        # Whole recordings of 400 s, one at a time.
        ({"window": None, "window_cache": None}, "as real motion about 20 times (100% at least "
         "once) and to be reconstructed about 20 times (100% at least once)"),
    ],
)  # fmt: skip
def test_usage_counts_windows(changes, text):
    assert usage(replace(STEPS, **changes), 80, 1600.0, 4) == f"each stage draws a second {text}"
