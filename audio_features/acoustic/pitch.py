"""Pitch tracking: fundamental frequency and voicing of every frame."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from audio_features.acoustic.frames import HOP, SAMPLE_RATE, centred_frames
from audio_features.errors import FeatureError

F0_RANGE = (60.0, 500.0)
"""Lowest and highest fundamental frequency that is searched for, in Hz."""

_FRAME = 1024  # 64 ms: almost four periods of the lowest voice
_LONGEST_PERIOD = int(np.ceil(SAMPLE_RATE / F0_RANGE[0]))
_SHORTEST_PERIOD = int(SAMPLE_RATE // F0_RANGE[1])
_DIP = 0.1  # a period is accepted where d' falls below this; librosa's value
_CORE = _FRAME - _LONGEST_PERIOD - 1
# pyin searches its best path in segments of a minute that overlap by 4 s. A single search over an
# hour of sound would take gigabytes.
_PATH_FRAMES, _PATH_CONTEXT = 6000, 200


def track_pitch(
    samples: np.ndarray, n_frames: int, tracker: str = "yin"
) -> tuple[np.ndarray, np.ndarray]:
    """Track the fundamental frequency and each frame's periodicity at that frequency.

    Args:
        samples: (N,) float32 at 16 kHz.
        n_frames: number of frames T; frame k is centred at k·0.01 s.
        tracker: one of `TRACKERS`.

    Returns f0 (T,) Hz, always positive (YIN gives a period for noise too), and periodicity (T,)
    in 0..1: the correlation coefficient of the frame with itself one period later (Boersma
    1993). It is 0 where the tracker itself marks the frame as unvoiced.
    """
    f0 = TRACKERS[tracker](samples, n_frames)
    unvoiced = ~(f0 > 0)
    f0 = np.where(unvoiced, F0_RANGE[0], f0)
    periodicity = np.empty(n_frames)
    for first, frames in centred_frames(samples, _FRAME, n_frames):
        here = slice(first, first + len(frames))
        period = np.clip(np.rint(SAMPLE_RATE / f0[here]).astype(int), 1, _LONGEST_PERIOD)
        later = np.lib.stride_tricks.sliding_window_view(frames, _CORE, axis=1)
        later = later[np.arange(len(frames)), period]
        now = frames[:, :_CORE]
        energy = np.einsum("tn,tn->t", now, now) * np.einsum("tn,tn->t", later, later)
        product = np.einsum("tn,tn->t", now, later)
        periodicity[here] = product / np.sqrt(np.maximum(energy, 1e-12))
    periodicity[unvoiced] = 0.0
    return f0, np.clip(periodicity, 0.0, 1.0)


def check_tracker(tracker: str) -> None:
    """Raise FeatureError for an unknown tracker, or one whose package cannot be imported."""
    if tracker not in TRACKERS:
        raise FeatureError(f"f0={tracker!r}: one of {', '.join(TRACKERS)}")
    package, install = _PACKAGES.get(tracker, (None, ""))
    if package is not None:
        try:
            __import__(package)
        except ImportError as error:
            raise FeatureError(
                f"f0={tracker!r} needs the package {package} ({error}): {install}, "
                "or use f0='yin', which needs no package"
            ) from error


def _yin(samples: np.ndarray, n_frames: int) -> np.ndarray:
    """Track f0 (T,) by YIN (de Cheveigne and Kawahara 2002), with the values of librosa.yin.

    Written out because importing librosa takes 20 seconds of compilation when numba's cache is
    empty.
    """
    f0 = np.empty(n_frames)
    for first, frames in centred_frames(samples, _FRAME, n_frames):
        difference = _normalised_difference(frames)
        before, here, after = difference[:, :-2], difference[:, 1:-1], difference[:, 2:]
        # The first dip below the threshold, or the global minimum if there is none.
        dips = np.empty(difference.shape, bool)
        dips[:, 0] = difference[:, 0] < difference[:, 1]
        dips[:, 1:-1] = (here < before) & (here <= after)
        dips[:, -1] = difference[:, -1] < difference[:, -2]
        dips &= difference < _DIP
        lag = np.where(dips.any(axis=1), dips.argmax(axis=1), difference.argmin(axis=1))
        # The vertex of the parabola through the dip and its neighbours, if it lies between them.
        rows, inner = np.arange(len(lag)), np.clip(lag - 1, 0, here.shape[1] - 1)
        low, mid, high = (part[rows, inner] for part in (before, here, after))
        bend, slope = high + low - 2 * mid, (high - low) / 2
        inside = (inner == lag - 1) & (np.abs(slope) < np.abs(bend))
        shift = np.where(inside, -slope / np.where(inside, bend, 1.0), 0.0)
        f0[first : first + len(frames)] = SAMPLE_RATE / (_SHORTEST_PERIOD + lag + shift)
    return f0


def _normalised_difference(frames: np.ndarray) -> np.ndarray:
    """Return the cumulative mean normalised difference d' (M, P) of frames (M, N) (YIN, eq. 8)."""
    from scipy.fft import irfft, rfft

    spectrum = rfft(frames, 2 * _FRAME, axis=1)
    power = np.square(spectrum.real) + np.square(spectrum.imag)
    correlation = irfft(power, 2 * _FRAME, axis=1)[:, : _LONGEST_PERIOD + 1]
    energy = np.cumsum(np.square(frames[:, :_LONGEST_PERIOD]), axis=1)
    energy[:, 0] = 0.0  # librosa's value, which trained models depend on
    difference = 2 * (correlation[:, :1] - correlation[:, 1:]) - energy
    mean = np.cumsum(difference, axis=1) / np.arange(1, _LONGEST_PERIOD + 1)
    wanted = np.s_[:, _SHORTEST_PERIOD - 1 :]
    return difference[wanted] / (mean[wanted] + np.finfo(mean.dtype).tiny)


