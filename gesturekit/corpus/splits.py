"""Splits: the recordings, or parts of one, that are held out from training.

With several takes whole takes are held out: a fraction of them, at least one, alternately for
"test" and "valid". With a single take whole recordings of it are, and with a single recording its
last fifth becomes "test". Or the user gives intervals, which are cut out of every recording that is
long enough.
"""

from __future__ import annotations

import hashlib
import math
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import Any

from audio_features.archive import read_bytes
from gesturekit.corpus.checks import Problem
from gesturekit.corpus.manifest import Item, absolute, file_fingerprint
from gesturekit.corpus.recording import MIN_DURATION, Recording
from gesturekit.corpus.takes import by_id_or_stem, compiled
from gesturekit.errors import CorpusError
from gesturekit.wording import counted, listed

TAIL = 0.2
"""Fraction of a single recording that is held out, at its end."""

_MOST_BYTES = 16 << 20  # of a list of names

Interval = tuple[float, float]
"""Start and end in seconds; the end may be infinite."""


def choose_held_out(
    names: Iterable[str], fraction: float, seed: int, *, at_least: int = 0
) -> dict[str, str]:
    """Choose the split of each take (or recording), {name: split}.

    round(fraction · n) takes are held out, at least `at_least` and never all of them, "test" and
    "valid" in turn; the rest is "train". The takes with the lowest SHA-256 of seed and name are
    held out, so that the choice depends neither on the order of the files nor on the machine, and
    hardly changes when takes are added.
    """
    units = list(dict.fromkeys(names))
    count = min(max(at_least, math.floor(fraction * len(units) + 0.5)), len(units) - 1)
    ranked = sorted(units, key=lambda name: hashlib.sha256(f"{seed}:{name}".encode()).digest())
    held_out = ranked[: max(count, 0) if fraction > 0 else 0]
    splits = {name: ("test", "valid")[i % 2] for i, name in enumerate(held_out)}
    return dict.fromkeys(units, "train") | splits


def hold_out(
    recordings: Sequence[Recording],
    pattern: str | None = None,
    file: str | os.PathLike[str] | None = None,
    speakers: Sequence[str] = (),
    copies: str = "",
) -> list[Recording]:
    """Return the recordings with splits: those that are named are "test", all others "train".

    Args:
        recordings: all of them; without any name they are returned as they are.
        pattern: regular expression to search for in ids.
        file: text file with one id, or stem of an id, a line.
        speakers: names of speakers.
        copies: see `layouts.listing.Listing`; a copy in `file` stands for its recording.

    Raises:
        CorpusError: a pattern, a name or a speaker that fits no recording, or all of them.
    """
    if not (pattern or file or speakers):
        return list(recordings)
    ids = [recording.id for recording in recordings]
    matches = compiled("hold-out pattern", pattern).search if pattern else None
    wanted = set(filter(matches, ids)) if matches else set()
    known = {recording.speaker for recording in recordings}
    problem = ""
    if pattern and ids and not wanted:
        held = f"{counted(len(ids), 'recording')}, such as {ids[0]}"
        problem = f"hold-out pattern {pattern} matches none of {held}"
    wanted |= _listed(ids, Path(file), copies) if file else set()
    if unknown := sorted(set(speakers) - known):
        there = listed(sorted(filter(None, known))) or "none"
        problem = f"hold-out: no recording of speaker {unknown[0]!r}; there are {there}"
    named = [r for r in recordings if r.id in wanted or r.speaker in speakers]
    originals = set(map(_original, named))
    if recordings and originals == set(map(_original, recordings)):
        problem = f"all {counted(len(recordings), 'recording')} would be held out"
    if problem:
        raise CorpusError(problem)
    splits = ["test" if _original(recording) in originals else "train" for recording in recordings]
    return [replace(r, split=split) for r, split in zip(recordings, splits, strict=True)]


def _listed(ids: list[str], file: Path, copies: str) -> set[str]:
    try:
        lines = read_bytes(file, _MOST_BYTES, CorpusError).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise CorpusError(f"{file}: cannot read the list of recordings: {error}") from error
    by_name = by_id_or_stem(ids)
    names: set[str] = set()
    unknown = []
    for line in filter(None, map(str.strip, lines)):
        stem = (Path(line).parent / Path(line).stem).as_posix()
        keys = (line, stem, re.sub(f"({copies})$", "", stem))
        if fitting := next(filter(None, map(by_name.get, keys)), []):
            names.update(fitting)
        else:
            unknown.append(line)
    if unknown:
        lost = f"{counted(len(unknown), 'name')} without a usable recording"
        raise CorpusError(f"{file}: {lost}: {listed(unknown, 10)}")
    return names


def as_intervals(wanted: str | Sequence[Interval]) -> list[Interval]:
    """Return intervals in seconds from text such as ``"10-20,55-"`` or (start, end) pairs.

    In text, an interval without an end lasts to the end of the recording.

    Raises:
        CorpusError: neither, or an interval that ends before it begins.
    """
    given = (wanted.split(",") if wanted else []) if isinstance(wanted, str) else wanted
    intervals = []
    for interval in given:
        ends: Any = interval
        if isinstance(interval, str):
            match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*-\s*(\d+(?:\.\d+)?)?\s*", interval)
            ends = match and (match[1], match[2] or math.inf)
        try:
            start, stop = map(float, ends)
        except (TypeError, ValueError):
            start = stop = math.nan
        if not 0 <= start < stop:
            how = 'START-END in seconds, as "10-15,50-", or [(10, 15), (50, math.inf)]'
            raise CorpusError(f"{interval!r} is not an interval; write {how}")
        intervals.append((start, stop))
    return intervals


