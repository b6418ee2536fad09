"""Sync: correlation of arm speed with speech energy.

Pearson's r at the best lag within ±0.3 s, with its chance level. Training with a loss that
optimises sync inflates it: report it with the recording's value and with the ratios of arm speed
and jerk. One clip is not enough; average over several.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from audio_features import Wave
from gesturekit.corpus.alignment import arm_speed, smoothed, speech_envelope
from gesturekit.errors import EvaluationError, GestureKitError, MotionError
from gesturekit.motion import Motion

HARDLY_MOVING = 0.05
"""Below this fraction of the recording's arm speed, sync is not informative."""
MIN_SHIFT = 1.0  # seconds; smaller circular shifts are not chance alignments

# Larger than rounding in files.
_STILL = 1e-5  # rad/s
_FLAT = 1e-6  # nepers


@dataclass(frozen=True)
class SyncResult:
    """Result of `sync`.

    Attributes:
        r: Pearson's r at the best lag.
        lag: that lag in seconds; positive if the motion follows the sound.
        chance_mean: mean of r (best lag again) over all circular shifts of more than 1 s.
        chance_sd: their standard deviation.
        z: (r - chance_mean) / chance_sd.
        note: "" or why a value is 0 without having been measured.

    Examples:
        >>> print(SyncResult(r=0.5, lag=0.1, chance_mean=0.1, chance_sd=0.1, z=4.0))
        sync r = 0.50 at lag +0.10 s (chance 0.10 ± 0.10, z = +4.0)
    """

    r: float
    lag: float
    chance_mean: float
    chance_sd: float
    z: float
    note: str = ""

    @property
    def value(self) -> float:
        """The correlation."""
        return self.r

    def __str__(self) -> str:
        text = (
            f"sync r = {self.r:.2f} at lag {self.lag:+.2f} s "
            f"(chance {self.chance_mean:.2f} ± {self.chance_sd:.2f}, z = {self.z:+.1f})"
        )
        return f"{text}: {self.note}" if self.note else text


def sync(motion: Motion, wave: Wave, *, max_lag: float = 0.3) -> SyncResult:
    """Measure the correlation of arm speed with speech energy.

    `arm_speed` in rad/s and `speech_envelope`, ln(RMS over 50 ms + 1e-4), are taken on the common
    frames of motion and sound and smoothed by a Gaussian of σ = 0.1 s. Lag ℓ compares the speed at
    frame k + ℓ with the envelope at frame k, over the frames where both exist. The chance level is
    the same value, best lag included, for the envelope shifted circularly by every number of
    frames more than 1 s from 0.

    Motion without arm movement, constant sound and (for the chance level alone) clips too short to
    shift give zeros and a `note`, never NaN.

    Args:
        motion: any frame rate; values of different frame rates differ slightly.
        wave: the speech, beginning with the motion.
        max_lag: largest lag tried, seconds.

    Raises:
        MotionError: no shoulders and elbows found, or fewer than 3 common frames beyond the
            largest lag.

    Examples:
        A tone whose level is the arm speed of 0.2 s later:

        >>> motion = gk.load("demo").generate(seconds=4)
        >>> level = np.interp(np.arange(60000) / 500 + 6, np.arange(120), arm_speed(motion))
        >>> result = sync(motion, af.Wave(np.exp(level - 9) * np.sin(np.arange(60000)), 15000))
        >>> round(result.lag, 3), round(result.r, 1), result.z > 2
        (0.2, 1.0, True)
    """
    fps = motion.fps
    n = min(motion.n_frames, wave.n_frames(fps))
    lags = np.arange(-math.floor(max_lag * fps + 1e-9), math.floor(max_lag * fps + 1e-9) + 1)
    if n < lags[-1] + 3:
        raise MotionError(
            f"sync needs more than {max_lag:g} s and 3 frames of motion with speech; "
            f"there are {n} frames at {fps:g} fps"
        )
    speed = smoothed(arm_speed(motion)[:n], fps)
    envelope = smoothed(speech_envelope(wave, fps, n), fps)
    if speed.std() < _STILL:
        return SyncResult(0.0, 0.0, 0.0, 0.0, 0.0, "the arms do not move")
    if envelope.std() < _FLAT:
        return SyncResult(0.0, 0.0, 0.0, 0.0, 0.0, "the sound never changes (silence?)")

    r = _r_by_lag_and_shift(speed, envelope, lags)
    best = int(r[:, 0].argmax())
    value, lag = float(r[best, 0]), float(lags[best] / fps)
    shift = np.arange(n)
    chance = r.max(axis=0)[np.minimum(shift, n - shift) > MIN_SHIFT * fps]
    return SyncResult(value, lag, *against_chance(value, chance, n / fps))


