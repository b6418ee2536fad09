"""Prediction of hand movement from speech, for the choice of recorded pieces.

Movement is the logarithm of the hand speed. Its slow part (calm or lively) is predicted from vocal
effort, its fast part (when the hands move) from the speech features around each frame, both by
ridge regression. Predictions vary less than the recordings. So the fast part is scaled to the
recorded spread, and the sum of both is mapped to the recorded distribution, quantile by quantile.

Cross-validation, by takes where there are three, determines how much the predictions are trusted. A
few features replace many that predict hardly better, since few features generalise better to unseen
voices, and predictions with a low correlation are scaled down.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import gaussian_filter1d, uniform_filter1d

log = logging.getLogger(__name__)

# Fixed, as they describe speech and gestures, not a corpus.
SLOW_SECONDS = 2.0
"""Standard deviation of the Gaussian that separates slow from fast movement."""
_BIN_SECONDS = 0.16
_BINS = 5
"""Speech features are averaged over this many bins around a frame."""
_SLOW_INPUT_SECONDS = 1.0
_FRAMES_AT_ONCE = 4096
_MOST_FEATURES = 64
"""Wider speech features are reduced to this many principal components."""
_RIDGES = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
"""Ridge penalties to choose from, relative to the mean variance of the inputs."""
_FOLDS = 4
_LEAST_TAKES, _MOST_FOLDS = 3, 8
"""Least number of takes for a cross-validation over whole takes; its largest number of folds."""
_GAP_SECONDS = 1.0
_CREDIBLE = 0.3
"""Out-of-fold correlation above which predictions are used without scaling down."""
_HARDLY_BETTER = 0.03
"""A larger set of speech features has to raise the out-of-fold correlation by more than this."""
_QUANTILES = np.linspace(0.01, 0.99, 50)


def slow_part(movement: np.ndarray, fps: float) -> np.ndarray:
    """Return the slow part (..., T) of movement (..., T)."""
    return gaussian_filter1d(movement, SLOW_SECONDS * fps, axis=-1, mode="nearest")


@dataclass(frozen=True, eq=False)
class Regression:
    """Ridge regression of one curve, with the distribution of its out-of-fold predictions.

    Attributes:
        mean: (P,) of the inputs.
        weights: (P,).
        offset: mean of the curve.
        predicted: (Q,) quantiles of the out-of-fold predictions.
        recorded: (Q,) the same quantiles of the recordings.
        r: correlation of out-of-fold predictions and recordings.
        left_out: (T,) the out-of-fold predictions of all recordings, one after another; None in a
            loaded model.
    """

    mean: np.ndarray
    weights: np.ndarray
    offset: float
    predicted: np.ndarray
    recorded: np.ndarray
    r: float
    left_out: np.ndarray | None = field(default=None, repr=False)

    @classmethod
    def fit(
        cls, inputs: Sequence[np.ndarray], curves: Sequence[np.ndarray], folds: Folds
    ) -> Regression:
        """Fit to inputs (T_k, P) and curves (T_k,) of each recording.

        The penalty is the one with the best predictions of left-out frames, see `folds_of`.
        """
        x, y = np.concatenate(inputs).astype(float), np.concatenate(curves).astype(float)
        mean, offset = x.mean(axis=0), y.mean()
        predictions = np.zeros((len(y), len(_RIDGES)))
        for out, kept in folds:
            predictions[out] = _predictions_of(x, y, out, kept) + offset
        scores = [correlation(row, y) for row in predictions.T]
        best = int(np.argmax(scores))
        weights = _ridge(x - mean, y - offset)[:, best]
        return cls(
            mean,
            weights,
            float(offset),
            np.quantile(predictions[:, best], _QUANTILES),
            np.quantile(y, _QUANTILES),
            scores[best],
            predictions[:, best],
        )

    def __call__(self, inputs: np.ndarray) -> np.ndarray:
        """Return the predicted curve (T,) from inputs (T, P)."""
        return (inputs - self.mean) @ self.weights + self.offset

    @property
    def trust(self) -> float:
        """Share from 0 to 1 of the predictions' variation that counts."""
        return float(np.clip(self.r / _CREDIBLE, 0.0, 1.0))

    def scaled(self, predictions: np.ndarray) -> np.ndarray:
        """Scale predictions (T,) to the recorded spread, as far as they are trusted."""
        factor = self.recorded.std() / max(self.predicted.std(), 1e-9)
        values = self.recorded.mean() + factor * (predictions - self.predicted.mean())
        return self.trust * np.clip(values, self.recorded[0], self.recorded[-1])

    def trusted(self, predictions: np.ndarray) -> np.ndarray:
        """Draw predictions (T,) towards their mean, as far as left-out ones were wrong."""
        within = np.clip(predictions, self.recorded[0], self.recorded[-1])
        return self.offset + self.trust * (within - self.offset)


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
    and `gap` frames beside them.

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