def _pyin(samples: np.ndarray, n_frames: int) -> np.ndarray:
    """Track f0 (T,) by probabilistic YIN (Mauch and Dixon 2014), about 15 times real time."""
    import librosa

    f0 = np.empty(n_frames)
    for first in range(0, n_frames, _PATH_FRAMES):
        last = min(first + _PATH_FRAMES, n_frames)
        start = max(0, first - _PATH_CONTEXT)
        found = librosa.pyin(
            samples[start * HOP : (last + _PATH_CONTEXT) * HOP],
            fmin=F0_RANGE[0],
            fmax=F0_RANGE[1],
            sr=SAMPLE_RATE,
            frame_length=_FRAME,
            hop_length=HOP,
            fill_na=0.0,
        )[0]
        f0[first:last] = found[first - start : last - start]
    return f0


def _praat(samples: np.ndarray, n_frames: int) -> np.ndarray:
    """Track f0 (T,) by Praat's autocorrelation method (Boersma 1993)."""
    import parselmouth

    sound = parselmouth.Sound(samples.astype(np.float64), SAMPLE_RATE)
    if sound.duration < 3.0 / F0_RANGE[0]:  # the minimum that Praat accepts
        return np.zeros(n_frames)
    pitch = sound.to_pitch_ac(
        time_step=HOP / SAMPLE_RATE, pitch_floor=F0_RANGE[0], pitch_ceiling=F0_RANGE[1]
    )
    found = pitch.selected_array["frequency"]
    nearest = np.rint((np.arange(n_frames) * HOP / SAMPLE_RATE - pitch.x1) / pitch.dx).astype(int)
    inside = (nearest >= 0) & (nearest < len(found))
    return np.where(inside, found[np.clip(nearest, 0, len(found) - 1)], 0.0)


def _world(samples: np.ndarray, n_frames: int) -> np.ndarray:
    """Track f0 (T,) by WORLD's DIO with StoneMask (Morise 2009, 2016)."""
    import pyworld

    signal = samples.astype(np.float64)
    f0, times = pyworld.dio(
        signal,
        SAMPLE_RATE,
        f0_floor=F0_RANGE[0],
        f0_ceil=F0_RANGE[1],
        frame_period=1000 * HOP / SAMPLE_RATE,
    )
    f0 = pyworld.stonemask(signal, f0, times, SAMPLE_RATE)[:n_frames]
    return np.pad(f0, (0, n_frames - len(f0)))


TRACKERS: dict[str, Callable[[np.ndarray, int], np.ndarray]] = {
    "yin": _yin,
    "pyin": _pyin,
    "parselmouth": _praat,
    "pyworld": _world,
}
"""Functions by name: samples (N,) at 16 kHz and T -> f0 (T,) in Hz, 0 where unvoiced."""

_PACKAGES = {
    "parselmouth": ("parselmouth", "pip install praat-parselmouth"),
    "pyworld": ("pyworld", "pip install pyworld 'setuptools<81'"),
}
