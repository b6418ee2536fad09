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
from dataclasses import dataclass, replace
from operator import attrgetter
from pathlib import Path

from gesturekit.corpus.checks import Problem
from gesturekit.corpus.item import Item, file_fingerprint
from gesturekit.corpus.manifest import absolute
from gesturekit.corpus.recording import MIN_DURATION, Recording
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
    count = 0
    if fraction > 0:
        count = min(max(at_least, math.floor(fraction * len(units) + 0.5)), len(units) - 1)
    ranked = sorted(units, key=lambda name: hashlib.sha256(f"{seed}:{name}".encode()).digest())
    splits = dict.fromkeys(units, "train")
    for i, name in enumerate(ranked[: max(count, 0)]):
        splits[name] = "valid" if i % 2 else "test"
    return splits


@dataclass(frozen=True)
class HoldOut:
    """Recordings to hold out as "test"; all others are "train".

    Attributes:
        pattern: regular expression to search for in ids.
        file: text file with one id, or stem of an id, a line.
        speakers: names of speakers.
    """

    pattern: str | None = None
    file: str | os.PathLike[str] | None = None
    speakers: Sequence[str] = ()

    def __bool__(self) -> bool:
        return bool(self.pattern or self.file or self.speakers)

    def apply(self, recordings: Sequence[Recording], copies: str = "") -> list[Recording]:
        """Return the recordings with their splits.

        Args:
            recordings: all of them.
            copies: see `layouts.listing.Listing`; a copy in `file` stands for its recording.

        Raises:
            CorpusError: a pattern, a name or a speaker that fits no recording, or all of them.
        """
        wanted: set[str] = set()
        ids = [recording.id for recording in recordings]
        if self.pattern:
            wanted |= self._matching(ids)
        if self.file:
            wanted |= self._listed(ids, copies)
        known = {recording.speaker for recording in recordings}
        if unknown := sorted(set(self.speakers) - known):
            there = listed(sorted(filter(None, known))) or "none"
            raise CorpusError(
                f"hold-out: no recording of speaker {unknown[0]!r}; the corpus names {there}"
            )
        wanted |= {one.id for one in recordings if one.speaker in self.speakers}
        originals = {_original(one) for one in recordings if one.id in wanted}
        wanted |= {one.id for one in recordings if _original(one) in originals}
        if recordings and len(wanted) == len(recordings):
            raise CorpusError(
                f"all {counted(len(recordings), 'recording')} would be held out, which would "
                "leave none for training"
            )
        return [replace(one, split="test" if one.id in wanted else "train") for one in recordings]

    def _matching(self, ids: list[str]) -> set[str]:
        try:
            found = {name for name in ids if re.search(self.pattern or "", name)}
        except re.error as error:
            raise CorpusError(
                f"hold-out pattern {self.pattern} is not a regular expression: {error}"
            ) from error
        if ids and not found:
            raise CorpusError(
                f"hold-out pattern {self.pattern} matches none of {counted(len(ids), 'recording')},"
                f" such as {ids[0]}"
            )
        return found

    def _listed(self, ids: list[str], copies: str) -> set[str]:
        path = Path(self.file or "")
        try:
            if path.stat().st_size > _MOST_BYTES:
                raise CorpusError(f"{path}: too large for a list of names")
            lines = path.read_text(encoding="utf-8-sig").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise CorpusError(f"{path}: cannot read the list of recordings: {error}") from error
        by_name: dict[str, set[str]] = {}
        for name in ids:
            for key in {name, name.rpartition("/")[2]}:
                by_name.setdefault(key, set()).add(name)
        found: set[str] = set()
        unknown = []
        for line in filter(None, map(str.strip, lines)):
            stem = (Path(line).parent / Path(line).stem).as_posix()
            keys = (line, stem, re.sub(f"({copies})$", "", stem))
            names = next(filter(None, map(by_name.get, keys)), set())
            found |= names
            if not names:
                unknown.append(line)
        if unknown:
            raise CorpusError(
                f"{path}: {counted(len(unknown), 'name')} without a usable recording: "
                f"{listed(unknown, 10)}"
            )
        return found