@dataclass(frozen=True, eq=False)
class WantedMovement:
    """Regressions from speech features to fast and slow movement.

    Attributes:
        fps: frames per second of the speech features.
        effort: columns of the features with vocal effort; empty if there are none.
        basis: (S', M) principal components of the other features, or the choice of some of them;
            None for the features themselves.
        fast: regression of the fast part.
        slow: regression of the slow part.
        predicted: (Q,) quantiles of the movement predicted for left-out recordings.
        recorded: (Q,) the same quantiles of recorded movement.
        voices: (3, E) lowest, mean and highest vocal effort in training, see `usual_voice`.
    """

    fps: float
    effort: tuple[int, ...]
    basis: np.ndarray | None
    fast: Regression = field(repr=False)
    slow: Regression = field(repr=False)
    predicted: np.ndarray = field(repr=False)
    recorded: np.ndarray = field(repr=False)
    voices: np.ndarray = field(repr=False)

    @classmethod
    def fit(
        cls,
        speeches: Sequence[np.ndarray],
        movements: Sequence[np.ndarray],
        fps: float,
        effort: Sequence[int],
        smaller: Sequence[Sequence[int]] = (),
        takes: Sequence[str] = (),
    ) -> WantedMovement:
        """Fit to speech features (S, T_k) and movement (T_k,) of each recording.

        Args:
            speeches: features (S, T_k).
            movements: (T_k,).
            fps: frames per second of both.
            effort: columns of vocal effort.
            smaller: smaller sets of columns, the largest first; one is used instead of all columns
                if it predicts about as well.
            takes: take of each recording; without, each is a part of one take.
        """
        slow = [slow_part(movement, fps) for movement in movements]
        fast = [movement - part for movement, part in zip(movements, slow, strict=True)]
        lengths = [len(movement) for movement in movements]
        takes = takes or [""] * len(lengths)
        folds = folds_of(lengths, takes, round(_GAP_SECONDS * fps))
        effort = tuple(effort)
        bases = _bases(speeches, effort, smaller)
        fitted = [
            Regression.fit([fast_inputs(s, effort, basis, fps) for s in speeches], fast, folds)
            for basis in bases
        ]
        enough = max(regression.r for regression in fitted) - _HARDLY_BETTER
        used = [k for k, regression in enumerate(fitted) if regression.r >= enough][-1]
        of_fast, basis = fitted[used], bases[used]
        inputs = [slow_inputs(speech, effort, basis, fps) for speech in speeches]
        of_slow = Regression.fit(inputs, slow, folds)
        log.info(
            "Hand movement predicted from the speech of left-out %s: r = %s; %d features are used. "
            "Calm or lively: r = %.2f.",
            "takes" if len(set(takes)) >= _LEAST_TAKES else "parts of recordings",
            ", ".join(f"{one.r:.2f} with {len(one.mean) // _BINS} features" for one in fitted),
            len(of_fast.mean) // _BINS,
            of_slow.r,
        )
        efforts = np.concatenate([speech[list(effort)] for speech in speeches], axis=1)
        lowest, highest = np.quantile(efforts, (0.02, 0.98), axis=1)
        left_out = of_fast.scaled(of_fast.left_out) + of_slow.trusted(of_slow.left_out)
        return cls(
            fps,
            effort,
            basis,
            of_fast,
            of_slow,
            np.quantile(left_out, _QUANTILES),
            np.quantile(np.concatenate(movements), _QUANTILES),
            np.stack([lowest, efforts.mean(1), highest]),
        )

    @property
    def predicts(self) -> bool:
        """True if speech predicted some of the movement of left-out recordings."""
        return self.fast.trust > 0 or self.slow.trust > 0

    def __call__(self, speech: np.ndarray) -> np.ndarray:
        """Return the movement predicted from speech features (S, T), and its slow part, (2, T)."""
        speech = usual_voice(speech, self.effort, self.voices)
        slow = self.slow.trusted(self.slow(slow_inputs(speech, self.effort, self.basis, self.fps)))
        inputs = _bins(speech, self.effort, self.basis, self.fps)
        n_frames = speech.shape[1]
        parts = [slice(i, i + _FRAMES_AT_ONCE) for i in range(0, n_frames, _FRAMES_AT_ONCE)]
        fast = np.concatenate([self.fast(_flat(inputs[part])) for part in parts])
        # Quantiles of a constant prediction do not increase.
        predicted = self.predicted + 1e-9 * np.arange(len(self.predicted))
        movement = np.interp(self.fast.scaled(fast) + slow, predicted, self.recorded)
        return np.stack([movement, slow_part(movement, self.fps)])


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
    own = speech[list(effort)].mean(axis=1)
    beyond = np.maximum(own - highest, lowest - own) / np.maximum((highest - lowest) / 2, 1e-3)
    moved = np.clip(beyond - 1.0, 0.0, 1.0) * (own - usual)
    speech = speech.copy()
    speech[list(effort)] -= moved[:, None]
    return speech


