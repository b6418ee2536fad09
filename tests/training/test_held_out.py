"""Figures on held-out recordings, in words."""

from __future__ import annotations

from gesturekit.training.held_out import sentence


def test_sync_of_arms_that_hardly_move_is_not_praised():
    figures = {"sync": 0.79, "sync_chance": 0.2, "arm_speed_ratio": 0.01}
    assert "hardly move, so sync is not informative" in sentence(figures)
    assert "0.79" not in sentence(figures)
    assert "sync 0.79" in sentence(figures | {"arm_speed_ratio": 0.6})
