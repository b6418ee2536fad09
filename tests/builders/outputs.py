"""Files that a run over many inputs left."""

import json
import os
from pathlib import Path
from typing import Any

from gesturekit.jobs import STATE, Status


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


def finished(out: Path) -> list[dict[str, Any]]:
    """Return the lines of the journals that say an item is done; a line may be cut short."""
    journals = [path.read_text() for path in (out / STATE / "journal").iterdir()]
    lines = [line for text in journals for line in text.splitlines() if line.endswith("}")]
    return [one for line in lines if (one := json.loads(line)).get("status") == "done"]


def status(**values: Any) -> Status:
    """Return the state of work on one second of sound that has not begun, with other values."""
    counts = {"items": 1, "seconds": 1.0, "done": 0, "sound": 0.0, "earlier": 0}
    lists = {name: [] for name in ("failed", "left", "shards", "running", "in_hand")}
    speeds = {"items_per_minute": 0.0, "real_time_factor": 0.0}
    return Status(**{**counts, **lists, **speeds, **values})
