"""Which recordings, or which parts of one, training never sees.

With several paired recordings whole recordings are held out: a fraction of them, at least
one, alternately for "test" and "valid". With a single one its last fifth becomes "test". Or
the user names intervals, which are cut out of every recording long enough to hold them.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Iterable, Sequence

from gesturekit.errors import CorpusError

TAIL = 0.2
"""The share of a single recording that is held out, at its end."""

Interval = tuple[float, float]
"""Start and end in seconds; the end may be infinite."""


def held_out(
    ids: Iterable[str], fraction: float, seed: int, *, at_least: int = 0
) -> dict[str, str]:
    """The split of each recording.

    round(fraction · n) recordings are held out, no fewer than `at_least` and never all of them:
    the first for "test", the next for "valid", and so on in turn; the rest is "train". They are
    those with the lowest SHA-256 of seed and id, so the choice depends neither on the order of
    the files nor on the machine, and hardly changes when recordings are added.
    """
    ids = list(ids)
    count = 0
    if fraction > 0:
        count = min(max(at_least, math.floor(fraction * len(ids) + 0.5)), len(ids) - 1)
    ranked = sorted(ids, key=lambda name: hashlib.sha256(f"{seed}:{name}".encode()).digest())
    splits = dict.fromkeys(ids, "train")
    for i, name in enumerate(ranked[: max(count, 0)]):
        splits[name] = "valid" if i % 2 else "test"
    return splits


def as_intervals(wanted: str | Sequence[Interval]) -> list[Interval]:
    """Return intervals in seconds, of a text (`parse_intervals`) or a sequence of (start, end).

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
    """``"10-20,55-"`` as intervals in seconds; without an end, to the end of the recording.

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
        (split, interval) in order of time: "test" for what was cut out, "train" for the rest.
        Intervals that overlap are joined; what lies outside the recording is ignored.
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
