"""The slow state of the body: how much it moves, where the hands are held, how wide they reach.

Speech tells little of it, so a mean of what speakers do would be calmer and narrower than any of
them. The state is therefore drawn, for each motion anew, from a random process that is fitted to
the training recordings (a Gaussian copula):

- Each channel has standard normal scores, by rank among the recordings of the same speaker and
  style. A drawn score becomes the recorded value of the same rank, so that drawn values are
  distributed as recorded ones, however skewed those are.
- A score is the part that speech predicts, plus noise with the rest of the variance: one component
  that changes from take to take and one that changes within a take. Both are smooth Gaussian
  noise, correlated between channels as in the recordings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d

from gesturekit.state.prediction import WantedMovement
from gesturekit.state.process import mixing_of, share_between_takes, within_takes

_STEP, _STEPS_OF_TAKE = 0.25, 8
"""Seconds between the points at which noise within takes is drawn; points in each `take`."""
_TRUNCATED = 4.0
"""Gaussians end at this many standard deviations."""
PAUSE = -2.0
"""Predictions as low as in pauses, in standard deviations, which are trusted in full."""
_BLOCK = 256
"""Points of white noise that are drawn at a time in a motion without end."""


@dataclass(frozen=True, eq=False)
class SlowState:
    """Random process of the normal scores of C channels.

    Attributes:
        explained: (C,) correlation of each channel with the prediction from speech.
        trust: factor on these correlations, see `trust_in`.
        mixing: (C, C) Cholesky factor of the noise's correlation between channels.
        between: (C,) share of the noise's variance between takes.
        width: (C,) smoothness of the noise within takes, seconds, see `StateProcess`.
        take: smoothness of the noise between takes, seconds.
    """

    explained: np.ndarray
    trust: float
    mixing: np.ndarray
    between: np.ndarray
    width: np.ndarray
    take: float

    @classmethod
    def fit(
        cls,
        scores: Sequence[np.ndarray],
        wanted: WantedMovement | None,
        takes: Sequence[str],
        fps: float,
    ) -> SlowState:
        """Fit to the recordings.

        Args:
            scores: (C, T_k) of each recording, see `normal_scores`.
            wanted: prediction from speech that was fitted to them; None without.
            takes: take of each recording.
            fps: frames per second.
        """
        explained, trust, noise = np.zeros(len(scores[0])), 0.0, scores
        if wanted is not None and wanted.slow.left_out is not None:
            predicted, trust = wanted.slow.left_out, wanted.trust
            explained = np.concatenate(scores, axis=1) @ predicted / len(predicted)
            ends = np.cumsum([own.shape[1] for own in scores])[:-1]
            noise = [
                own - explained[:, None] * trust_in(part, trust) * part
                for own, part in zip(scores, np.split(predicted, ends), strict=True)
            ]
        pooled = np.concatenate(noise, axis=1)
        sizes = np.maximum(pooled.std(axis=1), 1e-6)
        correlation = (pooled @ pooled.T) / pooled.shape[1] / np.outer(sizes, sizes)
        names = list(dict.fromkeys(takes))
        noise = [own / sizes[:, None] for own in noise]
        within, width = within_takes(noise, fps)
        between = share_between_takes(within, len(names))
        return cls(
            explained,
            trust,
            mixing_of(correlation),
            between,
            width,
            max(pooled.shape[1] / fps / len(names), _STEP),
        )

    def draw(
        self, rng: torch.Generator, n_frames: int, fps: float, predicted: np.ndarray | None
    ) -> np.ndarray:
        """Draw the scores (C, n_frames); a longer motion begins like a shorter one.

        Args:
            rng: random numbers.
            n_frames: frames to draw.
            fps: frames per second.
            predicted: (n_frames,) prediction from speech, in standard deviations; None without.
        """
        first, second = torch.randint(2**62, (2,), generator=rng).tolist()
        seconds = n_frames / fps
        take = _smooth_noise(
            first,
            self.mixing,
            np.full_like(self.width, self.take),
            seconds,
            self.take / _STEPS_OF_TAKE,
            n_frames,
        )
        within = _smooth_noise(second, self.mixing, self.width, seconds, _STEP, n_frames)
        noise = np.sqrt(self.between)[:, None] * take + np.sqrt(1 - self.between)[:, None] * within
        return noise if predicted is None else self._scores(noise, predicted)

    def at(self, seed: int, seconds: float, predicted: float | None) -> np.ndarray:
        """Return the scores (C, 1) at a time of a motion without end.

        Args:
            seed: of the noise.
            seconds: from the beginning.
            predicted: prediction from speech, in standard deviations; None without.
        """
        within = _noise_at(seed, self.mixing, self.width, seconds, _STEP)
        widths, step = np.full_like(self.width, self.take), self.take / _STEPS_OF_TAKE
        take = _noise_at(seed + 1, self.mixing, widths, seconds, step)
        noise = np.sqrt(self.between) * take + np.sqrt(1 - self.between) * within
        noise = noise[:, None]
        return noise if predicted is None else self._scores(noise, np.array([predicted]))

    def _scores(self, noise: np.ndarray, predicted: np.ndarray) -> np.ndarray:
        """Return the scores (C, T) of noise (C, T) and a prediction (T,)."""
        explained = self.explained[:, None] * trust_in(predicted, self.trust)
        return explained * predicted + np.sqrt(np.maximum(1 - explained**2, 0.0)) * noise


def trust_in(predicted: np.ndarray, trust: float) -> np.ndarray:
    """Return the factor on correlations with predictions (T,), in standard deviations.

    Predictions far below the mean, as in pauses, are trusted in full if any are (`trust` above 0):
    people rest while they are silent, on every take.
    """
    if not trust:
        return np.zeros_like(predicted)
    return trust + (1 - trust) * np.clip(PAUSE + 1 - predicted, 0.0, 1.0)


def _smooth_noise(
    seed: int, mixing: np.ndarray, widths: np.ndarray, seconds: float, step: float, n_frames: int
) -> np.ndarray:
    """Return white noise smoothed by Gaussians, (C, n_frames), with standard deviation 1.

    Args:
        seed: of the noise.
        mixing: (C, C) Cholesky factor of the correlation between channels.
        widths: (C,) seconds of the Gaussians.
        seconds: length.
        step: seconds between the points of the white noise.
        n_frames: frames of the result.
    """
    margin = int(np.ceil(_TRUNCATED * widths.max() / step)) + 1
    count = int(np.ceil(seconds / step)) + 1
    white = np.random.default_rng(seed).standard_normal((count + 2 * margin, len(widths)))
    white = mixing @ white.T
    at = (np.arange(n_frames) + 0.5) * (seconds / n_frames / step)
    rows = []
    for row, width in zip(white, widths, strict=True):
        kernel = _kernel(width / step, margin)
        smooth = np.convolve(row, kernel, mode="valid") / np.linalg.norm(kernel)
        rows.append(np.interp(at, np.arange(len(smooth)), smooth))
    return np.stack(rows)


def _noise_at(
    seed: int, mixing: np.ndarray, widths: np.ndarray, seconds: float, step: float
) -> np.ndarray:
    """Return white noise smoothed by Gaussians at one time, (C,); arguments as `_smooth_noise`."""
    margin = int(np.ceil(_TRUNCATED * widths.max() / step)) + 1
    first, part = divmod(seconds / step, 1)
    points = int(first) + np.arange(2 * margin + 2)
    blocks = range(points[0] // _BLOCK, points[-1] // _BLOCK + 1)
    white = np.concatenate([_white(seed, block, len(widths)) for block in blocks])
    white = mixing @ white[points - blocks[0] * _BLOCK].T
    found = []
    for row, width in zip(white, widths, strict=True):
        kernel = _kernel(width / step, margin)
        before, after = np.convolve(row, kernel, mode="valid") / np.linalg.norm(kernel)
        found.append(before + part * (after - before))
    return np.array(found)


@lru_cache(maxsize=64)
def _white(seed: int, block: int, channels: int) -> np.ndarray:
    """Return a block of white noise, (_BLOCK, channels)."""
    return np.random.default_rng((seed, block)).standard_normal((_BLOCK, channels))


def _kernel(width: float, margin: int) -> np.ndarray:
    """Return a Gaussian (2 margin + 1,) whose standard deviation is `width` points."""
    impulse = np.zeros(2 * margin + 1)
    impulse[margin] = 1.0
    return gaussian_filter1d(impulse, width, truncate=_TRUNCATED)
