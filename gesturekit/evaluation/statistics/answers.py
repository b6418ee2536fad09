"""Answers of a user study: CSV files in the schema of GENEA's public analysis.

One line an answer, with the columns `user, input_code, model_a, model_b, winner, is_strong,
juiceOptions, juiceOtherReason` (github.com/genea-workshop/leaderboard-statistical-analysis).
`model_a` was shown on the left. A system whose name ends in `_Mismatched` is that system's motion
of other speech. Our pages add further columns: `checks` and `checks_failed` count the attention
checks of the rater, `comment` is the rater's, `style` names the style that was asked for, `seconds`
is the time taken. In tables made by hand, `winner` may also be the name of one of the two models,
and a tie may be called equal, both or draw. Ratings of sliders are read by `ratings`.
"""

from __future__ import annotations

import csv
import json
import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from gesturekit.errors import EvaluationError
from gesturekit.wording import counted, did_you_mean, listed, printable

GENEA_COLUMNS = (
    "user",
    "input_code",
    "model_a",
    "model_b",
    "winner",
    "is_strong",
    "juiceOptions",
    "juiceOtherReason",
)
MISMATCHED = "_Mismatched"
"""Ending of the name of a system that shows motion of other speech."""

_REQUIRED = GENEA_COLUMNS[:6]
_STRONG = ("true", "1", "yes", "strong", "1.0")
_NOT_STRONG = ("false", "0", "no", "0.0")
_EMPTY = ("", "none", "nan", "null")
_TIES = ("tie", "tie (bothbad)", "equal", "both", "draw")
_MOST_BYTES = 200_000_000
MOST_COMMENT = 1000
"""Length of a rater's comment, in characters; the rest is cut off."""


@dataclass(frozen=True)
class Answer:
    """One answer of one rater.

    Attributes:
        user: the rater.
        clip: the speech segment (`input_code`).
        left, right: the systems shown on either side.
        score: 2 left clearly better, 1 slightly better, 0 equal, -1 and -2 right; of ratings, the
            sign of their difference.
        reasons: GENEA's codes of reasons (`juiceOptions`).
        style: the style, or the question of ratings, that was asked for; "" in other designs.
        seconds: time that the rater took, None if the file does not say it.
        difference: rating of the left system less that of the right one; None without ratings.
    """

    user: str
    clip: str
    left: str
    right: str
    score: int
    reasons: tuple[str, ...] = ()
    style: str = ""
    seconds: float | None = None
    difference: float | None = None

    @property
    def matched(self) -> str | None:
        """The system compared with its own motion of other speech, or None."""
        if self.right == self.left + MISMATCHED:
            return self.left
        return self.right if self.left == self.right + MISMATCHED else None


@dataclass(frozen=True)
class Rating:
    """One rating of one system; `style` is the question, see `Answer`."""

    user: str
    clip: str
    system: str
    style: str
    value: float


