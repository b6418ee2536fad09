"""The plan: immutable, balanced, and read in parts."""

import hashlib
import json
from pathlib import Path

import pytest

from gesturekit.errors import ConfigError, FormatError
from gesturekit.jobs import Plan, Task, balanced, parse_shard, write_plan

ITEMS = [Task(f"day/{i}", Path(f"/in/{i}.wav"), float(1 + i % 7), {"seed": i}) for i in range(50)]


def test_every_item_is_in_one_shard_and_shards_are_balanced(tmp_path):
    written = write_plan(tmp_path / "plan.jsonl", ITEMS, 4, "r")
    plan = Plan.open(tmp_path / "plan.jsonl")
    assert plan == written and plan.n_items == 50
    parts = [list(plan.tasks(shard)) for shard in (1, 2, 3, 4)]
    assert [len(part) for part in parts] == [count for count, _ in plan.shards]
    together = sorted((item for part in parts for item in part), key=lambda item: int(item.id[4:]))
    assert [(i.id, i.path, i.duration, i.more) for i in together] == [
        (i.id, i.path, i.duration, i.more) for i in ITEMS
    ]
    sums = [sum(item.duration for item in part) for part in parts]
    assert max(sums) - min(sums) <= 2 and sums == [seconds for _, seconds in plan.shards]


def test_shards_are_balanced_by_duration():
    shards = balanced([5.0, 5.0, 10_000.0, 5.0, 5.0], 2)
    assert shards.count(shards[2]) == 1 and {*shards} == {1, 2}
    assert sorted(balanced([0.0] * 6, 3)) == [1, 1, 2, 2, 3, 3]


def test_a_relative_path_is_found_from_another_folder(tmp_path, monkeypatch):
    """Its name in messages stays as the user gave it."""
    monkeypatch.chdir(tmp_path)
    given = [
        Task("a", Path("in/a.wav"), source="in/a.wav"),
        Task("b", tmp_path / "b.wav", 1.5),
        Task("idle", more={"seed": 3}),
    ]
    plan = write_plan(tmp_path / "plan.jsonl", given, 1, "r")
    assert list(plan.tasks()) == [
        Task("a", tmp_path / "in/a.wav", source="in/a.wav"),
        Task("b", tmp_path / "b.wav", 1.5, source=str(tmp_path / "b.wav")),
        Task("idle", more={"seed": 3}, source="idle"),
    ]
    assert [path.name for path in tmp_path.iterdir()] == ["plan.jsonl"]


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
    with pytest.raises(FormatError, match=r"(?=.*plan\.jsonl)(?=.*delete)"):
        Plan.open(path)


@pytest.mark.parametrize(
    "line", ['{"shard": 1, "id": 3}', '{"shard": 1, "id": "a", "path": 3}', '{"shard": 1, cut']
)
def test_a_plan_of_strange_values_is_refused(tmp_path, line):
    """Lines that another program wrote, with their digest."""
    path, body = tmp_path / "plan.jsonl", f"{line}\n".encode()
    about = {"format": 1, "request": "r", "sha256": hashlib.sha256(body).hexdigest()}
    about |= {"shards": [[1, 0.0]], "made": 0.0}
    path.write_bytes(json.dumps(about).encode() + b"\n" + body)
    with pytest.raises(FormatError, match=r"(?=.*plan\.jsonl)(?=.*delete)"):
        list(Plan.open(path).tasks(1))


@pytest.mark.parametrize("text", ["0/8", "9/8", "1", "a/b", "1/100000"])
def test_shards_count_from_one(text):
    assert parse_shard("8/8") == (8, 8) and parse_shard("1/99999") == (1, 99_999)
    with pytest.raises(ConfigError, match=f"(?=.*{text})(?=.*1 to N)"):
        parse_shard(text)
