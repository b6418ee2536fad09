"""Ratings of user studies: a number for a system, a clip and a question, in CSV files.

One line a rating, with the columns `rater, system, clip, question, value` in any order; `question`
is optional, and other columns are ignored. Values are those of sliders (0 to 100 in HEMVIP and
GENEA), opinion scores of 1 to 5, or any other numbers; our pages add `checks`, `checks_failed`,
`comment` and `seconds` (see `answers`). Pairwise votes are read as ratings: 1 for the system that
won, 0 for the other one, and a half for both in a tie. Ratings are read as answers: the comparisons
of all systems that a rater rated for a clip.
"""

from __future__ import annotations

import math
import os
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path

import numpy as np

from gesturekit.errors import EvaluationError
from gesturekit.evaluation.statistics.answers import (
    GENEA_COLUMNS,
    Answer,
    Answers,
    RaterNotes,
    Rating,
    csv_files,
    csv_rows,
    read_votes,
    seconds_of,
)
from gesturekit.wording import counted, listed, printable

COLUMNS: Mapping[str, tuple[str, ...]] = {
    "rater": ("user", "participant", "worker", "subject", "annotator"),
    "system": ("condition", "model", "method"),
    "clip": ("stimulus", "segment", "item", "utterance", "input_code"),
    "question": ("aspect", "dimension", "criterion"),
    "value": ("score", "rating", "mos"),
}
"""Other names of columns; capitals, and an ending in "_id" or " id", do not matter."""
PREFERENCE = "preference"
"""Question of pairwise votes."""

_OF_RATERS = ("checks", "checks_failed", "comment", "seconds")
_MISSING = ("", "na", "n/a", "nan", "none", "null")
_MOST = 1e100
_MOST_QUESTIONS = 100
_MOST_PAIRS = 3_000_000


