"""Semantic tracks: the semantic relevance of the gesture at each time."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from audio_features import FeatureTrack
from gesturekit.errors import FormatError

_STEP = 0.01  # seconds between values of a track read from intervals
_LONGEST = 24 * 3600.0


def read_semantic(path: Path) -> FeatureTrack:
    """Read a semantic track: (T, 1) scores from 0 to 1 at times in seconds.

    A feature file (npz) of one column, or BEAT's table (txt): tab-separated lines of gesture
    name, start, end, duration (seconds), score, keywords; 0 where there is no gesture.

    Raises:
        FormatError: the table is invalid.
        FeatureError: the feature file is invalid.
    """
    if path.suffix.lower() == ".npz":
        track = FeatureTrack.load(path)
        if track.values.shape[1] != 1:
            raise FormatError(
                f"{path}: {track.values.shape[1]} columns; a semantic track has one, the score"
            )
        return track
    intervals = []
    with path.open(encoding="utf-8", errors="replace", newline="") as file:
        for number, row in enumerate(csv.reader(file, delimiter="\t"), start=1):
            if not row:
                continue
            try:
                start, end, score = float(row[1]), float(row[2]), float(row[4])
                if not (0 <= start <= end <= _LONGEST and 0 <= score <= 1):
                    raise ValueError
            except (IndexError, ValueError):
                raise FormatError(
                    f"{path}: line {number}: {' '.join(row)[:60]!r}: expected name, start, end, "
                    "duration (seconds) and score (0 to 1), separated by tabs"
                ) from None
            intervals.append((start, end, score))
    if not intervals:
        raise FormatError(f"{path}: no line with a gesture in it")
    times = np.arange(round(max(end for _, end, _ in intervals) / _STEP) + 2) * _STEP
    values = np.zeros((len(times), 1), dtype=np.float32)
    for start, end, score in intervals:
        values[(times >= start) & (times <= end)] = score
    return FeatureTrack(values, times, {"kind": "semantic"}, ("score",))
