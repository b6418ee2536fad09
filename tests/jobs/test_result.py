"""What a task leaves behind: its result, the digests of settings and files, and reasons."""

import errno
import hashlib
import re
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gesturekit.errors import ConfigError
from gesturekit.jobs.result import Processor, Result, Task, json_of


def sha(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


@dataclass
class Makes(Processor):
    """Writes NAME.txt and NAME.csv, or raises `error` between them."""

    out: Path
    existing: str = "refuse"
    settings: dict[str, Any] = field(default_factory=lambda: {"seed": 1})
    written: dict[str, dict[str, Any]] = field(default_factory=lambda: {"txt": {}, "csv": {}})
    error: Exception | None = None

    def make(self, result: Result) -> None:
        for file in self.missing(result, result.id):
            if self.error is not None and file.suffix == ".csv":
                raise self.error
            time.sleep(0.02)
            file.parent.mkdir(exist_ok=True)
            file.write_text(f"{result.id}{file.suffix}")


@pytest.fixture
def task(tmp_path) -> Task:
    (tmp_path / "a.wav").write_text("sound")
    return Task("day/a", tmp_path / "a.wav", source="in/a.wav")


def test_a_result_has_what_a_rerun_needs_to_know(task, tmp_path):
    made = Makes(tmp_path / "out")
    (tmp_path / "out").mkdir()
    result = made(Result(task))
    assert (result.status, result.error, result.is_full) == ("done", None, False)
    assert (result.failures, result.killed, result.begun) == (0, 0, {})
    assert result.files == (tmp_path / "out/day/a.txt", tmp_path / "out/day/a.csv")
    assert result.input == {"input": sha(b"sound")} and result.stamp["size"] == 5
    assert result.seconds >= 0.04
    csv = result.made["day/a.csv"]
    assert csv["sha256"] == sha(b"day/a.csv")
    assert csv["made_with"] == {"seed": 1, "input": sha(b"sound")}
    # The key is that of settings, formats and input.
    others = [
        Makes(tmp_path / "out", settings={"seed": 2}),
        Makes(tmp_path / "out", written={"txt": {}, "csv": {"x": 1}}),
    ]
    assert len({result.key, *(other.key(result.input) for other in others), made.key({})}) == 4
    # What is kept is not made again.
    again = made(Result(task, kept=(tmp_path / "out/day/a.txt",)))
    assert again.files == (tmp_path / "out/day/a.csv",) and list(again.made) == ["day/a.csv"]


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (ConfigError("in/a.wav: odd\nthing"), "in/a.wav & odd thing"),
        (MemoryError(), "in/a.wav & memory"),
        (RuntimeError("CUDA out of memory"), "in/a.wav & CUDA out of memory"),
        (OSError(errno.EACCES, "Permission denied", "/tmp/.a-x.csv"), "{out} & Permission denied"),
        (KeyError("b\udcff"), r"in/a.wav & KeyError & 'b\\udcff'"),
    ],
)
def test_a_failure_is_one_line_that_names_the_input_or_the_file(task, tmp_path, error, says):
    result = Makes(tmp_path / "out", error=error)
    (tmp_path / "out").mkdir()
    result = result(Result(task))
    assert (result.status, result.is_full) == ("failed", False)
    facts = says.format(out=tmp_path / "out/day/a.csv").split(" & ")
    assert all(re.search(fact, result.error) for fact in facts) and "\n" not in result.error
    assert result.files == (tmp_path / "out/day/a.txt",) and list(result.made) == ["day/a.txt"]


def test_a_full_disk_is_no_failure_of_its_input(task, tmp_path):
    (tmp_path / "out").mkdir()
    full = Makes(tmp_path / "out", error=OSError(errno.ENOSPC, "No space left on device"))
    result = full(Result(task, begun={"txt": {}}))
    assert (result.status, result.is_full) == ("dropped", True)
    assert (result.failures, result.begun) == (0, {"txt": {}})


def test_failures_count_for_the_same_settings_since_the_last_success(task, tmp_path):
    (tmp_path / "out").mkdir()
    result, counts = Result(task), []
    for settings, fails in (({}, True), ({}, True), ({"seed": 2}, True), ({}, True), ({}, False)):
        error = ConfigError("odd") if fails else None
        result.files, result.error = (), None
        result = Makes(tmp_path / "out", settings=settings, error=error)(result)
        counts.append(result.failures)
    assert counts == [1, 2, 1, 1, 0]


def test_equal_settings_have_equal_descriptions(tmp_path):
    for plain in (None, True, 3, 0.5, "text", [1, [2]], {"a": None}):
        assert json_of(plain) == plain
    file = tmp_path / "a.bvh"
    file.write_text("motion")
    assert json_of(file) == f"sha256:{sha(b'motion')}"
    numbers = np.arange(6, dtype=np.float32)
    same = [json_of(values) for values in (numbers, numbers.copy())]
    others = [numbers + 1, numbers.reshape(2, 3), numbers.reshape(3, 2), numbers.view("i4")]
    assert len({*same, *map(json_of, others)}) == 5