@dataclass(frozen=True)
class Ratings:
    """Ratings in columns of equal length n.

    Attributes:
        systems, raters, clips, questions: names, in the order of their first appearance.
        system, rater, clip, question: (n,) indices of these names.
        value: (n,) ratings.
        paired: True for pairwise votes: each is two ratings, with the sum 1.
        notes: sentences on lines that were left out.
        excluded: {rater: reason}, whose ratings were left out.
        seconds: (n,) time taken, NaN where a file does not say it.
        raters_said: attention checks and comments.
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
    excluded: Mapping[str, str] = field(default_factory=dict)
    seconds: np.ndarray = field(default_factory=lambda: np.zeros(0))
    raters_said: RaterNotes = field(default_factory=RaterNotes)

    @classmethod
    def of_answers(cls, answers: Sequence[Answer], notes: Sequence[str] = ()) -> Ratings:
        """Return pairwise votes as ratings."""
        table = _Table()
        for answer in answers:
            share = 0.5 + 0.5 * float(np.sign(answer.score))
            for system, value in ((answer.left, share), (answer.right, 1.0 - share)):
                table.add((answer.user, system, answer.clip, PREFERENCE), value)
        return table.ratings(notes, paired=True)

    def answers(self) -> Answers:
        """Return the comparisons of any two systems that a rater rated for a clip and question.

        Raises:
            EvaluationError: no rater rated two systems for a clip, or too many.
        """
        ratings = [
            Rating(self.raters[r], self.clips[c], self.systems[s], self.questions[q], float(value))
            for r, c, s, q, value in zip(
                self.rater, self.clip, self.system, self.question, self.value, strict=True
            )
        ]
        pages: dict[tuple[int, ...], list[int]] = {}
        for i, page in enumerate(zip(self.rater, self.clip, self.question, strict=True)):
            pages.setdefault(tuple(map(int, page)), []).append(i)
        if (n := sum(len(rows) * (len(rows) - 1) // 2 for rows in pages.values())) > _MOST_PAIRS:
            raise EvaluationError(
                f"{n} comparisons of two systems that a rater rated for a clip: more than can be "
                "analysed. Are rater, system and clip the right columns?"
            )
        kept = [
            _comparison(ratings[i], ratings[j], float(self.seconds[i]))
            for rows in pages.values()
            for i, j in combinations(rows, 2)
            if self.system[i] != self.system[j]
        ]
        if not kept:
            raise EvaluationError(
                "no rater rated two systems for the same clip and question: differences between "
                "systems are tested within raters and clips"
            )
        said = self.raters_said
        return Answers(
            tuple(kept), dict(self.excluded), self.notes, bool(said.failed), said.comments,
            tuple(ratings),
        )  # fmt: skip

    def among(self, systems: Sequence[str]) -> np.ndarray:
        """Return (n,) True for ratings of these systems; of a vote, both must be among them."""
        known = np.array([name in systems for name in self.systems])[self.system]
        return np.repeat(known.reshape(-1, 2).all(axis=1), 2) if self.paired else known


def _comparison(left: Rating, right: Rating, seconds: float) -> Answer:
    difference = left.value - right.value
    return Answer(
        left.user, left.clip, left.system, right.system, int(np.sign(difference)),
        style=left.style, seconds=None if math.isnan(seconds) else seconds, difference=difference,
    )  # fmt: skip


class _Table:
    """Ratings that are being read: indices of names, values, and times."""

    def __init__(self) -> None:
        self.names: tuple[dict[str, int], ...] = ({}, {}, {}, {})
        self.indices = tuple(array("i") for _ in self.names)
        self.values = array("d")
        self.seconds = array("d")

    def add(self, names: Sequence[str], value: float, seconds: float | None = None) -> None:
        """Add a rating by the names of its rater, system, clip and question."""
        for known, column, name in zip(self.names, self.indices, names, strict=True):
            column.append(known.setdefault(name, len(known)))
        self.values.append(value)
        self.seconds.append(math.nan if seconds is None else seconds)

    def ratings(
        self,
        notes: Sequence[str] = (),
        *,
        paired: bool = False,
        said: RaterNotes | None = None,
        excluded: Mapping[str, str] | None = None,
    ) -> Ratings:
        """Return what was added; of equal lines, one is kept, unless they are votes."""
        indices: list[np.ndarray] = [np.frombuffer(column, np.int32) for column in self.indices]
        values, seconds = (np.frombuffer(x, np.float64) for x in (self.values, self.seconds))
        if not paired:
            order = np.lexsort([values, *indices])
            table = np.stack([*indices, values])[:, order]
            new = np.append(True, (np.diff(table) != 0.0).any(axis=0))
            if repeated := np.count_nonzero(~new):
                notes = (*notes, f"{counted(int(repeated), 'repeated line')} counted once")
            kept = np.sort(order[new])
            failed = [self.names[0][user] for user in excluded or ()]
            kept = kept[~np.isin(indices[0][kept], failed)]
            indices = [column[kept] for column in indices]
            values, seconds = values[kept], seconds[kept]
        raters, systems, clips, questions = (tuple(names) for names in self.names)
        rater, system, clip, question = indices
        return Ratings(
            systems, raters, clips, questions, system, rater, clip, question, values, paired,
            tuple(notes), excluded or {}, seconds, said or RaterNotes(),
        )  # fmt: skip


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
    files = list(csv_files(paths))
    if _has_votes(files[0]):
        return read_votes(files, failed_checks=failed_checks)
    return read_ratings(files, failed_checks=failed_checks).answers()


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
    files = list(csv_files(paths))
    if _has_votes(files[0]):
        found = read_votes(files, failed_checks=failed_checks)
        return Ratings.of_answers(found.kept, (*_left_out(found.excluded), *found.notes))
    table, said, empty = _Table(), RaterNotes(), 0
    for path in files:
        for number, row in csv_rows(path, _columns):
            where = f"{path}, line {number}"
            if row["value"].lower() in _MISSING:
                empty += 1
                continue
            names = (row["rater"], row["system"], row["clip"], row.get("question", ""))
            if not all(names[:3]):
                raise EvaluationError(f"{where}: rater, system or clip is empty")
            seconds = seconds_of(row.get("seconds", ""), where)
            table.add(names, _value(row["value"], where), seconds)
            said.add(names[0], row, where)
    excluded = said.excluded(failed_checks)
    if not set(table.names[0]) - set(excluded):
        raise EvaluationError(
            f"{listed([str(path) for path in paths])}: no rating to analyse"
            f"{''.join(f': {line}' for line in _left_out(excluded))}"
        )
    if (n := len(table.names[3])) > _MOST_QUESTIONS:
        raise EvaluationError(
            f"{path}: {n} different questions, and no study has more than {_MOST_QUESTIONS}; is it "
            "a column of free text?"
        )
    notes = [f"{counted(empty, 'line')} without a value left out"] if empty else []
    return table.ratings((*_left_out(excluded), *notes), said=said, excluded=excluded)


def _left_out(excluded: Mapping[str, str]) -> list[str]:
    """Return a sentence on the raters that were excluded, if any."""
    raters = [f"{printable(user)} {why}" for user, why in excluded.items()]
    return [f"{counted(len(raters), 'rater')} left out: {listed(raters)}"] if raters else []


def _has_votes(path: Path) -> bool:
    """Return whether the header of a file is that of pairwise votes."""
    headers: list[list[str]] = []

    def keep(_: Path, header: list[str]) -> list[str]:
        headers.append(header)
        return header

    next(csv_rows(path, keep), None)
    return any({"model_a", "model_b"} & {*header} for header in headers)


def _columns(path: Path, header: Sequence[str]) -> list[str]:
    """Return the columns by the names of `COLUMNS` and `_OF_RATERS`; "" for others.

    Raises:
        EvaluationError: a column is missing, or there are two for one name.
    """
    plain = [name.lower().replace(" ", "_").removesuffix("_id") for name in header]
    found = [name if name in _OF_RATERS else "" for name in plain]
    for role, others in COLUMNS.items():
        fitting = [i for i, name in enumerate(plain) if name in (role, *others)]
        fitting = [i for i in fitting if plain[i] == role] or fitting
        if len(fitting) > 1:
            raise EvaluationError(
                f"{path}, line 1: several columns may be the {role}: "
                f"{', '.join(printable(header[i]) for i in fitting)}; leave one"
            )
        if fitting:
            found[fitting[0]] = role
        elif role != "question":
            has = listed([printable(name) for name in header], 10) or "nothing"
            raise EvaluationError(
                f"{path}, line 1: no column {role} (or {', '.join(others)}). A CSV of ratings has "
                "the columns rater, system, clip, value, and perhaps question; one of pairwise "
                f"votes has {', '.join(GENEA_COLUMNS[:6])}; this one has {has}"
            )
    return found


def _value(text: str, where: str) -> float:
    """Return a rating.

    Raises:
        EvaluationError: the text is no finite number.
    """
    try:
        value = float(text) if text.isascii() and "_" not in text else math.nan
    except ValueError:
        value = math.nan
    if not abs(value) <= _MOST:
        raise EvaluationError(
            f"{where}: value is {printable(text[:40])!r}; expected a number such as 3.5"
        )
    return value
