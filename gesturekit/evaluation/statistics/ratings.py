"""Ratings of user studies: a number for a system, a clip and a question, in CSV files.

One line a rating, with the columns `rater, system, clip, question, value` in any order; `question`
is optional, and other columns are ignored. Values are those of sliders (0 to 100 in HEMVIP and
GENEA), opinion scores of 1 to 5, or any other numbers. Pairwise votes (see `answers`) are read as
ratings: 1 for the system that won, 0 for the other one, and a half for both in a tie.
"""

from __future__ import annotations

import math
import os
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gesturekit.errors import EvaluationError
from gesturekit.evaluation.statistics.answers import (
    GENEA_COLUMNS,
    Answer,
    csv_files,
    csv_rows,
    read_answers,
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

_MISSING = ("", "na", "n/a", "nan", "none", "null")
_MOST = 1e100
_MOST_QUESTIONS = 100


@dataclass(frozen=True)
class Ratings:
    """Ratings in columns of equal length n.

    Attributes:
        systems, raters, clips, questions: names, in the order of their first appearance.
        system, rater, clip, question: (n,) indices of these names.
        value: (n,) ratings.
        paired: True for pairwise votes: each is two ratings, with the sum 1.
        notes: sentences on lines that were left out.
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

    @classmethod
    def of_answers(cls, answers: Sequence[Answer], notes: Sequence[str] = ()) -> Ratings:
        """Return pairwise votes as ratings."""
        table = _Table()
        for answer in answers:
            share = 0.5 + 0.5 * float(np.sign(answer.score))
            for system, value in ((answer.left, share), (answer.right, 1.0 - share)):
                table.add((answer.user, system, answer.clip, PREFERENCE), value)
        return table.ratings(notes, paired=True)

    def among(self, systems: Sequence[str]) -> np.ndarray:
        """Return (n,) True for ratings of these systems; of a vote, both must be among them."""
        known = np.array([name in systems for name in self.systems])[self.system]
        return np.repeat(known.reshape(-1, 2).all(axis=1), 2) if self.paired else known


class _Table:
    """Ratings that are being read: indices of names, and values."""

    def __init__(self) -> None:
        self.names: tuple[dict[str, int], ...] = ({}, {}, {}, {})
        self.indices = tuple(array("i") for _ in self.names)
        self.values = array("d")

    def add(self, names: Sequence[str], value: float) -> None:
        """Add a rating by the names of its rater, system, clip and question."""
        for known, column, name in zip(self.names, self.indices, names, strict=True):
            column.append(known.setdefault(name, len(known)))
        self.values.append(value)

    def ratings(self, notes: Sequence[str] = (), *, paired: bool = False) -> Ratings:
        """Return what was added; of equal lines, one is kept, unless they are votes."""
        indices: list[np.ndarray] = [np.frombuffer(column, np.int32) for column in self.indices]
        values = np.frombuffer(self.values, np.float64)
        if not paired:
            order = np.lexsort([values, *indices])
            table = np.stack([*indices, values])[:, order]
            new = np.append(True, (np.diff(table) != 0.0).any(axis=0))
            if repeated := np.count_nonzero(~new):
                notes = (*notes, f"{counted(int(repeated), 'repeated line')} counted once")
            kept = np.sort(order[new])
            indices, values = [column[kept] for column in indices], values[kept]
        raters, systems, clips, questions = (tuple(names) for names in self.names)
        rater, system, clip, question = indices
        return Ratings(
            systems, raters, clips, questions, system, rater, clip, question, values, paired,
            tuple(notes),
        )  # fmt: skip


def read_ratings(paths: Sequence[str | os.PathLike[str]]) -> Ratings:
    """Read ratings or pairwise votes from CSV files, or from all CSV files in folders.

    The header of the first file says which of both. Lines without a value are left out, and so are
    raters of pairwise votes who failed an attention check; `notes` says so.

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
        found = read_answers(files)
        excluded = [f"{printable(user)} {why}" for user, why in found.excluded.items()]
        notes = [f"{counted(len(excluded), 'rater')} left out: {listed(excluded)}"] * bool(excluded)
        return Ratings.of_answers(found.kept, (*notes, *found.notes))
    table, empty = _Table(), 0
    for path in files:
        for number, row in csv_rows(path, _columns):
            where = f"{path}, line {number}"
            if row["value"].lower() in _MISSING:
                empty += 1
                continue
            names = (row["rater"], row["system"], row["clip"], row.get("question", ""))
            if not all(names[:3]):
                raise EvaluationError(f"{where}: rater, system or clip is empty")
            table.add(names, _value(row["value"], where))
    if not table.values:
        raise EvaluationError(f"{listed([str(path) for path in paths])}: no rating to analyse")
    if (n := len(table.names[3])) > _MOST_QUESTIONS:
        raise EvaluationError(
            f"{path}: {n} different questions, and no study has more than {_MOST_QUESTIONS}; is it "
            "a column of free text?"
        )
    left_out = f"{counted(empty, 'line')} without a value left out"
    return table.ratings((left_out,) if empty else ())


def _has_votes(path: Path) -> bool:
    """Return whether the header of a file is that of pairwise votes."""
    headers: list[list[str]] = []

    def keep(_: Path, header: list[str]) -> list[str]:
        headers.append(header)
        return header

    next(csv_rows(path, keep), None)
    return any({"model_a", "model_b"} & {*header} for header in headers)


def _columns(path: Path, header: Sequence[str]) -> list[str]:
    """Return the columns by the names of `COLUMNS`; "" for others.

    Raises:
        EvaluationError: a column is missing, or there are two for one name.
    """
    plain = [name.lower().replace(" ", "_").removesuffix("_id") for name in header]
    found = [""] * len(header)
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
