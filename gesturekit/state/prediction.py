"""Prediction of hand movement from speech.

Movement is the logarithm of the hand speed. Its fast part (when the hands move) is predicted from
the speech features around each frame, its slow part (calm or lively) from the slow part of the
features and from vocal effort, both by ridge regression. Cross-validation over whole takes
determines how much each prediction counts: it enters as its conditional mean, r times the recorded
standard deviation for each standard deviation of the prediction. What it leaves open is drawn.

A few features replace many that predict hardly better, since few features generalise better to
unseen voices.

While speech is spoken its future is unknown. Without the later features the regressions would lose
much of what they know, so that a separate pair is fitted for each look-ahead.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter1d, uniform_filter1d

log = logging.getLogger(__name__)

SLOW_SECONDS = 2.0
"""Standard deviation of the Gaussian that separates slow from fast movement."""
# Fixed, as they describe speech and gestures, not a corpus.
_BIN_SECONDS = 0.16
_BINS = 5
"""Speech features are averaged over this many bins around a frame."""
_FRAMES_AT_ONCE = 4096
_MOST_FEATURES = 64
"""Wider speech features are reduced to this many principal components."""
_RIDGES = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
"""Ridge penalties to choose from, relative to the mean variance of the inputs."""
_FOLDS = 4
_LEAST_TAKES, _MOST_FOLDS = 3, 8
"""Least number of takes for a cross-validation over whole takes; its largest number of folds."""
_GAP_SECONDS = 6.0
"""Left out beside a part of a recording, as slow movement is correlated over several seconds."""
_WITHIN_TAKE = 0.5
"""Factor on the correlation of the slow part if it was found on left-out parts of one or two takes.
Three ZeroEGGS takes have 0.79 within a take and 0.69 on left-out takes; other speakers may have
less. Predictions of pauses count in full."""
_MEAN_COUNTS, _PRIOR_TAKES = 0.3, 4.0
"""Factor on the mean prediction of an utterance before any take was left out, because the mean also
depends on the voice, the microphone and the room; and the number of left-out takes that count as
much as this expectation."""
_MOST_FITTED = 30_000
"""Number of frames that weights are fitted to; of more, every second, third ... is used. Frames
beside each other are alike: 20 minutes at 25 fps are as good as an hour at a third of that rate."""
_FURTHEST = 2.5
"""Predictions are limited to this many standard deviations."""
_HARDLY_BETTER = 0.03
"""A larger set of speech features has to raise the out-of-fold correlation by more than this."""


LOOK_AHEADS = (0.0, 0.1, 0.2, 0.4)
"""Seconds of sound after a frame for which predictions of live speech are fitted."""
AVERAGED_SECONDS = (2.0, 8.0)
"""Time constants of the running means of live features."""
_LIVE_BINS = 4
"""Live features are averaged over this many bins, the last of which ends with the last frame."""


def slow_part(curves: np.ndarray, fps: float) -> np.ndarray:
    """Return the slow part (..., T) of curves (..., T)."""
    return gaussian_filter1d(curves, SLOW_SECONDS * fps, mode="nearest")


@dataclass(frozen=True, eq=False, repr=False)
class Regression:
    """Ridge regression of one curve, in standard deviations of its out-of-fold predictions.

    Attributes:
        mean: (P,) of the inputs.
        weights: (P,).
        offset: prediction at the mean of the inputs.
        r: correlation of out-of-fold predictions and recordings.
        left_out: (T,) the out-of-fold predictions of all recordings, one after another; None in a
            loaded model.
    """

    mean: np.ndarray
    weights: np.ndarray
    offset: float
    r: float
    left_out: np.ndarray | None = None

    @classmethod
    def fit(
        cls, inputs: Sequence[np.ndarray], curves: Sequence[np.ndarray], folds: Folds
    ) -> Regression:
        """Fit to inputs (T_k, P) and curves (T_k,) of each recording.

        The penalty is the one with the best predictions of left-out frames, see `folds_of`.
        """
        x, y = np.concatenate(inputs).astype(float), np.concatenate(curves).astype(float)
        mean, offset = x.mean(axis=0), y.mean()
        every = -(-len(y) // _MOST_FITTED)
        fitted = np.arange(len(y)) % every == 0
        predictions = np.zeros((len(y), len(_RIDGES)))
        for out, kept in folds:
            predictions[out] = _predictions_of(x, y, out, kept & fitted) + offset
        scores = [correlation(row, y) for row in predictions.T]
        best = int(np.argmax(scores))
        curve = predictions[:, best]
        size = max(curve.std(), 1e-9)
        return cls(
            mean,
            _ridge(x[::every] - mean, y[::every])[:, best] / size,
            float((offset - curve.mean()) / size),
            scores[best],
            np.clip((curve - curve.mean()) / size, -_FURTHEST, _FURTHEST),
        )

    def __call__(self, inputs: np.ndarray) -> np.ndarray:
        """Return the predicted curve (T,) from inputs (T, P), in standard deviations."""
        predictions = (inputs - self.mean) @ self.weights + self.offset
        return np.clip(predictions, -_FURTHEST, _FURTHEST)


def _ridge(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the weights (P, R) for each penalty."""
    values, vectors = np.linalg.eigh(x.T @ x)
    values = np.maximum(values, 0.0)
    penalties = np.array(_RIDGES) * max(values.mean(), 1e-9)
    return vectors @ ((vectors.T @ (x.T @ y))[:, None] / (values[:, None] + penalties))


