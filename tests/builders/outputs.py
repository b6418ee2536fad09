"""Files that a run over many inputs left."""

from __future__ import annotations

from pathlib import Path

from gesturekit.jobs.state import STATE


def results(out: Path) -> dict[str, bytes]:
    """Return the bytes of each file but those of state; nothing temporary may be left."""
    files = [path for path in out.rglob("*") if path.is_file() and STATE not in path.parts]
    assert not [path for path in files if path.name.startswith(".")]
    return {path.relative_to(out).as_posix(): path.read_bytes() for path in files}
