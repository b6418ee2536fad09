"""Prediction of movement from speech while it is spoken: the future is unknown.

The regressions of `WantedMovement` use features on both sides of a frame. Without the later ones
they would lose much of what they know, so a separate pair is fitted for each look-ahead.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from gesturekit.state.prediction import (
    GAP_SECONDS,
    Regression,
    WantedMovement,
    folds_of,
    nearly_best,
    usual_voice,
)

LOOK_AHEADS = (0.0, 0.1, 0.2, 0.4)
"""Seconds of sound after a frame for which predictions are fitted."""
AVERAGED_SECONDS = (2.0, 8.0)
"""Time constants of the running means of features."""
_BIN_SECONDS, _BINS = 0.16, 4
"""Features are averaged over these bins, the last of which ends with the last known frame."""


@dataclass(frozen=True, eq=False)
class FeatureWindow:
    """Speech features up to now.

    Attributes:
        rows: (W, S) the last rows.
        averages: (2, S) running means, see `AVERAGED_SECONDS`.
    """

    rows: np.ndarray
    averages: np.ndarray


def last_bins(speech: FeatureWindow, fps: float) -> np.ndarray:
    """Return (5, S): the features' running mean, and their means in bins relative to it."""
    width = max(1, round(_BIN_SECONDS * fps))
    rows = speech.rows[-_BINS * width :].reshape(_BINS, width, -1).mean(axis=1)
    return np.concatenate([speech.averages[:1], rows - speech.averages[0]])


@dataclass(frozen=True, eq=False, repr=False)
class AheadPrediction:
    """Regressions of fast and slow movement for one look-ahead.

    Attributes:
        look_ahead: seconds.
        fast_columns: of the speech features, for the fast part.
        slow_columns: of the speech features, for the slow part.
        fast: from the values of `last_bins`.
        slow: from `FeatureWindow.averages`.
    """

    look_ahead: float
    fast_columns: np.ndarray
    slow_columns: np.ndarray
    fast: Regression
    slow: Regression

    @classmethod
    def fit(
        cls,
        look_ahead: float,
        speeches: Sequence[Sequence[FeatureWindow]],
        fast: Sequence[np.ndarray],
        slow: Sequence[np.ndarray],
        takes: Sequence[str],
        wanted: WantedMovement,
        columns: Sequence[Sequence[int]],
        rate: float,
    ) -> AheadPrediction:
        """Fit to recordings, sampled at any times.

        Args:
            look_ahead: seconds.
            speeches: what was known of each recording at each of its sampled times.
            fast: fast part of movement, log m/s, at each of these times.
            slow: normal scores of the slow part.
            takes: take of each recording.
            wanted: regressions of the whole sound.
            columns: sets of columns for the fast part, the largest first.
            rate: samples per second.
        """
        folds = folds_of([len(curve) for curve in fast], takes, round(GAP_SECONDS * rate))
        fast_sets = [np.array(numbers) for numbers in columns if len(numbers)]
        slow_sets = [np.array([*numbers, *wanted.effort], int) for numbers in fast_sets]
        of_fast, of_slow = list[Regression](), list[Regression]()
        for numbers in fast_sets:
            inputs = [
                np.stack([_flat(last_bins(window, wanted.fps), numbers) for window in windows])
                for windows in speeches
            ]
            of_fast.append(Regression.fit(inputs, fast, folds))
        for numbers in slow_sets:
            inputs = [
                np.stack([_flat(window.averages, numbers) for window in windows])
                for windows in speeches
            ]
            of_slow.append(Regression.fit(inputs, slow, folds))
        i, j = nearly_best(of_fast), nearly_best(of_slow)
        return cls(look_ahead, fast_sets[i], slow_sets[j], of_fast[i], of_slow[j])

    def __call__(self, speech: FeatureWindow, wanted: WantedMovement) -> tuple[float, float]:
        """Return the fast part of movement, log m/s, and the slow part, in standard deviations."""
        fast = self.fast(_flat(last_bins(speech, wanted.fps), self.fast_columns)[None])[0]
        averages = usual_voice(speech.averages.T, wanted.effort, wanted.voices).T
        slow = self.slow(_flat(averages, self.slow_columns)[None])[0]
        return float(fast * wanted.spread * self.share(wanted)), float(slow)

    def share(self, wanted: WantedMovement) -> float:
        """Return how much of what the whole sound tells of fast movement is known so early."""
        return min(1.0, max(self.fast.r, 0.0) / max(wanted.fast.r, 1e-3))


def live_rows(ahead: Sequence[AheadPrediction]) -> dict[str, str]:
    """Return the correlations for live speech by look-ahead, for the README; empty without."""
    if not ahead:
        return {}
    seconds = ", ".join(f"{prediction.look_ahead:g}" for prediction in ahead)
    fast = ", ".join(f"{prediction.fast.r:.2f}" for prediction in ahead)
    slow = ", ".join(f"{prediction.slow.r:.2f}" for prediction in ahead)
    return {"Live": f"with {seconds} s of look-ahead, r = {fast} (calm or lively {slow})"}


def ahead_values(ahead: Sequence[AheadPrediction]) -> list[dict[str, Any]]:
    """Return the plain values of a model folder."""
    return [
        {
            "look_ahead": prediction.look_ahead,
            "fast_columns": prediction.fast_columns.tolist(),
            "slow_columns": prediction.slow_columns.tolist(),
        }
        for prediction in ahead
    ]


def ahead_tensors(ahead: Sequence[AheadPrediction], where: str) -> dict[str, Tensor]:
    """Return the tensors of a model folder, by names that begin with `where`."""
    tensors: dict[str, Tensor] = {}
    for i, prediction in enumerate(ahead):
        tensors |= prediction.fast.tensors(f"{where}.ahead.{i}.fast")
        tensors |= prediction.slow.tensors(f"{where}.ahead.{i}.slow")
    return tensors


def load_ahead(
    rows: Sequence[Mapping[str, Any]],
    tensors: Mapping[str, Tensor],
    where: str,
    wanted: WantedMovement,
    speech_size: int,
    fps: float,
) -> tuple[AheadPrediction, ...]:
    """Read what `ahead_values` and `ahead_tensors` returned.

    Raises IndexError, TypeError or ValueError for damaged values.
    """
    inputs, averages = (np.zeros((n, speech_size)) for n in (round(fps) + 1, 2))
    ahead = []
    for i, row in enumerate(rows):
        prediction = AheadPrediction(
            min(1.0, max(0.0, float(row["look_ahead"]))),
            np.array(row["fast_columns"], int),
            np.array(row["slow_columns"], int),
            Regression.load(tensors, f"{where}.ahead.{i}.fast"),
            Regression.load(tensors, f"{where}.ahead.{i}.slow"),
        )
        prediction(FeatureWindow(inputs, averages), wanted)  # fails where something does not fit
        ahead.append(prediction)
    return tuple(ahead)


def _flat(rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    return rows[:, columns].reshape(-1)
