"""Hidden folder with the state of the work in an output folder: plan, journals, leases."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from gesturekit.errors import ConfigError, FormatError

STATE = ".gesturekit"
"""Name of the folder of state in an output folder."""
FORMAT = 1
"""Number of the format of plans and journals."""
MAX_LINE = 1 << 20
"""Longest line of a plan or journal, in bytes; nothing that we write comes near it."""


def state_folder(out: Path) -> Path:
    """Return the folder of state of an output folder; neither need exist.

    Raises:
        ConfigError: it, or something in it, is a symbolic link.
    """
    state = out / STATE
    inside = [*state.iterdir(), *state.glob("*/*")] if state.is_dir() else []
    for path in (state, *inside):
        if path.is_symlink():
            raise ConfigError(f"{path} is a link that leads out of {out}: remove it")
    return state


def shard_name(shard: int, shards: int) -> str:
    """Return the name of a shard in files of state, such as "00001-of-00008"."""
    return f"{shard:05d}-of-{shards:05d}"


def read_lines(path: Path) -> Iterator[bytes]:
    """Yield the complete lines of a file, without the line feed.

    The last line is left out if a killed process did not finish it, and lines longer than
    `MAX_LINE` are left out.

    Raises:
        FormatError: the file cannot be opened, or is not a regular file.
    """
    if path.exists() and not path.is_file():
        raise FormatError(f"{path}: not a regular file")
    try:
        with path.open("rb") as file:
            is_inside = False  # of an overlong line
            while line := file.readline(MAX_LINE):
                is_whole = line.endswith(b"\n")
                if is_whole and not is_inside:
                    yield line[:-1]
                is_inside = not is_whole
    except OSError as error:
        raise FormatError(f"{path}: {error.strerror}") from None


def parse_line(line: bytes) -> dict[str, Any] | None:
    """Return the JSON object of a line; None for anything else."""
    try:
        values = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return values if isinstance(values, dict) else None
