"""The plan: immutable, balanced, and read in parts."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from gesturekit.errors import ConfigError, FormatError
from gesturekit.jobs.plan import Plan, PlanItem, balanced, parse_shard, write_plan

ITEMS = [PlanItem(f"day/{i}", f"in/{i}.wav", float(1 + i % 7), {"seed": i}) for i in range(50)]


def test_every_item_is_in_one_shard_and_shards_are_balanced(tmp_path):
    written = write_plan(tmp_path / "plan.jsonl", ITEMS, 4, "r")
    plan = Plan.open(tmp_path / "plan.jsonl")
    assert plan == written and plan.n_items == 50
    parts = [list(plan.items(shard)) for shard in (1, 2, 3, 4)]
    assert [len(part) for part in parts] == [count for count, _ in plan.shards]
    together = sorted((item for part in parts for item in part), key=lambda item: int(item.id[4:]))
    assert [(i.id, i.path, i.duration, i.more) for i in together] == [
        (i.id, i.path, i.duration, i.more) for i in ITEMS
    ]
    sums = [sum(item.duration for item in part) for part in parts]
    assert max(sums) - min(sums) <= 2 and sums == [seconds for _, seconds in plan.shards]
    assert list(plan.items()) == sorted(together, key=lambda item: int(item.id[4:]))


def test_one_long_item_has_a_shard_of_its_own():
    assert balanced([5.0, 5.0, 10_000.0, 5.0, 5.0], 2) == [2, 2, 1, 2, 2]


def test_unknown_durations_are_spread():
    assert sorted(balanced([0.0] * 6, 3)) == [1, 1, 2, 2, 3, 3]


def test_odd_names_survive(tmp_path):
    odd = [PlanItem('a "quoted" \\ name\n', "b\udcff.wav"), PlanItem("漢字 🎤")]
    write_plan(tmp_path / "plan.jsonl", odd, 1, "r")
    assert [(i.id, i.path) for i in Plan.open(tmp_path / "plan.jsonl").items(1)] == [
        (i.id, i.path) for i in odd
    ]


@pytest.mark.parametrize("damage", ["cut", "changed", "newer", "empty", "other"])
def test_a_damaged_plan_is_refused(tmp_path, damage):
    path = tmp_path / "plan.jsonl"
    write_plan(path, ITEMS, 2, "r")
    text = path.read_text()
    path.write_text(
        {
            "cut": text[:-30],
            "changed": text.replace("in/7.wav", "in/8.wav"),
            "newer": text.replace('"format": 1', '"format": 2'),
            "empty": "",
            "other": json.dumps({"format": 1, "shards": "many"}) + "\n",
        }[damage]
    )
    with pytest.raises(FormatError, match="plan.jsonl: .*delete it"):
        Plan.open(path)


@pytest.mark.parametrize("text", ["0/8", "9/8", "1", "a/b", "1/", "/8", "1/100000", "-1/2"])
def test_shards_count_from_one(text):
    assert parse_shard("8/8") == (8, 8)
    with pytest.raises(ConfigError, match="expected a number of 1 to N"):
        parse_shard(text)


MILLION = """
import json, resource, sys, time
from pathlib import Path
from gesturekit.jobs.plan import Plan
begin = time.monotonic()
items = list(Plan.open(Path(sys.argv[1])).items())
took = time.monotonic() - begin
print(json.dumps([len(items), took, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss]))
"""


@pytest.mark.stress
def test_a_plan_of_a_million_items(tmp_path):
    path = tmp_path / "plan.jsonl"
    names = (f"folder {i % 97}/{i:07d}" for i in range(10**6))
    items = (PlanItem(name, f"/in/{name}.wav", 5.0) for name in names)
    write_plan(path, list(items), 100, "r")
    done = subprocess.run([sys.executable, "-c", MILLION, path], capture_output=True, check=True)
    count, seconds, kilobytes = json.loads(done.stdout)
    assert count == 10**6 and seconds < 10 and kilobytes < 1e6
