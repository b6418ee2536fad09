"""Problems of recordings: a message, its severity, and the file."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

SEVERITIES = ("error", "warning", "note")


@dataclass(frozen=True)
class Problem:
    """A problem of one file, or of the whole corpus (`file` is None).

    An ``"error"`` leaves the recording out; a ``"warning"`` keeps it and says what was done about
    it; a ``"note"`` is information only.
    """

    severity: str
    file: Path | None
    message: str

    def __str__(self) -> str:
        return f"{self.severity}: {self.text}"

    @property
    def text(self) -> str:
        """The message, preceded by its file unless it already names the file."""
        if self.file is None:
            return self.message
        # Match whole words: a folder "e" is not named by every word that contains an e.
        if re.search(rf"(?<!\w){re.escape(str(self.file))}(?!\w)", self.message):
            return self.message
        return f"{self.file}: {self.message}"


def printed(problems: Iterable[Problem], *, files_shown: int = 3) -> list[str]:
    """Format problems as lines: errors first; equal notes or warnings on files share a line."""
    groups: dict[tuple[object, ...], list[Problem]] = {}
    for problem in sorted(problems, key=lambda problem: SEVERITIES.index(problem.severity)):
        together = problem.file if problem.severity == "error" else None
        groups.setdefault((problem.severity, problem.message, together), []).append(problem)
    lines = []
    for members in groups.values():
        files = [str(member.file) for member in members]
        if len(files) == 1:
            lines.append(str(members[0]))
            continue
        more = f" and {len(files) - files_shown} more" if len(files) > files_shown else ""
        shown = ", ".join(files[:files_shown])
        lines.append(
            f"{members[0].severity}: {len(files)} files: {members[0].message}: {shown}{more}"
        )
    return lines
