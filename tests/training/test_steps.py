"""Time left of a training whose steps grow dearer."""

from __future__ import annotations

import pytest

from gesturekit.training.run import steps
from gesturekit.training.run.steps import Steps


@pytest.fixture
def clock(monkeypatch):
    """A clock of our own, by its one entry."""
    now = [0.0]
    monkeypatch.setattr(steps.time, "monotonic", lambda: now[0])
    return now


def test_lines_of_a_log_file_count_steps():
    with Steps([(4, 1.0)], 0, quiet=False) as bar:
        bar.step(1.0)
        bar.step(1.0)
        assert "2 of 4 steps, " in str(bar)


def test_time_left_weighs_steps_by_their_cost_and_leaves_out_the_first(clock):
    progress = Steps([(10, 1.0), (10, 3.0)], 0, quiet=True)
    clock[0] = 60.0  # compiled
    progress.step(1.0)
    assert progress.seconds_left == 0
    for _ in range(4):
        clock[0] += 2.0
        progress.step(1.0)
    assert progress.seconds_left == pytest.approx((5 * 1.0 + 10 * 3.0) * 2.0)


def test_after_three_seconds_the_time_left_is_logged_once(clock, caplog):
    """After four of 40 steps of a second, of which the first does not count: 36 s times 3 / 3."""
    caplog.set_level("INFO")
    progress, counts = Steps([(40, 1.0)], 0, quiet=False), []
    for _ in range(9):
        progress.step(1.0)
        counts.append(len(caplog.messages))
        clock[0] += 1.0
    assert counts == [0, 0, 0, 1, 1, 1, 1, 1, 1]
    assert caplog.messages == ["Time left: about 36 s for 36 of 40 steps."]
    # The bar divides the steps that are left by a rate.
    assert progress.format_dict["rate"] == pytest.approx(31 / progress.seconds_left)
    assert progress.seconds_left == pytest.approx(31 * 9 / 8)
    progress.close()
    quiet = Steps([(40, 1.0)], 0, quiet=True)
    for _ in range(9):
        quiet.step(1.0)
        clock[0] += 1.0
    assert len(caplog.messages) == 1


def test_a_resumed_training_has_less_left(clock):
    progress = Steps([(10, 1.0), (10, 3.0)], 15, quiet=True)
    progress.step(3.0)
    clock[0] += 6.0
    progress.step(3.0)
    assert progress.seconds_left == pytest.approx(3 * 6.0)
    within_the_first = Steps([(10, 1.0), (10, 3.0)], 4, quiet=True)
    for _ in range(2):
        within_the_first.step(1.0)
        clock[0] += 2.0
    assert within_the_first.seconds_left == pytest.approx((4 * 1.0 + 10 * 3.0) * 4.0)
