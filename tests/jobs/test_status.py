"""The state of the work in a folder, from a plan and journals whose numbers are known."""

import json
from pathlib import Path

import pytest
from outputs import status

from gesturekit.jobs import PLAN, STATE, FailedItem, Task, status_of, write_plan


def result(status: str, name: str, at: float, seconds=1.0, sound=0.0, key="k", **more) -> str:
    times = {"time": at, "seconds": seconds, "sound": sound, "key": key}
    return json.dumps({"status": status, "id": name, **times, **more})


@pytest.fixture
def journals(tmp_path):
    """journals(first, second): a folder with a plan of six sounds of 10 s and two journals."""

    def write(*each: list[str]) -> Path:
        (tmp_path / STATE / "journal").mkdir(parents=True, exist_ok=True)
        tasks = [Task(name, Path(f"/in/{name}.wav"), 10.0) for name in "abcdef"]
        write_plan(tmp_path / STATE / PLAN, tasks, 2, "r")
        for number, lines in enumerate(each, start=1):
            file = tmp_path / STATE / "journal" / f"0000{number}-of-00002.jsonl"
            file.write_text("".join(f"{line}\n" for line in lines))
        return tmp_path

    return write


def test_counts_and_speed_are_those_of_the_latest_results(journals):
    """The last ten minutes of work end at 2000 s and begin with c, begun at 1370 s.

    Three items and 60 s of sound in 630 s; 20 of 60 s are left, which take 20 * 630 / 60 s.
    """
    out = journals(
        [
            result("done", "a", 1000, 20, 10),
            result("done", "c", 1400, 30, 12),
            '{"started": "e", "time": 1990}',
        ],
        [
            result("failed", "a", 900, error="a.wav: odd"),
            result("done", "z", 1700, 5, 30),
            result("failed", "b", 1800, key="k2", error="b.wav: worse"),
            result("failed", "b", 1950, key="k2", error="b.wav: worst"),
            result("done", "d", 2000, 10, 18),
        ],
    )
    found = status_of(out)
    assert (found.items, found.seconds, found.done, found.earlier) == (6, 60, 3, 1)
    assert found.failed == [FailedItem("b", "b.wav: worst", 2)] and not found.failed[0].is_aside
    assert (found.left, found.in_hand, found.running) == (["e", "f"], ["e"], [])
    assert found.sound == 70 and found.shards == [[3, 2], [3, 2]]
    assert found.items_per_minute == pytest.approx(180 / 630)
    assert found.real_time_factor == pytest.approx(60 / 630)
    assert found.seconds_left == pytest.approx(210)


def test_an_item_fails_anew_after_it_was_done_or_changed(journals):
    failed = [result("failed", "b", at, error="b.wav: odd") for at in (1, 2, 3)]
    assert status_of(journals(failed)).failed[0].is_aside
    done = result("done", "b", 4)
    again = result("failed", "b", 5, error="b.wav: odd")
    assert status_of(journals([*failed, done])).failed == []
    assert status_of(journals([*failed, done, again])).failed[0].attempts == 1
    assert status_of(journals([again], [done])).failed == [FailedItem("b", "b.wav: odd", 1)]


@pytest.mark.parametrize(
    ("values", "left"),
    [
        ({}, None),
        ({"items_per_minute": 2.0}, 90.0),
        ({"items_per_minute": 2.0, "real_time_factor": 4.0}, 7.5),
        ({"items_per_minute": 2.0, "real_time_factor": 4.0, "items": 0, "left": []}, 0.0),
    ],
)
def test_the_time_left_goes_by_sound_or_else_by_items(values, left):
    """Three of four items are left, of 40 s of sound together."""
    found = status(**{"items": 4, "seconds": 40.0, "left": ["a", "b", "c"], **values})
    assert found.seconds_left == left


def test_reasons_are_counted_without_names_and_differing_numbers():
    errors = {
        "x/one": "/in/x/one.wav: 12 samples at 16000 Hz",
        "x/two": "/in/x/two.wav: 7 samples at 16000 Hz",
        "y": "disk full near y.bvh",
    }
    found = status(failed=[FailedItem(name, error, 1) for name, error in errors.items()])
    (two, one) = found.reasons()
    assert two[1:] == (2, "x/one") and one[1:] == (1, "y")
    assert "samples at 16000 Hz" in two[0] and "12" not in two[0] and "x/" not in two[0]
    assert "disk full near" in one[0] and "y.bvh" not in one[0]
