"""Tracks under the player's time line: spectrogram and onsets of speech, contacts and beats."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.signal import find_peaks

from audio_features import LogMel, Onset, Wave
from gesturekit.motion.contacts import contact_labels, foot_points

if TYPE_CHECKING:
    from gesturekit.motion import Motion

BANDS = 32
"""Mel bands of the spectrogram."""
_MOST_COLUMNS = 3_000
_FEWEST = 2
"""Least number of the extractor's frames, of 10 ms, in a column of the spectrogram."""
_BEAT_PROMINENCE = 0.1
"""Least depth of a motion beat, as a share of the curve's 98th percentile."""


def spectrogram(wave: Wave) -> tuple[np.ndarray, float]:
    """Return a log-mel spectrogram (M, BANDS) from 0 to 1, and its columns a second."""
    values = LogMel(n_mels=BANDS).extract(wave).values
    width = max(_FEWEST, -(-len(values) // _MOST_COLUMNS))
    means = np.add.reduceat(values, np.arange(0, len(values), width)) / width
    low, high = np.quantile(values, [0.1, 0.995])
    shares = np.clip((means - low) / max(float(high - low), 1e-3), 0, 1)
    return shares, len(values) / max(wave.duration, 1e-3) / width


def onsets(wave: Wave) -> np.ndarray:
    """Return the times of speech onsets, seconds."""
    track = Onset().extract(wave)
    return track.times[track.values[:, track.names.index("onset_peak")] > 0]


def motion_beats(speed: np.ndarray, fps: float) -> np.ndarray:
    """Return the times of motion beats, seconds: minima of a speed curve (T,)."""
    depth = _BEAT_PROMINENCE * float(np.quantile(speed, 0.98))
    found, _ = find_peaks(-speed, prominence=max(depth, 1e-6))
    return found / fps


def contacts(motion: Motion) -> np.ndarray | None:
    """Return foot contacts (T,) uint8: 1 for the left foot, 2 for the right, 3 for both.

    None for a body without two identified legs. A foot is in contact if any of its points is.
    """
    n_points = len(foot_points(motion.skeleton))
    if not n_points:
        return None
    labels = contact_labels(motion) > 0.5
    left, right = labels[:, : n_points // 2], labels[:, n_points // 2 :]
    return (left.any(axis=1) + 2 * right.any(axis=1)).astype(np.uint8)
