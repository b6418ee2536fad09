"""Answers of user studies, in CSV files: pairwise votes, and ratings.

Votes are in the schema of GENEA's public analysis, one line an answer, with the columns `user,
input_code, model_a, model_b, winner, is_strong, juiceOptions, juiceOtherReason`
(github.com/genea-workshop/leaderboard-statistical-analysis). `model_a` was shown on the left. A
system whose name ends in `_Mismatched` is that system's motion of other speech. In tables made by
hand, `winner` may also be the name of one of the two models, and a tie may be called equal, both or
draw.

Ratings are a number for a system, a clip and a question, one line a rating, with the columns
`rater, system, clip, question, value` in any order; `question` is optional, and other columns are
ignored. Values are those of sliders (0 to 100 in HEMVIP and GENEA), opinion scores of 1 to 5, or
any other numbers.

Our pages add further columns: `checks` and `checks_failed` count the attention checks of the rater,
`comment` is the rater's, `style` names the style that was asked for, `seconds` is the time taken.

Either kind is read as the other: votes as ratings of 1 for the system that won, 0 for the other
one, and a half for both in a tie; ratings as comparisons of all systems that a rater rated for a
clip.
"""

from __future__ import annotations

import json
import math
import os
import sys
from array import array
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from gesturekit.errors import EvaluationError
from gesturekit.evaluation.pairs import grouped
from gesturekit.formats.tables import csv_rows
from gesturekit.wording import counted, did_you_mean, listed, printable

GENEA_COLUMNS = (
    *("user", "input_code", "model_a", "model_b", "winner", "is_strong"),
    *("juiceOptions", "juiceOtherReason"),
)
MISMATCHED = "_Mismatched"
"""Ending of the name of a system that shows motion of other speech."""
COLUMNS: Mapping[str, tuple[str, ...]] = {
    "rater": ("user", "participant", "worker", "subject", "annotator"),
    "system": ("condition", "model", "method"),
    "clip": ("stimulus", "segment", "item", "utterance", "input_code"),
    "question": ("aspect", "dimension", "criterion"),
    "value": ("score", "rating", "mos"),
}
"""Other names of columns of ratings; capitals, and an ending in "_id" or " id", do not matter."""
PREFERENCE = "preference"
"""Question of pairwise votes."""
MOST_COMMENT = 1000
"""Length of a rater's comment, in characters; the rest is cut off."""

