"""Time left of a training whose steps grow dearer."""

import time

import pytest

from gesturekit.training.trainer import Steps


@pytest.fixture
def clock(monkeypatch):
    """A clock of our own, by its one entry."""
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    return now


@pytest.mark.parametrize(
    ("done", "steps", "left"),
    [(0, 5, 5 * 1.0 + 10 * 3.0), (4, 2, 4 * 1.0 + 10 * 3.0), (15, 2, 3 * 3.0)],
)
def test_time_left_weighs_steps_by_their_cost_and_leaves_out_the_first(clock, done, steps, left):
    """Each step takes two seconds for each unit of its cost, and the first a minute more."""
    progress, cost = Steps([(10, 1.0), (10, 3.0)], done, quiet=True), 3.0 if done == 15 else 1.0
    clock[0] = 60.0
    for number in range(steps):
        clock[0] += 2.0 * cost if number else 0.0
        progress.step(cost)
        assert (progress.seconds_left == 0) == (number == 0)
    assert progress.seconds_left == pytest.approx(2.0 * left)