def against_chance(
    value: float, chance: np.ndarray, seconds: float
) -> tuple[float, float, float, str]:
    """Return the chance level of a value, its standard deviation, the value's z-score, and a note.

    Args:
        value: that of a motion with its sound.
        chance: (S,) values of all shifts of the sound of more than 1 s; there may be none.
        seconds: length of both.
    """
    if not len(chance):
        note = f"too short ({seconds:.1f} s) to shift by more than {MIN_SHIFT:g} s: chance unknown"
        return 0.0, 0.0, 0.0, note
    mean, sd = float(chance.mean()), float(chance.std())
    return mean, sd, (value - mean) / sd if sd > 1e-9 else 0.0, ""


def sync_of_moving_arms(motion: Motion, recording: Motion, wave: Wave) -> SyncResult:
    """Return `sync`, which is not informative where the arms hardly move.

    Raises:
        EvaluationError: the arms move at less than `HARDLY_MOVING` of the recording's speed.
        MotionError: see `sync`.

    Examples:
        Arms that hardly move beside those of the recording:

        >>> recording = gk.load("demo").generate(seconds=4)
        >>> little = 0.001 * recording.rotations + [0, 0, 0, 1]
        >>> motion = gk.Motion(recording.skeleton, little, recording.translation, 30)
        >>> louder = af.Wave(np.linspace(0, 1, 64000) * np.sin(np.arange(64000)), 16000)
        >>> sync_of_moving_arms(motion, recording, louder)
        Traceback (most recent call last):
        gesturekit.errors.EvaluationError: not informative: the arms move at less than 5 % of the
        recording's speed
    """
    result = sync(motion, wave)
    if result.r != 0.0 and hardly_moves(motion, recording):
        raise EvaluationError(
            f"not informative: the arms move at less than {100 * HARDLY_MOVING:.0f} % of the "
            "recording's speed"
        )
    return result


def hardly_moves(motion: Motion, recording: Motion) -> bool:
    """Return True if the arms move far less than the recording's; False without arms."""
    try:
        ours, own = (arm_speed(m).mean() for m in (motion, recording))
    except GestureKitError:
        return False
    return bool(ours < HARDLY_MOVING * own)


def _r_by_lag_and_shift(x: np.ndarray, y: np.ndarray, lags: np.ndarray) -> np.ndarray:
    """Return Pearson's r (lags, T) of x[k + lag] with y[(k - shift) mod T], all shifts at once.

    x and y are (T,) curves, lags in frames; k are those where x exists. By the convolution theorem:
    O(lags · T log T).
    """
    n = len(x)
    x, y = x - x.mean(), y - y.mean()
    spectra = np.conj(np.fft.rfft(np.stack([y, y**2]), axis=-1))
    floor = 1e-12 * np.array([x.var(), y.var()])
    r = np.zeros((len(lags), n))
    for row, lag in enumerate(lags):
        k = slice(max(0, -lag), n - max(0, lag))
        part = np.zeros(n)
        part[k] = x[k.start + lag : k.stop + lag]
        inside = np.zeros(n)
        inside[k] = 1.0
        count = k.stop - k.start
        cross = np.fft.irfft(np.fft.rfft(part) * spectra[0], n)
        mean_y, mean_yy = np.fft.irfft(np.fft.rfft(inside) * spectra, n) / count
        mean_x = part.sum() / count
        var_x = (part**2).sum() / count - mean_x**2
        var_y = mean_yy - mean_y**2
        known = (var_x > floor[0]) & (var_y > floor[1])
        scale = np.sqrt(np.where(known, var_x * var_y, 1.0))
        r[row] = np.where(known, (cross / count - mean_x * mean_y) / scale, 0.0)
    return np.clip(r, -1.0, 1.0)