def _predictions_of(x: np.ndarray, y: np.ndarray, out: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Return (M, R) predictions of the frames `out`, from the frames `kept`, both (T,) bool."""
    if kept.sum() < 2:
        kept = np.ones(len(y), bool)
    mean = x[kept].mean(axis=0)
    weights = _ridge(x[kept] - mean, y[kept] - y[kept].mean())
    return (x[out] - mean) @ weights + (y[kept].mean() - y.mean())


Folds = Sequence[tuple[np.ndarray, np.ndarray]]
"""(frames to predict, frames to fit to), both (T,) bool over all recordings, of each fold."""


def folds_of(lengths: Sequence[int], takes: Sequence[str], gap: int) -> Folds:
    """Return the folds of a cross-validation.

    Three or more takes are left out as a whole. With fewer, about `_FOLDS` parts of recordings are,
    and `gap` frames beside them, or half the length of a part.

    Args:
        lengths: frames of each recording.
        takes: take of each recording.
        gap: frames.
    """
    n_frames, first = sum(lengths), 0
    names = list(dict.fromkeys(takes))
    if len(names) >= _LEAST_TAKES:
        of_frame = np.repeat([names.index(take) for take in takes], lengths)
        fold_of = np.arange(len(names)) % _MOST_FOLDS
        return [((out := fold_of[of_frame] == k), ~out) for k in np.unique(fold_of)]
    folds = []
    gap = min(gap, n_frames // (2 * _FOLDS))
    for length in lengths:
        count = max(1, round(length / (n_frames / _FOLDS)))
        edges = np.linspace(first, first + length, count + 1).astype(int)
        for start, stop in zip(edges[:-1], edges[1:], strict=True):
            out, kept = np.zeros(n_frames, bool), np.ones(n_frames, bool)
            out[start:stop] = True
            kept[max(first, start - gap) : min(first + length, stop + gap)] = False
            folds.append((out, kept))
        first += length
    return folds


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Return Pearson's r of two curves (T,); 0 if one of them is constant."""
    a, b = a - a.mean(), b - b.mean()
    size = np.sqrt((a @ a) * (b @ b))
    return float(a @ b / size) if size > 1e-12 else 0.0


@dataclass(frozen=True, eq=False, repr=False)
class WantedMovement:
    """Regressions from speech features to fast and slow movement.

    Attributes:
        fps: frames per second of the speech features.
        effort: columns of the features with vocal effort; empty if there are none.
        fast_basis: (S, M) principal components of the features, or the choice of some of them,
            from which the fast part is predicted.
        slow_basis: (S, M') the same for the slow part.
        fast: regression of the fast part.
        slow: regression of the slow part.
        mean_counts: factor on the mean of the slow part's prediction for an utterance.
        spread: conditional mean of the fast part for each standard deviation of its prediction, log
            m/s.
        across_takes: True if the correlations were found on left-out takes.
        voices: (3, E) lowest, mean and highest vocal effort in training, see `usual_voice`.
    """

    fps: float
    effort: tuple[int, ...]
    fast_basis: np.ndarray
    slow_basis: np.ndarray
    fast: Regression
    slow: Regression
    mean_counts: float
    spread: float
    across_takes: bool
    voices: np.ndarray

    @classmethod
    def fit(
        cls,
        speeches: Sequence[np.ndarray],
        movements: Sequence[np.ndarray],
        slow: Sequence[np.ndarray],
        fps: float,
        effort: Sequence[int],
        smaller: Sequence[Sequence[int]] = (),
        takes: Sequence[str] = (),
    ) -> WantedMovement:
        """Fit to speech features (S, T_k) and movement (T_k,) of each recording.

        Args:
            speeches: features (S, T_k).
            movements: (T_k,).
            slow: (T_k,) normal scores of the slow part of movement.
            fps: frames per second of both.
            effort: columns of vocal effort.
            smaller: smaller sets of columns, the largest first; one is used instead of all columns
                if it predicts about as well.
            takes: take of each recording; without, each is a part of one take.
        """
        fast = [movement - slow_part(movement, fps) for movement in movements]
        lengths = [len(movement) for movement in movements]
        takes = takes or [""] * len(lengths)
        folds = folds_of(lengths, takes, round(_GAP_SECONDS * fps))
        effort = tuple(effort)
        bases = _bases(speeches, effort, smaller)
        of_fast, fast_basis = _best(speeches, fast, folds, bases, partial(fast_inputs, fps=fps))
        voice = np.eye(len(speeches[0]))[:, effort]
        with_voice = [np.concatenate([basis, voice], axis=1) for basis in bases]
        of_slow, slow_basis = _best(
            speeches,
            slow,
            folds,
            [*with_voice, *bases, *([voice] if effort else [])],
            partial(slow_inputs, fps=fps),
        )
        mean_counts, of_slow = _steadied(of_slow, slow, takes)
        efforts = np.concatenate([speech[list(effort)] for speech in speeches], axis=1)
        lowest, highest = np.quantile(efforts, (0.02, 0.98), axis=1)
        wanted = cls(
            fps,
            effort,
            fast_basis,
            slow_basis,
            of_fast,
            of_slow,
            mean_counts,
            float(max(of_fast.r, 0.0) * np.concatenate(fast).std()),
            len(set(takes)) >= _LEAST_TAKES,
            np.stack([lowest, efforts.mean(1), highest]),
        )
        log.info("Hand movement predicted from speech: %s.", wanted.summary())
        return wanted

    @property
    def trust(self) -> float:
        """Factor on the correlations of slow channels with the prediction."""
        return float(self.slow.r > 0) * (1.0 if self.across_takes else _WITHIN_TAKE)

    @property
    def predicts(self) -> bool:
        """True if speech predicted some of the movement of left-out recordings."""
        return self.spread > 0 or self.trust > 0

    def summary(self) -> str:
        """Return the correlations, how they were found, and the numbers of features."""
        halved = f" (taken as {self.trust * max(self.slow.r, 0.0):.2f} on other takes)"
        return (
            f"when the hands move, r = {self.fast.r:.2f} with {self.fast_basis.shape[1]} features; "
            f"calm or lively, r = {self.slow.r:.2f} with {self.slow_basis.shape[1]} features"
            f"{'' if self.across_takes else halved}; found on left-out "
            f"{'takes' if self.across_takes else 'parts of recordings'}"
        )

    def __call__(self, speech: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the fast part of movement, in log m/s, and the prediction of the slow part, in
        standard deviations, both (T,), from speech features (S, T)."""
        speech = usual_voice(speech, self.effort, self.voices)
        slow = self.slow(slow_inputs(speech, self.slow_basis, self.fps))
        slow -= (1 - self.mean_counts) * slow.mean()
        bins = _bins(speech, self.fast_basis, self.fps)
        starts = range(0, len(bins), _FRAMES_AT_ONCE)
        fast = [self.fast(_flat(bins[start : start + _FRAMES_AT_ONCE])) for start in starts]
        return self.spread * np.concatenate(fast), slow


def usual_voice(speech: np.ndarray, effort: Sequence[int], voices: np.ndarray) -> np.ndarray:
    """Return speech features (S, T) with an unusual voice moved to the mean of training voices.

    A voice whose mean effort is at most half the training range outside that range is left as it
    is, so that a calm clip stays calm. Further out, the difference tells more of the speaker than
    of the effort.

    Args:
        speech: (S, T).
        effort: the E columns of vocal effort.
        voices: (3, E) lowest, mean and highest effort in training.
    """
    if not len(effort):
        return speech
    lowest, usual, highest = voices
    mean = speech[list(effort)].mean(axis=1)
    beyond = np.maximum(mean - highest, lowest - mean) / np.maximum((highest - lowest) / 2, 1e-3)
    moved = np.clip(beyond - 1.0, 0.0, 1.0) * (mean - usual)
    speech = speech.copy()
    speech[list(effort)] -= moved[:, None]
    return speech


def fast_inputs(speech: np.ndarray, basis: np.ndarray, fps: float) -> np.ndarray:
    """Return (T, 5 M) means of the features (S, T), in a basis, in five bins around each frame."""
    return _flat(_bins(speech, basis, fps))


def _bins(speech: np.ndarray, basis: np.ndarray, fps: float) -> np.ndarray:
    """Return a view (T, M, 5) of the features' means in five bins around each frame.

    Means are without their slow part, which an unseen take has at another level.
    """
    features = speech.T.astype(float) @ basis
    features -= slow_part(features.T, fps).T
    width = max(1, round(_BIN_SECONDS * fps))
    means = uniform_filter1d(features, width, axis=0, mode="nearest")
    around = (_BINS // 2) * width
    padded = np.pad(means, ((around, around), (0, 0)), mode="edge")
    return np.lib.stride_tricks.sliding_window_view(padded, 2 * around + 1, axis=0)[..., ::width]


def _flat(bins: np.ndarray) -> np.ndarray:
    """Return (T, 5 M), all features of the first bin, then of the second ..., from (T, M, 5)."""
    return bins.transpose(0, 2, 1).reshape(len(bins), -1)


def slow_inputs(speech: np.ndarray, basis: np.ndarray, fps: float) -> np.ndarray:
    """Return (T, M) the slow part of the features (S, T) in a basis."""
    return slow_part((speech.T.astype(float) @ basis).T, fps).T


def _best(
    speeches: Sequence[Any],
    curves: Sequence[np.ndarray],
    folds: Folds,
    bases: Sequence[np.ndarray],
    inputs: Callable[[Any, np.ndarray], np.ndarray],
) -> tuple[Regression, np.ndarray]:
    """Return the regression of the last of the bases that predicts about as well as the best."""
    fitted = [
        Regression.fit([inputs(speech, basis) for speech in speeches], curves, folds)
        for basis in bases
    ]
    enough = max(regression.r for regression in fitted) - _HARDLY_BETTER
    used = [k for k, regression in enumerate(fitted) if regression.r >= enough][-1]
    return fitted[used], bases[used]


def _steadied(
    regression: Regression, slow: Sequence[np.ndarray], takes: Sequence[str]
) -> tuple[float, Regression]:
    """Return `WantedMovement.mean_counts`, and the regression in its new standard deviations.

    The factor is the slope of the takes' recorded means over their predicted means, relative to the
    slope within takes.

    Args:
        regression: of the slow part.
        slow: (T_k,) recorded slow part.
        takes: take of each recording.
    """
    assert regression.left_out is not None
    ends = np.cumsum([len(curve) for curve in slow])[:-1]
    predicted = np.split(regression.left_out, ends)
    names, counts = list(dict.fromkeys(takes)), _MEAN_COUNTS
    if len(names) >= _LEAST_TAKES:
        of_take = [[k for k, take in enumerate(takes) if take == name] for name in names]
        means, changes = [], []
        for curves in (predicted, slow):
            takes_of = [np.concatenate([curves[k] for k in members]) for members in of_take]
            means.append(np.array([curve.mean() for curve in takes_of]))
            changes.append(np.concatenate([curve - curve.mean() for curve in curves]))
        slope = _slope(*means) / max(_slope(*changes), 1e-6)
        n = len(names) - 1
        counts = (n * np.clip(slope, 0.0, 1.0) + _PRIOR_TAKES * counts) / (n + _PRIOR_TAKES)
    predicted = np.concatenate([curve - (1 - counts) * curve.mean() for curve in predicted])
    size = max(predicted.std(), 1e-9)
    return float(counts), replace(
        regression,
        weights=regression.weights / size,
        offset=regression.offset / size,
        r=correlation(predicted, np.concatenate(slow)),
        left_out=predicted / size,
    )


def _slope(x: np.ndarray, y: np.ndarray) -> float:
    """Return the slope of the least-squares line; 0 if x is constant."""
    x = x - x.mean()
    return float(x @ y / (x @ x)) if x @ x > 1e-12 else 0.0


def _bases(
    speeches: Sequence[np.ndarray], effort: Sequence[int], smaller: Sequence[Sequence[int]]
) -> list[np.ndarray]:
    """Return the bases (S, M) to choose from, the largest first; none has vocal effort."""
    every = np.eye(len(speeches[0]))
    others = [i for i in range(len(every)) if i not in effort]
    largest = every[:, others]
    if len(others) > _MOST_FEATURES:
        x = np.concatenate([speech[others] for speech in speeches], axis=1).astype(float)
        largest = largest @ np.linalg.eigh(np.cov(x))[1][:, -_MOST_FEATURES:]
    chosen = [every[:, [i for i in others if i in columns]] for columns in smaller]
    return [largest, *(basis for basis in chosen if 0 < basis.shape[1] < len(others))]


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
    rows = speech.rows[-_LIVE_BINS * width :].reshape(_LIVE_BINS, width, -1).mean(axis=1)
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
        folds = folds_of([len(curve) for curve in fast], takes, round(_GAP_SECONDS * rate))
        fast_sets = [np.array(numbers) for numbers in columns if len(numbers)]
        slow_sets = [np.array([*numbers, *wanted.effort], int) for numbers in fast_sets]

        def bins(windows: Sequence[FeatureWindow], numbers: np.ndarray) -> np.ndarray:
            return np.stack([last_bins(each, wanted.fps)[:, numbers].ravel() for each in windows])

        def averages(windows: Sequence[FeatureWindow], numbers: np.ndarray) -> np.ndarray:
            return np.stack([each.averages[:, numbers].ravel() for each in windows])

        of_fast, fast_columns = _best(speeches, fast, folds, fast_sets, bins)
        of_slow, slow_columns = _best(speeches, slow, folds, slow_sets, averages)
        return cls(look_ahead, fast_columns, slow_columns, of_fast, of_slow)

    def __call__(self, speech: FeatureWindow, wanted: WantedMovement) -> tuple[float, float]:
        """Return the fast part of movement, log m/s, and the slow part, in standard deviations."""
        fast = self.fast(last_bins(speech, wanted.fps)[:, self.fast_columns].reshape(1, -1))[0]
        averages = usual_voice(speech.averages.T, wanted.effort, wanted.voices).T
        slow = self.slow(averages[:, self.slow_columns].reshape(1, -1))[0]
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
