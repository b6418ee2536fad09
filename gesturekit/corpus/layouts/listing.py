"""Result of reading a layout, and the reading of folders and tables that layouts share."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gesturekit.corpus.checks import Problem
from gesturekit.corpus.recording import Recording
from gesturekit.errors import CorpusError, FormatError
from gesturekit.formats.tables import read_table
from gesturekit.wording import counted, listed

_SHOWN = 20


@dataclass
class Listing:
    """Recordings of a public corpus in a folder.

    Attributes:
        fps: published frame rate of the motion.
        copies: regular expression of the endings of names in published lists that stand for copies
            of a recording; "" for none.
        recordings: with files, published split, speaker, style and side files.
        problems: missing files, and files that the published rules leave out.
        left_over: sound and motion files without a recording.
    """

    fps: float
    copies: str = ""
    recordings: list[Recording] = field(default_factory=list)
    problems: list[Problem] = field(default_factory=list)
    left_over: list[Path] = field(default_factory=list)
    _lacking: dict[tuple[str, str, Path], list[str]] = field(default_factory=dict)

    def add(
        self, name: str, files: Mapping[str, Path], sides: Mapping[str, Path], **about: Any
    ) -> None:
        """Add a recording with those of its files, `audio` and `motion`, and sides that are there.

        Args:
            name: its id.
            files, sides: by the names of `Recording`'s fields, and of its conditions.
            about: further fields.
        """
        there = {key: file for key, file in files.items() if file.is_file()}
        conditions = {key: file for key, file in sides.items() if file.is_file()}
        self.recordings.append(Recording(name, conditions=conditions, **there | about))

    def lacks(self, what: str, file: Path, where: Path, severity: str = "error") -> bool:
        """Return whether a file is not there; `report_missing` reports it."""
        if not file.is_file():
            self._lacking.setdefault((severity, what, where), []).append(file.name)
        return not file.is_file()

    def report_missing(self) -> None:
        """Report the files that `lacks` did not find."""
        for (severity, what, where), names in self._lacking.items():
            self.missing(what, names, where, severity)

    def missing(self, what: str, names: Iterable[str], where: Path, severity: str) -> None:
        """Report files that are not there, by name; nothing if there are none."""
        if names := sorted(names):
            text = f"not there: {counted(len(names), what)}: {listed(names, _SHOWN)}"
            self.problems.append(Problem(severity, where, text))

    def note(self, text: str, names: Iterable[str], where: Path) -> None:
        """Report files that the published rules leave out or that have a known fault, by name."""
        if names := sorted(names):
            text = f"{text}: {len(names)}: {listed(names, _SHOWN)}"
            self.problems.append(Problem("note", where, text))


def root_with(folder: Path, names: Iterable[str], layout: str) -> Path:
    """Return the folder itself, or its only subfolder, that holds one of these files or folders.

    Raises:
        CorpusError: there is no such folder, or more than one.
    """
    names = list(names)

    def fits(entry: Path) -> bool:
        return any((entry / name).exists() for name in names)

    if folder.is_dir() and fits(folder):
        return folder
    inside = [entry for entry in sorted(folder.glob("*/")) if fits(entry)]
    if len(inside) == 1:
        return inside[0]
    problem = f"{' or '.join(names)}: {'several folders have one' if inside else 'not found'}"
    if not folder.is_dir():
        problem = "is a file, not a folder" if folder.exists() else "no such folder"
    raise CorpusError(f"{folder}: {problem}; give the folder of the {layout} corpus")


def rows(
    path: Path, columns: Iterable[str], others: bool = False
) -> list[tuple[str, Mapping[str, str]]]:
    """Return the rows of a corpus's table: location and cells by column, in lower case.

    Args:
        path: the CSV file.
        columns: required columns, in lower case.
        others: True where the table may have further columns.

    Raises:
        CorpusError: the file is missing or no such table; with its line.
    """
    try:
        return list(read_table(path, list(columns), None if others else ()))
    except FormatError as error:
        raise CorpusError(f"{error}; download it again") from error