_REQUIRED = GENEA_COLUMNS[:6]
_OF_RATERS = ("checks", "checks_failed", "comment", "seconds")
_EMPTY = ("", "none", "nan", "null")
_SIDES = {
    "model_a": 1,
    "model_b": -1,
    **dict.fromkeys(("tie", "tie (bothbad)", "equal", "both", "draw"), 0),
}
_STRONG = {
    **dict.fromkeys(("true", "1", "yes", "strong", "1.0"), 2),
    **dict.fromkeys(("false", "0", "no", "0.0", *_EMPTY), 1),
}
_MISSING = (*_EMPTY, "na", "n/a")
_MOST_BYTES = 200 << 20
_MOST_VALUE = 1e100
_MOST_QUESTIONS = 100
_MOST_PAIRS = 3_000_000
_Raters = tuple[dict[str, tuple[int, int]], dict[str, str]]
"""Numbers of failed attention checks and of all, and comments, by rater."""


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
        seconds: time that the rater took, NaN if the file does not say it.
        difference: rating of the left system less that of the right one; None without ratings.
    """

    user: str
    clip: str
    left: str
    right: str
    score: int
    reasons: tuple[str, ...] = ()
    style: str = ""
    seconds: float = math.nan
    difference: float | None = None

    @property
    def matched(self) -> str | None:
        """The system compared with its own motion of other speech, or None."""
        if self.right == self.left + MISMATCHED:
            return self.left
        return self.right if self.left == self.right + MISMATCHED else None


@dataclass(frozen=True)
class Ratings:
    """Ratings in columns of equal length n.

    Attributes:
        systems, raters, clips, questions: names, in the order of their first appearance.
        system, rater, clip, question: (n,) indices of these names.
        value: (n,) ratings.
        paired: True for pairwise votes: each is two ratings, with the sum 1.
        notes: sentences on lines that were left out.
        seconds: (n,) time taken, NaN where a file does not say it.
    """

    systems: tuple[str, ...]
    raters: tuple[str, ...]
    clips: tuple[str, ...]
    questions: tuple[str, ...]
    system: np.ndarray
    rater: np.ndarray
    clip: np.ndarray
    question: np.ndarray
    value: np.ndarray
    paired: bool = False
    notes: tuple[str, ...] = ()
    seconds: np.ndarray = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def of_answers(cls, answers: Sequence[Answer], notes: Sequence[str] = ()) -> Ratings:
        """Return pairwise votes as ratings."""
        names = [
            (system, a.user, a.clip, PREFERENCE) for a in answers for system in (a.left, a.right)
        ]
        won = np.array([0.5 + 0.5 * np.sign(answer.score) for answer in answers])
        values = np.stack([won, 1.0 - won], axis=1).ravel()
        return cls(
            **_names_and_places([*zip(*names)]), value=values, paired=True, notes=tuple(notes)
        )

    def kept(self, rows: np.ndarray) -> Ratings:
        """Return some of the ratings, given by a mask (n,) or by their indices."""
        columns = ("system", "rater", "clip", "question", "value", "seconds")
        return replace(self, **{name: getattr(self, name)[rows] for name in columns})

    def among(self, systems: Sequence[str]) -> np.ndarray:
        """Return (n,) True for ratings of these systems; of a vote, both must be among them."""
        known = np.array([name in systems for name in self.systems])[self.system]
        return np.repeat(known.reshape(-1, 2).all(axis=1), 2) if self.paired else known


@dataclass(frozen=True)
class Answers:
    """Answers that count, and notes on all that were left out.

    Attributes:
        kept: answers of raters who passed.
        excluded: {rater: reason}.
        notes: sentences on lines that were left out or changed.
        has_checks: True if the files say how many attention checks were failed.
        comments: {rater: comment} of all raters.
        ratings: the ratings that `kept` compares; None of votes.
    """

    kept: tuple[Answer, ...]
    excluded: dict[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    has_checks: bool = False
    comments: dict[str, str] = field(default_factory=dict)
    ratings: Ratings | None = None


def read_answers(
    paths: Sequence[str | os.PathLike[str]], *, failed_checks: int | None = 1
) -> Answers:
    """Read answers: pairwise votes, or ratings as comparisons of the systems that were rated.

    Args:
        paths: CSV files, and folders of them.
        failed_checks: exclude raters who failed at least this many attention checks; None
            excludes nobody. GENEA excludes at 1, the diffusion paper at 2.

    Raises:
        EvaluationError: a file that is no such CSV, with line and value; no answer left.

    Examples:
        The left motion was clearly preferred:

        >>> columns = "user,input_code,model_a,model_b,winner,is_strong"
        >>> _ = (folder / "answers.csv").write_text(f"{columns}\\nu,clip,ours,theirs,model_a,True")
        >>> read_answers([folder / "answers.csv"]).kept[0].score
        2
    """
    found = _read(paths, failed_checks)
    return found if found.ratings is None else replace(found, kept=_comparisons(found.ratings))


def read_ratings(
    paths: Sequence[str | os.PathLike[str]], *, failed_checks: int | None = 1
) -> Ratings:
    """Read ratings or pairwise votes from CSV files, or from all CSV files in folders.

    The header of the first file says which of both. Lines without a value are left out, and so are
    raters who failed an attention check; `notes` says so.

    Args:
        paths: CSV files, and folders of them.
        failed_checks: see `read_answers`.

    Raises:
        EvaluationError: a file that is no such CSV, with line and value; no rating at all.

    Examples:
        >>> text = "Participant,Condition,Clip,Score\\np1,ours,a,70\\np1,theirs,a,35.5"
        >>> _ = (folder / "ratings.csv").write_text(text)
        >>> ratings = read_ratings([folder / "ratings.csv"])
        >>> ratings.systems, ratings.value.tolist()
        (('ours', 'theirs'), [70.0, 35.5])
    """
    found = _read(paths, failed_checks)
    if found.ratings is not None:
        return found.ratings
    return Ratings.of_answers(found.kept, (*_left_out(found.excluded), *found.notes))


def _read(paths: Sequence[str | os.PathLike[str]], failed_checks: int | None) -> Answers:
    """Return votes as answers, or ratings as `Answers.ratings` alone."""
    files = _csv_files(paths)
    raters: _Raters = ({}, {})
    answers: list[Answer] = []
    ratings = None
    if {"model_a", "model_b"} & {*_header(files[0])[1]}:
        answers, notes = _read_votes(files, raters)
    else:
        ratings, notes = _read_sliders(files, raters)
    failed, comments = raters
    excluded = {
        user: f"failed {wrong} of {counted(checks, 'attention check')}"
        for user, (wrong, checks) in failed.items()
        if failed_checks is not None and wrong >= failed_checks
    }
    kept = tuple(answer for answer in answers if answer.user not in excluded)
    if ratings is not None:
        passed = np.array([name not in excluded for name in ratings.raters], bool)
        notes = [*_left_out(excluded), *notes]
        ratings = replace(ratings.kept(passed[ratings.rater]), notes=tuple(notes))
    if not (kept or (ratings is not None and len(ratings.value))):
        raise EvaluationError(
            f"{listed([str(path) for path in paths])}: no answer to analyse"
            f"{''.join(f': {line}' for line in _left_out(excluded))}"
        )
    return Answers(kept, excluded, tuple(notes), bool(failed), comments, ratings)


def _read_votes(files: Sequence[Path], raters: _Raters) -> tuple[list[Answer], list[str]]:
    """Return answers, and notes on lines that were left out or changed."""
    answers: list[Answer] = []
    seen: dict[tuple[tuple[str, str], ...], Path] = {}
    sessions: dict[tuple[str, str], set[str]] = defaultdict(set)
    repeated = unsaid = 0
    for path, where, row in _rows(files, _vote_columns):
        if seen.setdefault(tuple(sorted(row.items())), path) != path:
            repeated += 1
            continue
        answer = _answer(row, where)
        answers.append(answer)
        _add_rater(raters, answer.user, row, where)
        sessions[answer.user, row.get("study", "")].add(row.get("finished", ""))
        unsaid += answer.score != 0 and row["is_strong"].lower() in _EMPTY
    kept = [answer for answer in answers if answer.left != answer.right]
    same = len(answers) - len(kept)
    twice = dict.fromkeys(printable(user) for (user, _), ends in sessions.items() if len(ends) > 1)
    notes = (
        (repeated, f"{counted(repeated, 'line')} found in two files were counted once"),
        (same, f"{counted(same, 'line')} left out: the same system on both sides"),
        (unsaid, f"{counted(unsaid, 'preference')} without is_strong count as slight"),
        (twice, f"{counted(len(twice), 'rater')} took part more than once: {listed([*twice])}; if "
         "these are two people, rename one"),
    )  # fmt: skip
    return kept, [text for number, text in notes if number]


def _read_sliders(files: Sequence[Path], raters: _Raters) -> tuple[Ratings, list[str]]:
    """Return ratings, and notes on lines that were left out."""
    columns: tuple[list[str], ...] = ([], [], [], [])
    values, seconds, empty = array("d"), array("d"), 0
    for _, where, row in _rows(files, _rating_columns):
        if row["value"].lower() in _MISSING:
            empty += 1
            continue
        names = [_cell(row, name, where) for name in ("system", "rater", "clip")]
        for column, name in zip(columns, (*names, row.get("question", "")), strict=True):
            column.append(sys.intern(name))
        values.append(_cell(row, "value", where))
        seconds.append(_cell(row, "seconds", where))
        _add_rater(raters, names[1], row, where)
    units = _names_and_places(columns)
    if (n := len(units["questions"])) > _MOST_QUESTIONS:
        raise EvaluationError(
            f"{files[-1]}: {n} different questions, and no study has more than {_MOST_QUESTIONS}; "
            "is it a column of free text?"
        )
    ratings = Ratings(**units, value=np.array(values), seconds=np.array(seconds))
    table = np.stack([ratings.system, ratings.rater, ratings.clip, ratings.question, values])
    order = np.lexsort(table)
    once = np.sort(order[np.append(True, (np.diff(table[:, order]) != 0.0).any(axis=0))])
    repeated = len(values) - len(once)
    notes = [f"{counted(empty, 'line')} without a value left out"] if empty else []
    notes += [f"{counted(repeated, 'repeated line')} counted once"] if repeated else []
    return ratings.kept(once), notes


def _add_rater(raters: _Raters, user: str, row: dict[str, str], where: str) -> None:
    """Add what a line says of its rater."""
    failed, comments = raters
    if row.get("checks_failed"):
        count = _cell(row, "checks_failed", where), _cell(row, "checks", where)
        failed[user] = max(failed.get(user, (0, 0)), count)
    if comment := row.get("comment"):
        comments[user] = comment[:MOST_COMMENT]


def _names_and_places(columns: Sequence[Sequence[str]]) -> dict[str, Any]:
    """Return names and indices of `Ratings` from the systems, raters, clips and questions (n,)."""
    fields: dict[str, Any] = {}
    for unit, column in zip(("system", "rater", "clip", "question"), columns, strict=True):
        places = {name: place for place, name in enumerate(dict.fromkeys(column))}
        fields[f"{unit}s"] = tuple(places)
        fields[unit] = np.array([places[name] for name in column], int)
    return fields


def _comparisons(ratings: Ratings) -> tuple[Answer, ...]:
    """Return the comparisons of any two systems that a rater rated for a clip and question.

    Raises:
        EvaluationError: no rater rated two systems for a clip, or too many.
    """
    units = (ratings.rater, ratings.clip, ratings.question)
    each = zip(*(unit.tolist() for unit in units), strict=True)
    pages = grouped((page, place) for place, page in enumerate(each))
    if (n := sum(len(places) * (len(places) - 1) // 2 for places in pages.values())) > _MOST_PAIRS:
        raise EvaluationError(
            f"{n} comparisons of two systems that a rater rated for a clip: more than can be "
            "analysed. Are rater, system and clip the right columns?"
        )
    found = []
    for (rater, clip, question), places in pages.items():
        for i, j in combinations(places, 2):
            left, right = (ratings.systems[ratings.system[k]] for k in (i, j))
            difference = float(ratings.value[i] - ratings.value[j])
            if left != right:
                found.append(Answer(
                    ratings.raters[rater], ratings.clips[clip], left, right,
                    int(np.sign(difference)), style=ratings.questions[question],
                    seconds=float(ratings.seconds[i]), difference=difference,
                ))  # fmt: skip
    if not found:
        raise EvaluationError(
            "no rater rated two systems for the same clip and question: differences between "
            "systems are tested within raters and clips"
        )
    return tuple(found)


def _left_out(excluded: Mapping[str, str]) -> list[str]:
    """Return a sentence on the raters that were excluded, if any."""
    raters = [f"{printable(user)} {why}" for user, why in excluded.items()]
    return [f"{counted(len(raters), 'rater')} left out: {listed(raters)}"] if raters else []


def _csv_files(paths: Sequence[str | os.PathLike[str]]) -> list[Path]:
    """Return each CSV file once, also those in folders."""
    found = [
        (path, sorted(path.glob("*.csv")) if path.is_dir() else [path]) for path in map(Path, paths)
    ]
    empty = [str(path) for path, files in found if not files]
    if empty or not found:
        raise EvaluationError(
            f"{listed(empty) or 'no answers to read'}: no .csv file; name CSV files, or a folder "
            "of them"
        )
    return list({os.path.realpath(file): file for _, files in found for file in files}.values())


def _header(path: Path) -> tuple[Iterator[tuple[str, list[str]]], list[str]]:
    """Return the lines below the header of a CSV file, as `csv_rows` gives them, and the header."""
    lines = csv_rows(path, EvaluationError, _MOST_BYTES)
    return lines, next(lines, ("", []))[1]


def _rows(
    files: Sequence[Path], columns: Callable[[Path, list[str]], Sequence[str]]
) -> Iterator[tuple[Path, str, dict[str, str]]]:
    """Yield (file, file and line, {column: text}) of the lines of files below their headers.

    Args:
        files: the CSV files.
        columns: called with a file and its header; refuses it, or returns names for its columns.

    Raises:
        EvaluationError: a file that cannot be read, is larger than 200 MiB, or no CSV in UTF-8.
    """
    for path in files:
        lines, header = _header(path)
        names = columns(path, header)
        for where, cells in lines:
            yield path, where, dict(zip(names, cells, strict=True))


def _vote_columns(path: Path, header: list[str]) -> list[str]:
    """Return the header, unless it is not that of votes."""
    missing = [name for name in _REQUIRED if name not in header]
    if missing:
        others = [name for name in header if name not in _REQUIRED]
        near = did_you_mean(missing[0], others, " (there is {!r})")
        raise EvaluationError(
            f"{path}: no column {', '.join(missing)}{near}. A CSV of answers has the columns "
            f"{', '.join(_REQUIRED)}; this one has {_shown(header)}"
        )
    return header


def _rating_columns(path: Path, header: list[str]) -> list[str]:
    """Return the columns by the names of `COLUMNS` and `_OF_RATERS`; "" for others.

    A column may be missing only for the question, and none may be there twice.
    """
    plain = [name.lower().replace(" ", "_").removesuffix("_id") for name in header]
    found = [name if name in _OF_RATERS else "" for name in plain]
    problem = ""
    for role, others in COLUMNS.items():
        fitting = [i for i, name in enumerate(plain) if name in (role, *others)]
        fitting = [i for i in fitting if plain[i] == role] or fitting
        if len(fitting) == 1:
            found[fitting[0]] = role
        elif fitting:
            several = ", ".join(printable(header[i]) for i in fitting)
            problem = problem or f"several columns may be the {role}: {several}; leave one"
        elif role != "question":
            problem = problem or (
                f"no column {role} (or {', '.join(others)}). A CSV of ratings has the columns "
                "rater, system, clip, value, and perhaps question; one of pairwise votes has "
                f"{', '.join(_REQUIRED)}; this one has {_shown(header)}"
            )
    if problem:
        raise EvaluationError(f"{path}, line 1: {problem}")
    return found


def _shown(header: Sequence[str]) -> str:
    return listed([printable(name) for name in header], 10) or "nothing"


def _answer(row: dict[str, str], where: str) -> Answer:
    """Return the answer of a line."""
    user, clip, left, right = (_cell(row, name, where) for name in GENEA_COLUMNS[:4])
    names = {left: "model_a", right: "model_b"} | {word: word for word in _SIDES}
    side = _cell({"winner": names.get(row["winner"], row["winner"])}, "winner", where)
    return Answer(
        user, clip, left, right, side * _cell(row, "is_strong", where),
        _reasons(row.get("juiceOptions", "")), row.get("style", ""), _cell(row, "seconds", where),
    )  # fmt: skip


def _cell(row: dict[str, str], name: str, where: str) -> Any:
    """Return the value of a cell of a line, as `_VALUES` says.

    Raises:
        EvaluationError: the text has no value.
    """
    text = row.get(name, "")
    value_of, expected = _VALUES.get(name, (lambda text: text or None, "a name"))
    value = value_of(text)
    if value is None:
        said = repr(printable(text[:40])) if text else "empty"
        raise EvaluationError(f"{where}: {name} is {said}; expected {expected}")
    return value


def _count(text: str) -> int | None:
    return int(text) if text.isdecimal() and len(text) <= 6 else None


def _number(text: str) -> float | None:
    try:
        value = float(text) if text.isascii() and "_" not in text else math.nan
    except ValueError:
        return None
    return value if abs(value) <= _MOST_VALUE else None


def _time(text: str) -> float | None:
    value = _number(text) if text else math.nan
    return None if value is None or value < 0.0 else value


_VALUES: Mapping[str, tuple[Callable[[str], Any], str]] = {
    "winner": (lambda text: _SIDES.get(text.lower()), "model_a, model_b or tie"),
    "is_strong": (lambda text: _STRONG.get(text.lower()), "True or False"),
    "value": (_number, "a number such as 3.5"),
    "seconds": (_time, "a time"),
    "checks": (_count, "a whole number"),
    "checks_failed": (_count, "a whole number"),
}
"""Functions of texts of cells that return None for wrong ones, and what is expected, by column;
others hold names."""


def _reasons(text: str) -> tuple[str, ...]:
    """Return the reasons of a JSON list; GENEA writes {} for none."""
    try:
        found = json.loads(text) if text else []
    except (ValueError, RecursionError):
        return ()
    return tuple(str(name) for name in found) if isinstance(found, list) else ()