def fast_inputs(
    speech: np.ndarray, effort: Sequence[int], basis: np.ndarray | None, fps: float
) -> np.ndarray:
    """Return (T, 5 M) means of the speech features (S, T) in five bins around each frame."""
    return _flat(_bins(speech, effort, basis, fps))


def _bins(
    speech: np.ndarray, effort: Sequence[int], basis: np.ndarray | None, fps: float
) -> np.ndarray:
    """Return a view (T, M, 5) of the features' means in five bins around each frame."""
    features = _reduced(speech, effort, basis)
    width = max(1, round(_BIN_SECONDS * fps))
    means = uniform_filter1d(features, width, axis=0, mode="nearest")
    around = (_BINS // 2) * width
    padded = np.pad(means, ((around, around), (0, 0)), mode="edge")
    return np.lib.stride_tricks.sliding_window_view(padded, 2 * around + 1, axis=0)[..., ::width]


def _flat(bins: np.ndarray) -> np.ndarray:
    """Return (T, 5 M), all features of the first bin, then of the second ..., from (T, M, 5)."""
    return bins.transpose(0, 2, 1).reshape(len(bins), -1)


def slow_inputs(
    speech: np.ndarray, effort: Sequence[int], basis: np.ndarray | None, fps: float
) -> np.ndarray:
    """Return (T, E) vocal effort or, without it, slow means of the speech features (T, M)."""
    if effort:
        columns = speech[list(effort)].T.astype(float)
        return gaussian_filter1d(columns, _SLOW_INPUT_SECONDS * fps, axis=0, mode="nearest")
    return slow_part(_reduced(speech, effort, basis).T, fps).T


def _bases(
    speeches: Sequence[np.ndarray], effort: Sequence[int], smaller: Sequence[Sequence[int]]
) -> list[np.ndarray | None]:
    """Return the values of `WantedMovement.basis` to choose from, the largest first."""
    others = _without(speeches[0].shape[0], effort)
    basis = None
    if len(others) > _MOST_FEATURES:
        x = np.concatenate([speech[others] for speech in speeches], axis=1).astype(float)
        basis = np.linalg.eigh(np.cov(x))[1][:, -_MOST_FEATURES:]
    chosen = [np.eye(len(others))[:, [i in set(own) for i in others]] for own in smaller]
    return [basis, *(part for part in chosen if 0 < part.shape[1] < len(others))]


def _without(count: int, columns: Sequence[int]) -> list[int]:
    return [i for i in range(count) if i not in set(columns)]


def _reduced(speech: np.ndarray, effort: Sequence[int], basis: np.ndarray | None) -> np.ndarray:
    """Return (T, M) features without vocal effort, as principal components if there is a basis."""
    features = speech[_without(len(speech), effort)].T.astype(float)
    return features if basis is None else features @ basis
