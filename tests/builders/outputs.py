"""Files that a run over many inputs left."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from gesturekit.jobs.records import STATE, Status, all_records
from gesturekit.jobs.result import Result
from gesturekit.rendering.renderer import render_batch


def render(*arguments: Any, **settings: Any) -> Iterator[Result]:
    """Yield the results of `render_batch` with these arguments."""
    return render_batch(*arguments, **settings).run()


def results(out: Path) -> dict[str, bytes]:
    """Return the bytes of each file but those of state; nothing temporary may be left."""
    files = [path for path in out.rglob("*") if path.is_file() and STATE not in path.parts]
    assert not [path for path in files if path.name.startswith(".")]
    return {path.relative_to(out).as_posix(): path.read_bytes() for path in files}


def bury(folder: Path) -> None:
    """Make folders in a folder until the path of the last is too long for anybody to open it."""
    here = Path.cwd()
    os.chdir(folder)
    for _ in range(17):
        Path("x" * 250).mkdir()
        os.chdir("x" * 250)
    os.chdir(here)


def finished(out: Path) -> list[Result]:
    """Return the results of the items that are done."""
    return [result for result in all_records(out / STATE) if result.status == "done"]


def status(**values: Any) -> Status:
    """Return the state of work on one item that has not begun, with other values."""
    counts = {"items": 1, "done": 0, "sound": 0.0, "earlier": 0}
    lists = {name: [] for name in ("failed", "left", "shards", "running", "in_hand")}
    speeds = {"items_per_minute": 0.0, "real_time_factor": 0.0}
    return Status(**{**counts, **lists, **speeds, **values})
