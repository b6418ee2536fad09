"""Answers of a pairwise user study: the public results table of the GENEA Leaderboard.

Columns: `user`, `input_code` (the stimulus), `model_a`, `model_b`, `winner` (model_a, model_b or
tie), `is_strong`, `juiceOptions`, `juiceOtherReason`.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gesturekit.errors import FormatError
from gesturekit.wording import did_you_mean

COLUMNS = (
    "user", "input_code", "model_a", "model_b", "winner", "is_strong", "juiceOptions",
    "juiceOtherReason",
)  # fmt: skip
_NEEDED = COLUMNS[:5]
_LARGEST = 100_000_000  # bytes
_YES = frozenset({"true", "1", "yes", "strong"})


@dataclass(frozen=True)
class Answer:
    """One judgement of one person.

    Attributes:
        user: the person.
        input_code: the stimulus, such as the stem of a recording.
        model_a, model_b: what was compared.
        winner: "model_a", "model_b" or "tie".
        is_strong: whether the preference was called a strong one.
        reasons: the options that were chosen as reasons (`juiceOptions`), as they stand.
        other_reason: a reason in the person's own words (`juiceOtherReason`).
    """

    user: str
    input_code: str
    model_a: str
    model_b: str
    winner: str
    is_strong: bool = False
    reasons: str = ""
    other_reason: str = ""


def read_answers(path: Path) -> list[Answer]:
    """Read a table of answers, with commas or semicolons.

    Raises:
        FormatError: it cannot be read, lacks a column, or has a winner that was not compared.
    """
    try:
        if path.stat().st_size > _LARGEST:
            raise FormatError(f"{path}: {path.stat().st_size} bytes; no study has so many answers")
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise FormatError(f"{path}: cannot be read as a table of answers: {error}") from None
    first = text.partition("\n")[0]
    delimiter = ";" if first.count(";") > first.count(",") else ","
    rows = csv.DictReader(io.StringIO(text, newline=""), delimiter=delimiter)
    try:
        _require_columns(path, rows.fieldnames or ())
        answers = [_answer(path, rows.line_num, row) for row in rows if any(row.values())]
    except csv.Error as error:
        raise FormatError(f"{path}: line {rows.line_num}: {error}") from None
    if not answers:
        raise FormatError(f"{path}: no answer in it; a study's results have one a line")
    return answers


def _require_columns(path: Path, names: Sequence[str]) -> None:
    missing = [name for name in _NEEDED if name not in names]
    if missing:
        hint = did_you_mean(missing[0], [name or "" for name in names], "; is it {}?")
        raise FormatError(
            f"{path}: no column {missing[0]!r}{hint} A study's results have the columns "
            f"{', '.join(COLUMNS)}"
        )


def _answer(path: Path, line: int, row: dict[str, str | None]) -> Answer:
    values = {name: (row.get(name) or "").strip() for name in COLUMNS}
    a, b, winner = (values[name] for name in ("model_a", "model_b", "winner"))
    sides = {a: "model_a", b: "model_b", "model_a": "model_a", "model_b": "model_b"}
    sides |= dict.fromkeys(("tie", "equal", "both", "draw"), "tie")
    side = sides.get(winner) or sides.get(winner.lower())
    if side is None or not a or not b or a == b:
        raise FormatError(
            f"{path}: line {line}: {winner or 'nobody'!r} won between {a!r} and {b!r}; expected "
            "model_a, model_b or tie, and two models"
        )
    return Answer(
        values["user"],
        values["input_code"],
        a,
        b,
        side,
        values["is_strong"].lower() in _YES,
        values["juiceOptions"],
        values["juiceOtherReason"],
    )