def as_intervals(wanted: str | Sequence[Interval]) -> list[Interval]:
    """Return intervals in seconds from text (`parse_intervals`) or (start, end) pairs.

    Raises:
        CorpusError: neither, or an interval that ends before it begins.
    """
    if isinstance(wanted, str):
        return parse_intervals(wanted) if wanted else []
    intervals = []
    for interval in wanted:
        try:
            start, stop = map(float, interval)
        except (TypeError, ValueError):
            raise CorpusError(
                f'hold_out_seconds: {interval!r} is not an interval; write "10-15,50-" or '
                "[(10, 15), (50, math.inf)]"
            ) from None
        if not 0 <= start < stop:
            raise CorpusError(f"hold_out_seconds: {interval!r} ends before it begins, or before 0")
        intervals.append((start, stop))
    return intervals


def parse_intervals(text: str) -> list[Interval]:
    """Parse ``"10-20,55-"`` as intervals in seconds; without an end, to the end of the recording.

    Raises:
        CorpusError: not such a list, or an interval that ends before it begins.
    """
    intervals = []
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*-\s*(\d+(?:\.\d+)?)?\s*", part)
        if not match:
            raise CorpusError(
                f"{part.strip()!r} is not an interval; write START-END in seconds, as in 55-68.8, "
                "several separated by commas"
            )
        start, stop = float(match[1]), float(match[2]) if match[2] else math.inf
        if stop <= start:
            raise CorpusError(f"interval {part.strip()!r} ends before it begins")
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
    recordings: list[Recording],
    holdout: float,
    intervals: Sequence[Interval],
    seed: int,
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
    alone = [recording for recording in recordings if not (recording.audio and recording.motion)]
    is_single = len({_original(one) for one in paired}) == 1
    if holdout > 0 and not intervals and is_single and paired[0].split is None:
        only = paired[0]
        intervals = [(only.stop - TAIL * (only.stop - only.start), math.inf)]
    items: list[Item] = []
    problems: list[Problem] = []
    if intervals:
        for recording in paired:
            parts = _parts(recording, intervals)
            if not any(split == "test" for split, _ in parts):
                text = f"nothing of it lies in the seconds held out ({recording.stop:.1f} s long)"
                problems.append(Problem("warning", recording.motion, text))
            for split, (start, stop) in parts:
                if stop - start < MIN_DURATION:
                    text = f"{start:.2f} to {stop:.2f} s left out: too short a piece"
                    problems.append(Problem("note", recording.motion, text))
                    continue
                part = replace(recording, start=start, stop=stop)
                if len(parts) > 1:
                    part = replace(part, id=f"{recording.id}@{start:.2f}-{stop:.2f}")
                items.append(_item(part, split))
    else:
        items += _whole(paired, holdout, seed, at_least=1)
    of_take: dict[str | None, str | None] = {item.take: item.split for item in items}
    for group in (
        [recording for recording in alone if recording.audio],
        [recording for recording in alone if recording.motion],
    ):
        group = [replace(one, split=one.split or of_take.get(one.take)) for one in group]
        items += _whole(group, holdout, seed)
    return items, problems


def _whole(
    recordings: Sequence[Recording], holdout: float, seed: int, at_least: int = 0
) -> list[Item]:
    """Return the items of whole recordings; takes without a published split are kept together."""
    free = [one for one in recordings if not one.split]
    are_takes = len({one.take for one in free}) > 1
    unit = attrgetter("take") if are_takes else _original
    chosen = choose_held_out(map(unit, free), holdout, seed, at_least=at_least)
    return [_item(one, one.split or chosen[unit(one)]) for one in recordings]


def _original(recording: Recording) -> str:
    """Return the id of a recording, or of the one that it is a copy of."""
    return recording.original or recording.id


def _parts(recording: Recording, intervals: Sequence[Interval]) -> list[tuple[str, Interval]]:
    """Cut a recording at motion frames, so that sound and motion of a part begin together."""

    def on_frame(seconds: float) -> float:
        if math.isinf(seconds) or recording.fps is None:
            return seconds
        return math.floor(seconds * recording.fps + 0.5) / recording.fps

    snapped = [(on_frame(start), on_frame(stop)) for start, stop in intervals]
    return cut(recording.start, recording.stop, snapped)


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
