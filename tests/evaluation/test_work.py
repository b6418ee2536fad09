"""What is measured, in which portions, and what is read from earlier evaluations."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

from gesturekit.evaluation.measuring import work
from gesturekit.evaluation.measuring.measurer import ClipGroup, SetPart
from gesturekit.evaluation.measuring.work import measure_all
from gesturekit.evaluation.pairs import Pair


class Stand:
    """Stands for a measurer: the result of a clip or of a set is its name; some are stored."""

    def __init__(self, pairs: dict[str, list[Pair]], stored: set[str], local: tuple[str, ...]):
        self.pairs, self.local, self.done = pairs, frozenset(local), []
        read = {name: {"stored": name} for name in stored}
        self.store = SimpleNamespace(read=read.get)

    def clip_key(self, label: str, index: int) -> str:
        return f"{label} {self.pairs[label][index].name}"

    def set_key(self, part: SetPart) -> str:
        return f"{part.label} {part.part}"

    def is_portable(self, portion) -> bool:
        labels = portion.clips if isinstance(portion, ClipGroup) else [one.label for one in portion]
        return self.local.isdisjoint(labels)

    def __call__(self, portion) -> list:
        self.done.append(portion)
        if isinstance(portion, ClipGroup):
            return [(k, i, {"made": self.clip_key(k, i)}) for k, at in portion.clips.items()
                    for i in at]  # fmt: skip
        return [{"made": self.set_key(one)} for one in portion]


def pair(name: str, window: int | None = None) -> Pair:
    return Pair(name, name.partition("_")[0], window, Path("a"), Path("b"))


def measured(stored: set[str], local: tuple[str, ...] = (), workers: int = 1):
    pairs = {
        "one": [pair("b_s1"), pair("b_s2"), pair("a"), pair("c_w1", 1), pair("c_w0", 0)],
        "two": [pair("b"), pair("c_w1", 1)],
    }
    stand, seen = Stand(pairs, stored, local), []

    def progress(portions, total, label):
        seen.append((total, label))
        yield from portions

    return measure_all(stand, workers, progress), stand.done, seen


def test_clips_of_a_recording_are_a_portion_and_sets_come_last():
    found, done, seen = measured(set())
    assert [dict(portion.clips) for portion in done[:4]] == [
        {"one": [2]}, {"one": [0, 1], "two": [0]}, {"one": [4]}, {"one": [3], "two": [1]}
    ]  # fmt: skip
    sets = [SetPart(label, part) for label in ("one", "two") for part in ("frechet", "pooled")]
    assert done[4:] == [(one,) for one in sets] and seen == [(8, "measuring")]
    names = ["b_s1", "b_s2", "a", "c_w1", "c_w0"]
    assert found.clips["one"] == [{"made": f"one {name}"} for name in names]
    assert found.clips["two"] == [{"made": "two b"}, {"made": "two c_w1"}]
    assert found.sets["two"] == {
        "frechet": {"made": "two frechet"}, "pooled": {"made": "two pooled"}
    }  # fmt: skip


def test_what_is_stored_is_read_and_not_measured():
    stored = {"one b_s1", "one a", "two b", "one pooled", "two frechet", "two pooled"}
    found, done, seen = measured(stored)
    assert [dict(portion.clips) for portion in done[:-1]] == [
        {"one": [1]}, {"one": [4]}, {"one": [3], "two": [1]}
    ]  # fmt: skip
    assert done[-1] == (SetPart("one", "frechet"),) and seen == [(4, "measuring")]
    assert found.clips["one"][:2] == [{"stored": "one b_s1"}, {"made": "one b_s2"}]
    assert found.sets["one"] == {
        "pooled": {"stored": "one pooled"}, "frechet": {"made": "one frechet"}
    }  # fmt: skip
    every = stored | {f"one {n}" for n in ("b_s2", "c_w1", "c_w0", "frechet")} | {"two c_w1"}
    found, done, seen = measured(every)
    assert done == seen == [] and found.clips["two"][1] == {"stored": "two c_w1"}


def test_motion_made_in_memory_is_measured_here_after_all_else():
    found, done, _ = measured(set(), local=("one",))
    labels = [list(p.clips) if isinstance(p, ClipGroup) else [one.label for one in p] for p in done]
    assert labels[:4] == [["two"], ["two"], ["two"], ["two"]]
    assert all(one == ["one"] for one in labels[4:]) and len(labels) == 4 + 4 + 2
    assert found.clips["one"][2] == {"made": "one a"}


def test_what_two_processes_take_is_what_is_left_after_some_seconds(monkeypatch):
    """Sets are in one chain for two workers, and come before clips there; none are lost."""
    handed = []

    class Pool:
        def __init__(self, measurer, workers: int) -> None:
            self.measurer = measurer

        def map(self, portions, _):
            for portion in portions:
                handed.append(portion)
                yield portion, self.measurer(portion)

    monkeypatch.setattr(work, "Pool", Pool)
    monkeypatch.setattr(work, "IN_PROCESS_SECONDS", 0.0)
    monkeypatch.setattr(Stand, "portable", lambda self: self, raising=False)
    found, _, seen = measured(set(), workers=2)
    assert [len(chain) for chain in handed[:1]] == [4] and len(handed) == 5
    assert seen == [(5, "measuring")] and found.sets["one"]["pooled"] == {"made": "one pooled"}
    handed.clear()
    measured(set(), workers=4)
    assert [len(chain) for chain in handed[:2]] == [2, 2]
    handed.clear()
    monkeypatch.setattr(work, "IN_PROCESS_SECONDS", 60.0)
    found, done, _ = measured(set(), workers=2)
    assert handed == [] and len(done) == 5
