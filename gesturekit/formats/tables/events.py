"""Events on the time line of a recording, read from a table."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path

from gesturekit.errors import FormatError
from gesturekit.formats.tables.table import read_table

_MEGABYTES = 8
_MOST_NAMES = 1000
_LONGEST_NAME = 80  # characters
_MOST_SECONDS = 7 * 24 * 3600.0


@dataclass(frozen=True, order=True)
class Event:
    """Something that happens: a kick, a beat of the music, a nod.

    Attributes:
        time: when it begins, seconds from the beginning of the recording.
        name: what it is.
        duration: seconds; 0 for a single frame.
    """

    time: float
    name: str
    duration: float = 0.0


def load_events(path: str | os.PathLike[str]) -> tuple[Event, ...]:
    """Read a CSV table of events, in order of time.

    The first line names the columns, `time,name` or `time,name,duration` in any order: seconds
    from the beginning of the recording, a name, and seconds (empty for a single frame).

    Raises:
        FormatError: the file is missing, too large, or not such a table; with its line.
    """
    events: list[Event] = []
    names: set[str] = set()
    for where, cells in read_table(Path(path), ("time", "name"), ("duration",), _MEGABYTES):
        name = cells["name"]
        if not name or len(name) > _LONGEST_NAME or not name.isprintable():
            raise FormatError(
                f"{where}: name is {name[:40]!r}; expected 1 to {_LONGEST_NAME} printable "
                "characters"
            )
        names.add(name)
        if len(names) > _MOST_NAMES:
            raise FormatError(
                f"{where}: more than {_MOST_NAMES} different names; are they names of events?"
            )
        time = _seconds(where, "time", cells["time"])
        events.append(Event(time, name, _seconds(where, "duration", cells.get("duration") or "0")))
    return tuple(sorted(events))


def _seconds(where: str, column: str, cell: str) -> float:
    try:
        seconds = float(cell)
    except ValueError:
        seconds = math.nan
    if not 0 <= seconds <= _MOST_SECONDS:
        raise FormatError(f"{where}: {column} is {cell[:40]!r}; expected seconds, 0 or more")
    return seconds
