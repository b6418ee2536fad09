"""Result of reading a layout, and the reading of folders and tables that layouts share."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

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

    def missing(self, what: str, names: Iterable[str], where: Path, severity: str) -> None:
        """Report files that are not there, by name; nothing if there are none."""
        if names := sorted(names):
            text = f"not there: {counted(len(names), what)}: {listed(names, _SHOWN)}"
            self.problems.append(Problem(severity, where, text))

    def note(self, text: str, names: Iterable[str], where: Path) -> None:
        """Report files that the published rules leave out or that have a known fault, by name."""
        if names := sorted(names):
            self.problems.append(
                Problem("note", where, f"{text}: {len(names)}: {listed(names, _SHOWN)}")
            )


def root_with(folder: Path, names: Iterable[str], layout: str) -> Path:
    """Return the folder itself, or its only subfolder, that holds one of these files or folders.

    Raises:
        CorpusError: there is no such folder, or more than one.
    """
    names = list(names)
    if not folder.is_dir():
        what = "is a file, not a folder" if folder.exists() else "no such folder"
        raise CorpusError(f"{folder}: {what}; give the folder of the {layout} corpus")
    if any((folder / name).exists() for name in names):
        return folder
    inside = [
        entry
        for entry in sorted(folder.iterdir())
        if entry.is_dir() and any((entry / name).exists() for name in names)
    ]
    if len(inside) == 1:
        return inside[0]
    why = "several folders have one" if inside else "not found"
    raise CorpusError(f"{folder}: {' or '.join(names)}: {why}; give the folder of {layout}")


def existing(files: Mapping[str, Path]) -> dict[str, Path]:
    """Return the side files that are there, by name."""
    return {name: file for name, file in files.items() if file.is_file()}


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
    columns = list(columns)
    optional: list[str] = []
    try:
        if others and path.is_file():
            with path.open(encoding="utf-8-sig", newline="") as file:
                header = next(csv.reader(file), [])
            optional = [name.strip().lower() for name in header]
        return list(read_table(path, columns, [name for name in optional if name not in columns]))
    except (FormatError, OSError, UnicodeDecodeError, csv.Error) as error:
        where = "" if str(path) in str(error) else f"{path}: "
        raise CorpusError(f"{where}{error}; download it again") from error
