"""Hold-outs by name: a pattern, a list of recordings, or speakers."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from gesturekit.corpus.recording import Recording
from gesturekit.errors import CorpusError
from gesturekit.wording import counted, listed

_MOST_BYTES = 16 << 20


@dataclass(frozen=True)
class HoldOut:
    """Recordings to hold out as "test"; all others are "train".

    Attributes:
        pattern: regular expression to search for in ids.
        file: text file with one id, or stem of an id, a line.
        speakers: names of speakers.
    """

    pattern: str | None = None
    file: str | os.PathLike[str] | None = None
    speakers: Sequence[str] = ()

    def __bool__(self) -> bool:
        return bool(self.pattern or self.file or self.speakers)

    def apply(self, recordings: Sequence[Recording]) -> list[Recording]:
        """Return the recordings with their splits.

        Raises:
            CorpusError: a pattern, a name or a speaker that fits no recording, or all of them.
        """
        wanted: set[str] = set()
        ids = [recording.id for recording in recordings]
        if self.pattern:
            wanted |= self._matching(ids)
        if self.file:
            wanted |= self._listed(ids)
        known = {recording.speaker for recording in recordings}
        if unknown := sorted(set(self.speakers) - known):
            there = listed(sorted(filter(None, known))) or "none is named"
            raise CorpusError(f"hold-out: no recording of speaker {unknown[0]!r}; there: {there}")
        wanted |= {one.id for one in recordings if one.speaker in self.speakers}
        if recordings and len(wanted) == len(recordings):
            raise CorpusError(
                f"hold-out: all {counted(len(recordings), 'recording')} would be held out, and "
                "none trained on"
            )
        return [replace(one, split="test" if one.id in wanted else "train") for one in recordings]

    def _matching(self, ids: list[str]) -> set[str]:
        try:
            found = {name for name in ids if re.search(self.pattern, name)}
        except re.error as error:
            raise CorpusError(
                f"hold-out pattern {self.pattern} is no regular expression: {error}"
            ) from error
        if ids and not found:
            raise CorpusError(
                f"hold-out pattern {self.pattern} matches none of {counted(len(ids), 'recording')},"
                f" such as {ids[0]}"
            )
        return found

    def _listed(self, ids: list[str]) -> set[str]:
        path = Path(self.file)
        try:
            if path.stat().st_size > _MOST_BYTES:
                raise CorpusError(f"{path}: too large for a list of names")
            lines = path.read_text(encoding="utf-8-sig").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise CorpusError(f"{path}: cannot read the list of recordings: {error}") from error
        by_name: dict[str, set[str]] = {}
        for name in ids:
            for key in {name, name.rsplit("/", 1)[-1]}:
                by_name.setdefault(key, set()).add(name)
        found: set[str] = set()
        unknown = []
        for line in filter(None, map(str.strip, lines)):
            names = by_name.get(line) or by_name.get(str(Path(line).with_suffix("").as_posix()))
            found |= names or set()
            if not names:
                unknown.append(line)
        if unknown:
            raise CorpusError(
                f"{path}: {counted(len(unknown), 'name')} of no usable recording: "
                f"{listed(unknown, 10)}"
            )
        return found
