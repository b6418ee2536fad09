"""Small CSV tables with a header line."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from pathlib import Path

from gesturekit.errors import FormatError
from gesturekit.wording import did_you_mean


def read_table(
    path: Path, columns: Sequence[str], optional: Sequence[str] = (), megabytes: int = 32
) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield the rows of a table, each with its location (file and line) and its cells by column.

    Columns may be in any order; blank lines are skipped.

    Args:
        path: the file.
        columns: required columns.
        optional: optional columns.
        megabytes: largest file.

    Raises:
        FormatError: the file is missing, too large, or not such a table; with its line.
    """
    rows = csv.reader(io.StringIO(_text(path, megabytes), newline=""), strict=True)
    names: list[str] | None = None
    try:
        for row in rows:
            if not any(cell.strip() for cell in row):
                continue
            where = f"{path}, line {rows.line_num}"
            if names is None:
                names = _names(where, row, columns, optional)
                continue
            if len(row) != len(names):
                raise FormatError(
                    f"{where}: {len(row)} values; expected {len(names)} ({','.join(names)})"
                )
            yield where, {name: cell.strip() for name, cell in zip(names, row, strict=True)}
    except csv.Error as error:
        raise FormatError(f"{path}, line {rows.line_num}: not a CSV table ({error})") from None
    if names is None:
        raise FormatError(f"{path}: empty; a table begins with the line {','.join(columns)}")


def _text(path: Path, megabytes: int) -> str:
    if path.exists() and not path.is_file():
        raise FormatError(f"{path}: not a regular file")
    most = megabytes << 20
    try:
        with path.open("rb") as file:
            data = file.read(most + 1)
        if len(data) > most:
            raise FormatError(f"{path}: over {megabytes} MB, too large for such a table")
        return data.decode("utf-8-sig")
    except FileNotFoundError:
        raise FormatError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise FormatError(f"{path}: cannot be read as text ({error})") from None


def _names(where: str, row: list[str], columns: Sequence[str], optional: Sequence[str]) -> list:
    names = [cell.strip().lower() for cell in row]
    known = [*columns, *optional]
    expected = "expected " + ",".join([*columns, *(f"[{name}]" for name in optional)])
    for name in names:
        if name not in known:
            hint = did_you_mean(name, known, "did you mean {}? ")
            raise FormatError(f"{where}: column {name[:40]!r}; {hint}{expected}")
        if names.count(name) > 1:
            raise FormatError(f"{where}: two columns {name!r}; {expected}")
    missing = [name for name in columns if name not in names]
    if missing:
        raise FormatError(f"{where}: no column {', '.join(missing)}; {expected}")
    return names