def cut(start: float, stop: float, intervals: Sequence[Interval]) -> list[tuple[str, Interval]]:
    """Cut intervals out of a recording that lasts from `start` to `stop`.

    Returns:
        (split, interval) in order of time: "test" for the parts cut out, "train" for the rest.
        Overlapping intervals are joined; parts outside the recording are ignored.
    """
    parts: list[tuple[str, Interval]] = []
    at = start
    for begin, end in sorted(intervals):
        begin, end = max(begin, at), min(end, stop)
        if begin >= end:
            continue
        if begin > at:
            parts.append(("train", (at, begin)))
        if begin == at and parts and parts[-1][0] == "test":
            begin = parts.pop()[1][0]
        parts.append(("test", (begin, end)))
        at = end
    if at < stop:
        parts.append(("train", (at, stop)))
    return parts


def split_items(
    recordings: list[Recording], holdout: float, intervals: Sequence[Interval], seed: int
) -> tuple[list[Item], list[Problem]]:
    """Assign recordings to splits and turn them into items.

    A recording's own split counts, except where `intervals` are given. Recordings of one take get
    one split, unless there is only one take.

    Args:
        recordings: examined recordings with their takes, paired and unpaired.
        holdout: fraction to hold out.
        intervals: seconds to hold out of each paired recording instead.
        seed: seed of the choice.

    Returns:
        the items, and problems of pieces that are too short or missing.
    """
    paired = [recording for recording in recordings if recording.audio and recording.motion]
    is_single = len({_original(recording) for recording in paired}) == 1
    if holdout > 0 and not intervals and is_single and paired[0].split is None:
        only = paired[0]
        intervals = [(only.stop - TAIL * (only.stop - only.start), math.inf)]
    items: list[Item] = []
    problems: list[Problem] = []
    if intervals:
        for recording in paired:
            items += _pieces(recording, intervals, problems)
    else:
        items = _whole(paired, holdout, seed, at_least=1)
    of_take: dict[str | None, str | None] = {item.take: item.split for item in items}
    rest = [recording for recording in recordings if not (recording.audio and recording.motion)]
    alone = [replace(r, split=r.split or of_take.get(r.take)) for r in rest]
    items += _whole([recording for recording in alone if recording.audio], holdout, seed)
    items += _whole([recording for recording in alone if recording.motion], holdout, seed)
    return items, problems


def _pieces(
    recording: Recording, intervals: Sequence[Interval], problems: list[Problem]
) -> list[Item]:
    """Cut a recording at motion frames, so that sound and motion of a piece begin together."""

    def on_frame(seconds: float) -> float:
        if math.isinf(seconds) or recording.fps is None:
            return seconds
        return math.floor(seconds * recording.fps + 0.5) / recording.fps

    at_frames = [(on_frame(start), on_frame(stop)) for start, stop in intervals]
    pieces = cut(recording.start, recording.stop, at_frames)
    if not any(split == "test" for split, _ in pieces):
        text = f"nothing of it lies in the seconds held out ({recording.stop:.1f} s long)"
        problems.append(Problem("warning", recording.motion, text))
    items = []
    for split, (start, stop) in pieces:
        if stop - start < MIN_DURATION:
            text = f"{start:.2f} to {stop:.2f} s left out: too short a piece"
            problems.append(Problem("note", recording.motion, text))
            continue
        name = f"{recording.id}@{start:.2f}-{stop:.2f}" if len(pieces) > 1 else recording.id
        items.append(_item(replace(recording, id=name, start=start, stop=stop), split))
    return items


def _whole(
    recordings: Sequence[Recording], holdout: float, seed: int, at_least: int = 0
) -> list[Item]:
    """Return the items of whole recordings; takes without a published split are kept together."""
    free = [recording for recording in recordings if not recording.split]
    are_takes = len({recording.take for recording in free}) > 1
    unit = attrgetter("take") if are_takes else _original
    chosen = choose_held_out(map(unit, free), holdout, seed, at_least=at_least)
    return [
        _item(recording, recording.split or chosen[unit(recording)]) for recording in recordings
    ]


def _original(recording: Recording) -> str:
    """Return the id of a recording, or of the one that it is a copy of."""
    return recording.original or recording.id


def _item(recording: Recording, split: str) -> Item:
    start = round(recording.start, 6)
    return Item(
        id=recording.id,
        take=recording.take or "",
        audio=recording.audio and absolute(recording.audio),
        motion=recording.motion and absolute(recording.motion),
        audio_start=round(start + recording.audio_offset, 6) if recording.audio else 0.0,
        motion_start=start if recording.motion else 0.0,
        # Rounded down: an item never reaches past the end of its files.
        duration=math.floor((recording.stop - start) * 1e6 + 1e-3) / 1e6,
        speaker=recording.speaker,
        style=recording.style,
        split=split,
        channel=recording.channel if recording.audio else None,
        conditions={name: absolute(file) for name, file in recording.conditions.items()},
        reading=recording.reading,
        digests={
            name: file_fingerprint(file)
            for name in ("audio", "motion")
            if (file := getattr(recording, name)) and file.exists()
        },
        audible=recording.audible,
    )
