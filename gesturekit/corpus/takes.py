"""Takes: the recording sessions of items, and held-out parts whose neighbours are trained on."""

from __future__ import annotations

import os
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from gesturekit.corpus.checks import Problem
from gesturekit.corpus.manifest import file_fingerprint
from gesturekit.corpus.recording import Recording
from gesturekit.errors import CorpusError, FormatError, GestureKitError
from gesturekit.formats.sources import load
from gesturekit.formats.tables import read_table
from gesturekit.motion import Motion
from gesturekit.motion.rotations import rotation_angles
from gesturekit.wording import counted, did_you_mean, listed


def name_takes(
    recordings: Sequence[Recording], pattern: str | None, table: str | os.PathLike[str] | None
) -> tuple[list[Recording], list[Problem]]:
    """Return the recordings with their takes, and problems with them.

    Problems are recordings that the pattern does not match, speakers whose takes it merges, and
    without pattern and table recordings that look like pieces of takes.

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
    takes = takes_of([recording.id for recording in recordings], pattern, table)
    named = [replace(r, take=takes.get(r.id) or r.take or r.id) for r in recordings]
    text, unmatched = f"name does not match take pattern {pattern}: a take of its own", []
    if pattern is not None:
        unmatched = [Problem("note", r.file, text) for r in recordings if r.id not in takes]
    said = merged_speakers([(r.id, r.speaker, r.take or "") for r in named if r.id in takes])
    if pattern is None and table is None:
        alone = [r for r in recordings if r.take is None]
        readers = {r.id: partial(load, r.motion, r.reading) for r in alone if r.motion is not None}
        said = pieces_of_takes(readers)
    joined, copies = _join_copies(named)
    return joined, unmatched + [Problem("warning", None, text) for text in said] + copies


def takes_of(
    names: Sequence[str], pattern: str | None, table: str | os.PathLike[str] | None
) -> dict[str, str]:
    """Return {name: take} of the recordings that a table, or else a pattern, gives a take.

    Args:
        names: of recordings.
        pattern, table: see `name_takes`.

    Raises:
        CorpusError: see `name_takes`.
    """
    takes = {} if table is None else _read(Path(table), names)
    rest = [name for name in names if name not in takes]
    if pattern is None or not rest:
        return takes
    found = {name: take for name in rest if (take := take_in(name, pattern))}
    if not found:
        held = f"{counted(len(rest), 'recording')}, such as {rest[0]}"
        raise CorpusError(f"take pattern {pattern} matches none of {held}")
    return takes | found


def merged_speakers(named: Iterable[tuple[str, str | None, str]]) -> list[str]:
    """Return a sentence on takes that hold recordings of several speakers, if there are any.

    Args:
        named: recording, speaker and take; without a speaker, the folder in the name stands for it.
    """
    speakers: dict[str, set[str]] = defaultdict(set)
    for name, speaker, take in named:
        speakers[take].add(speaker or name.rpartition("/")[0])
    mixed = [f"{take} ({listed(sorted(who))})" for take, who in speakers.items() if len(who) > 1]
    if not mixed:
        return []
    return [
        f"{counted(len(mixed), 'take')} with recordings of several speakers or folders: "
        f"{listed(mixed, 3)}. If these are different sessions, let the take pattern take the "
        "speaker too, such as '(.*/talk[0-9]+)'"
    ]


_PART = re.compile(
    r"[_\-. ]?(?:part|chunk|segment|seg|piece|split|cut|clip)[_\-. ]?(?P<number>\d+)$", re.I
)
_NUMBER = re.compile(r"[_\-. ](?P<number>\d+)$")
_READ = 3  # pairs of recordings whose poses are compared


def pieces_of_takes(motions: Mapping[str, Callable[[], Motion]]) -> list[str]:
    """Return a question about recordings that look like pieces of takes, if there are any.

    They are named so (`a_part00`, `a_chunk3`), or are numbered and begin in the pose in which the
    one before ends.

    Args:
        motions: what reads the motion of each recording, by name.
    """
    for ending, why in ((_PART, "their names say so"), (_NUMBER, "each continues another")):
        pieces: dict[str, dict[int, str]] = defaultdict(dict)
        forms: dict[str, None] = {}
        for name in motions:
            match = ending.search(name)
            if match and name[: match.start()].rpartition("/")[2]:
                pieces[name[: match.start()]][int(match["number"])] = name
                forms[re.escape(name[match.start() : match.start("number")]) + r"\d+"] = None
        cut = {stem: names for stem, names in pieces.items() if len(names) > 1}
        if cut and (ending is _PART or _continue(cut.values(), motions)):
            form = next(iter(forms)) if len(forms) == 1 else f"(?:{'|'.join(forms)})"
            takes = len(motions) - sum(len(names) - 1 for names in cut.values())
            shown = listed(sorted(next(iter(cut.values())).values()), 3)
            return [
                f"{counted(len(motions), 'file')}, perhaps {counted(takes, 'recording')}: {shown} "
                f"look like pieces of one take ({why}), but count as takes of their own, which "
                "flatters held-out pieces and narrows intervals. If they are, give --take-pattern "
                f"'(.*){form}'"
            ]
    return []


def _continue(
    cut: Iterable[Mapping[int, str]], motions: Mapping[str, Callable[[], Motion]]
) -> bool:
    """Return whether most of some numbered recordings begin as the one before ends."""
    following = [
        (names[a], names[b]) for names in cut for a, b in pairwise(sorted(names)) if b == a + 1
    ]
    chosen = following[:: max(1, len(following) // _READ)][:_READ]
    try:
        found = [_continues(motions[before](), motions[after]()) for before, after in chosen]
    except (GestureKitError, OSError):  # reported where all motions are read
        return False
    return 2 * sum(found) > len(found)


def _continues(before: Motion, after: Motion) -> bool:
    """Return whether a motion begins as another one ends, and not as that one begins."""
    if before.rotations.shape[1] != after.rotations.shape[1]:
        return False

    def apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return the mean angle of joints between poses (..., J, 4), radians."""
        return rotation_angles(a, b).mean(axis=-1)

    poses, first = before.rotations, after.rotations[0]
    steps = apart(poses[1:], poses[:-1]).max(initial=0.0)
    walked = np.linalg.norm(np.diff(before.translation, axis=0), axis=-1).max(initial=0.01)
    turn, gap = apart(poses[-1], first), after.translation[0] - before.translation[-1]
    near = turn <= 2.0 * steps and np.linalg.norm(gap) <= 2.0 * walked
    return bool(near and turn < 0.5 * apart(poses[0], first))


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
    named = zip(recordings, takes, firsts, strict=True)
    joined = [replace(recording, take=take, original=first) for recording, take, first in named]
    copies = [f"{path} (of {first})" for path, first in original.items() if path != first]
    text = (
        f"{counted(len(copies), 'file')} with the content of another: {listed(copies, 4)}. They "
        "count as one take, so that no copy of a held-out recording is trained on; delete those "
        "that are not meant to be there"
    )
    return joined, [Problem("warning", None, text)] if copies else []


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
    match = compiled("take pattern", pattern).search(name)
    if match is None:
        return ""
    group = "take" if "take" in match.re.groupindex else min(match.re.groups, 1)
    return match[group] or ""


def compiled(what: str, pattern: str) -> re.Pattern[str]:
    """Return a user's regular expression; raise CorpusError, which names it, for another text."""
    try:
        return re.compile(pattern)
    except re.error as error:
        raise CorpusError(f"{what} {pattern} is not a regular expression: {error}") from error


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
            name, take = cells["id"], cells["take"]
            fitting = by_name.get(name, [])
            if len(fitting) != 1 or not take:
                hint = did_you_mean(name, by_name, "; did you mean {}?")
                what = "several recordings" if fitting else f"no usable recording{hint}"
                problem = f"no take of {name}" if len(fitting) == 1 else f"id {name!r} is {what}"
                raise CorpusError(f"{where}: {problem}")
            takes[fitting[0]] = take
    except FormatError as error:
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