@dataclass(frozen=True)
class Answers:
    """Answers that count, and notes on all that were left out.

    Attributes:
        kept: answers of raters who passed.
        excluded: {rater: reason}.
        notes: sentences on lines that were left out or changed.
        has_checks: True if the files say how many attention checks were failed.
        comments: {rater: comment} of all raters.
        ratings: the ratings that `kept` compares, of a study with sliders.
    """

    kept: tuple[Answer, ...]
    excluded: dict[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    has_checks: bool = False
    comments: dict[str, str] = field(default_factory=dict)
    ratings: tuple[Rating, ...] = ()


@dataclass(frozen=True)
class RaterNotes:
    """Attention checks and comments of raters, from the columns of their answers.

    Attributes:
        failed: {rater: (failed checks, checks)}.
        comments: {rater: comment}.
    """

    failed: dict[str, tuple[int, int]] = field(default_factory=dict)
    comments: dict[str, str] = field(default_factory=dict)

    def add(self, user: str, row: dict[str, str], where: str) -> None:
        """Add what a line says of its rater.

        Raises:
            EvaluationError: a number of checks that is none.
        """
        if row.get("checks_failed", ""):
            wrong, checks = (_count(row, name, where) for name in ("checks_failed", "checks"))
            self.failed[user] = max(self.failed.get(user, (0, 0)), (wrong, checks))
        if comment := row.get("comment", ""):
            self.comments[user] = comment[:MOST_COMMENT]

    def excluded(self, failed_checks: int | None) -> dict[str, str]:
        """Return {rater: reason} of those who failed that many checks; None excludes nobody."""
        return {
            user: f"failed {wrong} of {counted(checks, 'attention check')}"
            for user, (wrong, checks) in self.failed.items()
            if failed_checks is not None and wrong >= failed_checks
        }


def read_votes(
    paths: Sequence[str | os.PathLike[str]], *, failed_checks: int | None = 1
) -> Answers:
    """Read pairwise votes of CSV files and folders; arguments and errors as `read_answers`."""
    found: list[Answer] = []
    raters = RaterNotes()
    seen: dict[tuple[str, ...], Path] = {}
    sessions: dict[tuple[str, str], set[str]] = {}
    repeated = same = unsaid = 0
    for path in csv_files(paths):
        for number, row in csv_rows(path, _columns):
            key = tuple(f"{name}={value}" for name, value in sorted(row.items()) if name)
            if seen.setdefault(key, path) != path:
                repeated += 1
                continue
            where = f"{path}, line {number}"
            answer = _answer(row, where)
            raters.add(answer.user, row, where)
            session = sessions.setdefault((answer.user, row.get("study", "")), set())
            session.add(row.get("finished", ""))
            unsaid += answer.score != 0 and row["is_strong"].lower() in _EMPTY
            if answer.left == answer.right:
                same += 1
            else:
                found.append(answer)
    excluded = raters.excluded(failed_checks)
    kept = tuple(answer for answer in found if answer.user not in excluded)
    if not kept:
        why = f": {counted(len(excluded), 'rater')} failed attention checks" if excluded else ""
        raise EvaluationError(f"{listed([str(p) for p in paths])}: no answer to analyse{why}")
    notes = _notes(repeated, same, unsaid, sessions)
    return Answers(kept, excluded, tuple(notes), bool(raters.failed), raters.comments)


def _notes(
    repeated: int, same: int, unsaid: int, sessions: dict[tuple[str, str], set[str]]
) -> Iterator[str]:
    """Yield sentences on lines that were left out or changed, and on raters of several sessions."""
    if repeated:
        yield f"{counted(repeated, 'line')} found in two files were counted once"
    if same:
        yield f"{counted(same, 'line')} left out: the same system on both sides"
    if unsaid:
        yield f"{counted(unsaid, 'preference')} without is_strong count as slight"
    twice = {user: None for (user, _), ends in sessions.items() if len(ends) > 1}
    if twice:
        yield (
            f"{counted(len(twice), 'rater')} took part more than once: "
            f"{listed([printable(user) for user in twice])}; if these are two people, rename one"
        )


def csv_files(paths: Sequence[str | os.PathLike[str]]) -> Iterator[Path]:
    """Yield each CSV file once, in folders too.

    Raises:
        EvaluationError: no path, or a folder without a CSV file.
    """
    if not paths:
        raise EvaluationError("no answers to read: name CSV files, or a folder of them")
    done: set[str] = set()
    for path in map(Path, paths):
        inside = sorted(path.glob("*.csv")) if path.is_dir() else [path]
        if not inside:
            raise EvaluationError(f"{path}: no .csv file in this folder")
        for file in inside:
            if os.path.realpath(file) not in done:
                done.add(os.path.realpath(file))
                yield file


def csv_rows(
    path: Path, columns: Callable[[Path, list[str]], Sequence[str]]
) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield (line number, {column: text}) of the lines of a file.

    Args:
        path: the file; columns are separated by commas, semicolons or tabs.
        columns: called with the file and its header; refuses it, or returns names for its columns.

    Raises:
        EvaluationError: no CSV file in UTF-8, too large, or a line with another number of cells.
    """
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise EvaluationError(f"{path}: larger than 200 MB, which is not a table of answers")
        with path.open(encoding="utf-8-sig", newline="") as lines:
            first = lines.readline()
            lines.seek(0)
            # Spreadsheets of some countries separate by semicolons, others save tabs.
            separator = max(",;\t", key=first.count)
            reader = csv.reader(lines, strict=True, delimiter=separator)
            header = [name.strip() for name in next(reader, [])]
            names = columns(path, header)
            for cells in reader:
                if not any(cell.strip() for cell in cells):
                    continue
                if len(cells) != len(header):
                    raise EvaluationError(
                        f"{path}, line {reader.line_num}: {counted(len(cells), 'cell')}, but the "
                        f"header has {len(header)}"
                    )
                yield reader.line_num, {n: c.strip() for n, c in zip(names, cells, strict=True)}
    except FileNotFoundError:
        raise EvaluationError(f"{path}: no such file") from None
    except OSError as error:
        raise EvaluationError(f"{path}: cannot be read ({error.strerror})") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise EvaluationError(f"{path}: not a CSV file in UTF-8 ({error})") from None


def _columns(path: Path, header: list[str]) -> list[str]:
    """Return the header.

    Raises:
        EvaluationError: it is not that of answers.
    """
    missing = [name for name in _REQUIRED if name not in header]
    if missing:
        others = [name for name in header if name not in _REQUIRED]
        near = did_you_mean(missing[0], others, " (there is {!r})")
        has = listed([printable(name) for name in header], 10) or "nothing"
        raise EvaluationError(
            f"{path}: no column {', '.join(missing)}{near}. A CSV of answers has the columns "
            f"{', '.join(_REQUIRED)}; this one has {has}"
        )
    return header


def _answer(row: dict[str, str], where: str) -> Answer:
    for name in ("user", "input_code", "model_a", "model_b"):
        if not row[name]:
            raise EvaluationError(f"{where}: {name} is empty")
    sides = {row["model_a"]: 1, row["model_b"]: -1}
    sides |= {"model_a": 1, "model_b": -1, **dict.fromkeys(_TIES, 0)}
    winner, strong = row["winner"], row["is_strong"].lower()
    side = sides.get(winner, sides.get(winner.lower()))
    if side is None:
        raise EvaluationError(
            f"{where}: winner is {printable(winner)!r}; expected model_a, model_b or tie"
        )
    if strong not in (*_STRONG, *_NOT_STRONG, *_EMPTY):
        raise EvaluationError(
            f"{where}: is_strong is {printable(row['is_strong'])!r}; expected True or False"
        )
    return Answer(
        user=row["user"],
        clip=row["input_code"],
        left=row["model_a"],
        right=row["model_b"],
        score=side * (2 if strong in _STRONG else 1),
        reasons=_reasons(row.get("juiceOptions", "")),
        style=row.get("style", ""),
        seconds=seconds_of(row.get("seconds", ""), where),
    )


def seconds_of(text: str, where: str) -> float | None:
    """Return a time in seconds, None for an empty text.

    Raises:
        EvaluationError: it is no time.
    """
    try:
        value = float(text) if text else None
    except ValueError:
        value = math.nan
    if value is not None and not 0.0 <= value < math.inf:
        raise EvaluationError(f"{where}: seconds is {printable(text)!r}; expected a time")
    return value


def _reasons(text: str) -> tuple[str, ...]:
    """Return the reasons of a JSON list; GENEA writes {} for none."""
    try:
        found = json.loads(text) if text else []
    except (ValueError, RecursionError):
        return ()
    return tuple(str(name) for name in found) if isinstance(found, list) else ()


def _count(row: dict[str, str], name: str, where: str) -> int:
    text = row.get(name, "")
    if not text.isdecimal() or len(text) > 6:
        raise EvaluationError(f"{where}: {name} is {printable(text)!r}; expected a whole number")
    return int(text)
