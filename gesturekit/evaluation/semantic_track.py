"""Semantic tracks: the semantic relevance of the gesture at each time."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from audio_features import FeatureTrack
from gesturekit.errors import FormatError
from gesturekit.formats.tables.semantics import load_semantics

_STEP = 0.01  # seconds between values of a track read from intervals


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
    intervals = load_semantics(path)
    if not intervals:
        raise FormatError(f"{path}: no line with a gesture in it")
    times = np.arange(round(max(end for _, end, _ in intervals) / _STEP) + 2) * _STEP
    values = np.zeros((len(times), 1), dtype=np.float32)
    for start, end, score in intervals:
        values[(times >= start) & (times <= end)] = score
    return FeatureTrack(values, times, {"kind": "semantic"}, ("score",))
