"""Takes: the recording sessions of items, and held-out parts whose neighbours are trained on."""

from __future__ import annotations

import os
import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from gesturekit.corpus.checks import Problem
from gesturekit.corpus.item import file_fingerprint
from gesturekit.corpus.recording import Recording
from gesturekit.errors import CorpusError, FormatError
from gesturekit.formats.tables import read_table
from gesturekit.wording import counted, did_you_mean, listed


def name_takes(
    recordings: Sequence[Recording], pattern: str | None, table: str | os.PathLike[str] | None
) -> tuple[list[Recording], list[Problem]]:
    """Return the recordings with their takes, and notes of those that the pattern does not match.

    A take is named by the table, else by the pattern, else by the layout of a public corpus; by
    default each recording is a take of its own. Recordings with the same sound or motion are of one
    take, with a warning.

    Args:
        recordings: examined recordings.
        pattern: regular expression to search for in ids. The take is its group `take`, else its
            first group, else all that it matches.
        table: CSV file with the columns id (or the last part of an id) and take.

    Raises:
        CorpusError: not a regular expression, a table that cannot be read or names a recording
            that is not there, or a recording that is named by neither.
    """
    ids = [recording.id for recording in recordings]
    listed_takes = {} if table is None else _read(Path(table), ids)
    named, unmatched = [], []
    for recording in recordings:
        take = listed_takes.get(recording.id)
        if take is None and pattern is not None:
            take = take_in(recording.id, pattern)
            if not take:
                unmatched.append(recording)
        named.append(replace(recording, take=take or recording.take or recording.id))
    if recordings and len(unmatched) == len(recordings):
        raise CorpusError(
            f"take pattern {pattern} matches none of {counted(len(recordings), 'recording')}, such "
            f"as {recordings[0].id}"
        )
    text = f"name does not match take pattern {pattern}: a take of its own"
    notes = [Problem("note", recording.file, text) for recording in unmatched]
    joined, copies = _join_copies(named)
    return joined, notes + copies


def _join_copies(recordings: Sequence[Recording]) -> tuple[list[Recording], list[Problem]]:
    """Give recordings with the same sound or motion, byte for byte, one take and one `original`.

    Returns:
        the recordings, and a warning that names the copies.
    """
    files_of = [[path for path in (r.audio, r.motion) if path] for r in recordings]
    files = {path for files in files_of for path in files if path.exists()}
    original = _originals(sorted(files))
    contents = [[original[path] for path in files if path in original] for files in files_of]
    takes = _joined([recording.take or "" for recording in recordings], contents)
    firsts = _joined([recording.id for recording in recordings], contents)
    joined = [
        replace(recording, take=take, original=first)
        for recording, take, first in zip(recordings, takes, firsts, strict=True)
    ]
    copies = [f"{path} (of {first})" for path, first in original.items() if path != first]
    if not copies:
        return joined, []
    text = (
        f"{counted(len(copies), 'file')} with the content of another: {listed(copies, 4)}. They "
        "count as one take, so that no copy of a held-out recording is trained on; delete those "
        "that are not meant to be there"
    )
    return joined, [Problem("warning", None, text)]


def _originals(files: Sequence[Path]) -> dict[Path, Path]:
    """Return the first file with the same content, for each of several with one content."""
    by_size: dict[int, list[Path]] = defaultdict(list)
    for path in files:
        by_size[path.stat().st_size].append(path)
    by_content: dict[str, list[Path]] = defaultdict(list)
    for path in (path for alike in by_size.values() if len(alike) > 1 for path in alike):
        by_content[file_fingerprint(path)].append(path)
    return {path: same[0] for same in by_content.values() if len(same) > 1 for path in same}


def _joined(names: Sequence[str], contents: Sequence[Sequence[Path]]) -> list[str]:
    """Return the first name that each name is connected with by contents that they share."""
    labels, holders = list(names), dict[Path, int]()
    for k, shared in enumerate(contents):
        for content in shared:
            first, other = labels[holders.setdefault(content, k)], labels[k]
            if first != other:
                labels = [first if label == other else label for label in labels]
    return labels


def take_in(name: str, pattern: str) -> str:
    """Return the take that a pattern finds in the name of a recording; "" if it does not match.

    Raises:
        CorpusError: not a regular expression.

    Examples:
        >>> take_in("day1/talk_part03", "(.*)_part[0-9]+")
        'day1/talk'
    """
    try:
        match = re.search(pattern, name)
    except re.error as error:
        raise CorpusError(f"take pattern {pattern} is not a regular expression: {error}") from error
    if match is None:
        return ""
    if "take" in match.re.groupindex:
        return match["take"] or ""
    return (match[1] if match.re.groups else match[0]) or ""


def by_id_or_stem(ids: Sequence[str]) -> dict[str, list[str]]:
    """Return the ids by themselves and by their last parts."""
    by_name: dict[str, list[str]] = {}
    for name in ids:
        for key in {name, name.rpartition("/")[2]}:
            by_name.setdefault(key, []).append(name)
    return by_name


def _read(table: Path, ids: Sequence[str]) -> dict[str, str]:
    """Return {id: take} of a table.

    Raises:
        CorpusError: it cannot be read, or names a recording that is not there or not unique.
    """
    by_name = by_id_or_stem(ids)
    takes: dict[str, str] = {}
    try:
        for where, cells in read_table(table, ("id", "take")):
            fitting = by_name.get(cells["id"], [])
            if len(fitting) != 1:
                hint = did_you_mean(cells["id"], by_name, "; did you mean {}?")
                what = "several recordings" if fitting else "no usable recording"
                raise CorpusError(f"{where}: id {cells['id']!r} is {what}{hint}")
            if not cells["take"]:
                raise CorpusError(f"{where}: no take of {cells['id']}")
            takes[fitting[0]] = cells["take"]
    except (FormatError, OSError, UnicodeDecodeError) as error:
        raise CorpusError(f"{table}: cannot read the table of takes: {error}") from error
    return takes


def neighbours(items: Iterable[Any], split: str | None = None) -> str:
    """Return a sentence on held-out items that are of a take in training; "" if there are none.

    Args:
        items: of a manifest, with `motion`, `take` and `split`.
        split: the held-out split; None for valid and test.
    """
    moving = [item for item in items if item.motion is not None]
    trained = {item.take for item in moving if item.split == "train"}
    held_out = [i for i in moving if i.split == split or (split is None and i.split != "train")]
    beside = [item for item in held_out if item.take in trained]
    if split == "train" or not beside:
        return ""
    takes = sorted({item.take.rpartition("/")[2] for item in beside})
    return (
        f"held-out items with neighbours in training, of the same take ({listed(takes, 3)}): "
        f"{len(beside)} of {len(held_out)}. They flatter a model, above all its hand speed, its "
        "rests and when it is calm or lively; hold out whole takes to learn how it moves on "
        "another day"
    )
