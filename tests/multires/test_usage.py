"""Use of the recordings, as the log and the model's README give it."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

from gesturekit.multires import TrainingConfig, usage

STEPS = TrainingConfig(batch=2, window=10.0, discriminator_steps=1, window_cache=32, renew_every=50)


@pytest.mark.parametrize(
    ("changes", "times", "percent"),
    [
        # 80 steps of two windows of 10 s are 1,600 s; two renewals of 32 windows are 640 s.
        ({}, ["1", "0.4"], ["63", "33"]),
        # Three reconstruction steps of two windows in each of 80 iterations are 4,800 s.
        (
            {"window_cache": None, "reconstruction_steps": 3, "discriminator_steps": 2},
            ["2", "3"],
            ["86", "95"],
        ),
        # Whole recordings of 400 s, one at a time.
        ({"window": None, "window_cache": None}, ["20", "20"], ["100", "100"]),
    ],
)
def test_usage_counts_windows_as_real_motion_and_to_be_reconstructed(changes, times, percent):
    words = usage(replace(STEPS, **changes), 80, 1600.0, 4)
    assert re.findall(r"about ([\d.]+) times", words) == times
    assert re.findall(r"(\d+)%", words) == percent
