"""The state of the work in a folder, from records whose numbers are known."""

import pytest
from outputs import status

from gesturekit.jobs.records import (
    STATE,
    shard_of,
    status_of,
    write_items,
    write_record,
)
from gesturekit.jobs.result import Result, Task


def test_counts_and_speed_are_those_of_the_latest_results(tmp_path):
    """The last ten minutes of work end at 2000 s and begin with c, begun at 1370 s.

    Three items and 60 s of sound in 630 s; two more take 2 * 630 / 3 s.
    """
    state = tmp_path / STATE
    write_items(state, [*"abcdef"], 2, {})
    for name, at, seconds, sound in (
        ("a", 1000, 20, 10),
        ("c", 1400, 30, 12),
        ("z", 1700, 5, 30),
        ("d", 2000, 10, 18),
        ("y", float("nan"), 1, 0),
    ):
        times = {"time": float(at), "seconds": float(seconds), "sound": float(sound)}
        write_record(state, Result(Task(name), "done", **times))
    write_record(state, Result(Task("b"), "failed", error="b.wav: worst", failures=2))
    write_record(state, Result(Task("e"), "begun"))
    write_record(state, Result(Task("f"), "dropped"))
    found = status_of(tmp_path)
    assert (found.items, found.done, found.earlier, found.sound) == (6, 3, 2, 70)
    (failed,) = found.failed
    assert (failed.id, failed.error, failed.failures) == ("b", "b.wav: worst", 2)
    assert not failed.is_aside
    assert (found.left, found.in_hand, found.running) == (["e", "f"], ["e"], [])
    numbers = [shard_of(name, 2) for name in "abcdef"]
    ended = [shard_of(name, 2) for name in "abcd"]
    assert found.shards == [[numbers.count(n), ended.count(n)] for n in (1, 2)]
    assert found.items_per_minute == pytest.approx(180 / 630)
    assert found.real_time_factor == pytest.approx(60 / 630)
    assert found.seconds_left == pytest.approx(420)


def test_the_time_left_goes_by_items():
    """Three of four items are left."""
    found = status(items=4, left=["a", "b", "c"], items_per_minute=2.0)
    assert (status().seconds_left, found.seconds_left) == (None, 90.0)


def test_reasons_are_counted_without_names_and_differing_numbers():
    errors = {
        "x/one": "/in/x/one.wav: 12 samples at 16000 Hz",
        "x/two": "/in/x/two.wav: 7 samples at 16000 Hz",
        "y": "disk full near y.bvh",
    }
    found = status(failed=[Result(Task(name), error=error) for name, error in errors.items()])
    (two, one) = found.reasons()
    assert two[1:] == (2, "x/one") and one[1:] == (1, "y")
    assert "samples at 16000 Hz" in two[0] and "12" not in two[0] and "x/" not in two[0]
    assert "disk full near" in one[0] and "y.bvh" not in one[0]
