"""Analysis that all acoustic features share: frames every 10 ms, pitch, short-time spectrum.

The sound has 16 kHz; `track_pitch` gives fundamental frequency and voicing, `ShortTimeSpectrum` the
short-time Fourier transform and what follows from it.
"""

from __future__ import annotations

import getpass
import importlib
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from pathlib import Path
from types import ModuleType

import numpy as np
from filelock import FileLock

from audio_features.wave import SPEECH_LEVEL_DBFS, Wave

SAMPLE_RATE = 16_000
"""Sample rate in Hz of every acoustic feature."""
FRAME_RATE = 100
"""Frames per second: frame k is centred at k·10 ms."""
HOP = SAMPLE_RATE // FRAME_RATE
"""Samples between two frames."""

_BLOCK_FRAMES = 3000  # 30 s processed at a time, which bounds the memory for long files


_COMPILED = ("beat", "core.pitch", "feature.rhythm", "onset", "sequence", "util.utils")
_SECONDS = 300.0  # to wait for another process, which compiles for some 20 s


@cache
def import_librosa() -> ModuleType:
    """Return librosa with all modules whose functions are compiled; one process at a time.

    librosa compiles functions when it is imported, and numba keeps them in files. Two processes
    that fill an empty cache at once leave one with which every later process crashes.
    """
    with ExitStack() as held:
        # Without a lock where a file cannot be locked, or the user has no name.
        with suppress(OSError, KeyError, ImportError):
            file = Path(tempfile.gettempdir()) / f"librosa-{getpass.getuser()}.lock"
            held.enter_context(FileLock(file, timeout=_SECONDS))
        for module in _COMPILED:
            importlib.import_module(f"librosa.{module}")
        return importlib.import_module("librosa")


def centred_frames(
    samples: np.ndarray, length: int, n_frames: int
) -> Iterator[tuple[int, np.ndarray]]:
    """Yield (first frame, (m, length) view) blocks of frames centred every 10 ms, zero-padded."""
    for first in range(0, n_frames, _BLOCK_FRAMES):
        count = min(_BLOCK_FRAMES, n_frames - first)
        start = first * HOP - length // 2
        stop = start + (count - 1) * HOP + length
        block = samples[max(start, 0) : stop]
        block = np.pad(block, (max(-start, 0), stop - max(start, 0) - len(block)))
        yield first, np.lib.stride_tricks.sliding_window_view(block, length)[::HOP]


F0_RANGE = (60.0, 500.0)
"""Lowest and highest fundamental frequency that is searched for, in Hz."""

_FRAME = 1024  # 64 ms: almost four periods of the lowest voice
_LONGEST_PERIOD = int(np.ceil(SAMPLE_RATE / F0_RANGE[0]))
_SHORTEST_PERIOD = int(SAMPLE_RATE // F0_RANGE[1])
_DIP = 0.1  # a period is accepted where d' falls below this; librosa's value
_CORE = _FRAME - _LONGEST_PERIOD - 1


def track_pitch(samples: np.ndarray, n_frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Track the fundamental frequency and each frame's periodicity at that frequency.

    Args:
        samples: (N,) float32 at 16 kHz.
        n_frames: number of frames T; frame k is centred at k·0.01 s.

    Returns f0 (T,) Hz, always positive (YIN gives a period for noise too), and periodicity (T,)
    in 0..1: the correlation coefficient of the frame with itself one period later (Boersma
    1993).
    """
    f0 = _yin(samples, n_frames)
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
    return f0, np.clip(periodicity, 0.0, 1.0)


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

    spectrum = rfft(frames, 2 * _FRAME)
    power = np.square(spectrum.real) + np.square(spectrum.imag)
    correlation = irfft(power, 2 * _FRAME)[:, : _LONGEST_PERIOD + 1]
    energy = np.cumsum(np.square(frames[:, :_LONGEST_PERIOD]), axis=1)
    energy[:, 0] = 0.0  # librosa's value, which trained models depend on
    difference = 2 * (correlation[:, :1] - correlation[:, 1:]) - energy
    mean = np.cumsum(difference, axis=1) / np.arange(1, _LONGEST_PERIOD + 1)
    wanted = np.s_[:, _SHORTEST_PERIOD - 1 :]
    return difference[wanted] / (mean[wanted] + np.finfo(mean.dtype).tiny)


FLOOR_DB = -60.0
"""Added to every power before the logarithm, relative to the active speech level."""
MAX_MELS = 80
"""Largest number of mel bands; more would be narrower than the 31 Hz between two FFT bins."""

BANDS = 40
"""Mel bands from which MFCC and onset strength are computed."""

WINDOW = 400  # 25 ms
N_FFT = 512
VOICED = 0.6  # periodicity from which a frame counts as voiced
_AUDIBLE_DB = -30.0  # quieter frames than this, relative to active speech, are unvoiced
_ONSET_LAG = 2  # frames: windows 20 ms apart hardly overlap, so a rise appears at full size
# Slaney's mel scale: linear up to 15 mel (1 kHz), logarithmic above.
_MEL_HZ, _MEL_LOG_STEP = 200.0 / 3, np.log(6.4) / 27.0


def to_db(power: np.ndarray) -> np.ndarray:
    """Convert power relative to active speech to dB, at least -60: 10·log10(power + floor)."""
    return 10.0 * np.log10(power + 10.0 ** (FLOOR_DB / 10.0))


@dataclass(frozen=True)
class Melody:
    """Pitch, voicing and energy of a voice, 100 frames per second.

    Attributes:
        semitones: (T,) pitch relative to the clip's median over voiced frames; 0 where unvoiced.
        voicing: (T,) 0 to 1, periodicity at the fundamental; 0 in frames too quiet.
        energy: (T,) dB of the RMS over 50 ms, relative to active speech, at least -60.
        voiced: (T,) bool, true where `voicing` is high enough for a pitch to be meaningful.
        f0: (T,) fundamental frequency, Hz; meaningful where voiced.
    """

    semitones: np.ndarray
    voicing: np.ndarray
    energy: np.ndarray
    voiced: np.ndarray
    f0: np.ndarray


def audible_melody(
    f0: np.ndarray, voicing: np.ndarray, energy: np.ndarray, median: float | None = None
) -> Melody:
    """Return the melody of pitch, voicing and energy, each (T,); quiet frames become unvoiced.

    Pitch is relative to `median` in Hz, by default that of the voiced frames.
    """
    voicing = np.where(energy < _AUDIBLE_DB, 0.0, voicing)
    voiced = voicing >= VOICED
    semitones = np.zeros_like(f0)
    if voiced.any():
        usual = np.median(f0[voiced]) if median is None else median
        semitones[voiced] = 12.0 * np.log2(f0[voiced] / usual)
    return Melody(semitones, voicing, energy, voiced, f0)


class ShortTimeSpectrum:
    """A sound prepared for the acoustic features.

    The sound is resampled to 16 kHz and scaled to the standard active level, so that the same
    words at another level give the same features. Frames are 25 ms (Hann) every 10 ms; frame k
    is centred at k·0.01 s.

    Attributes:
        wave: the prepared sound, 16 kHz.
        n_frames: number of frames T.
        times: (T,) float64 seconds.
    """

    def __init__(self, wave: Wave) -> None:
        self.wave = self._resampled(wave).at_level()
        self.n_frames = wave.n_frames(FRAME_RATE)
        self.times = np.arange(self.n_frames) / FRAME_RATE
        self._log_mels: dict[int, np.ndarray] = {}

    @cached_property
    def melody(self) -> Melody:
        """Pitch, voicing and energy."""
        rms = self.wave.rms(self.times, window=0.05)
        energy = to_db(np.square(rms) / 10.0 ** (SPEECH_LEVEL_DBFS / 10.0))
        return audible_melody(*track_pitch(self.wave.samples, self.n_frames), energy)

    @cached_property
    def power(self) -> np.ndarray:
        """Power (T, 257) float32; a frame's sum is its mean square relative to active speech."""
        return short_time_power(self.wave.samples, self.n_frames)

    def log_mel(self, n_mels: int) -> np.ndarray:
        """Return (T, n_mels) float32 band powers in dB relative to active speech, at least -60."""
        if n_mels not in self._log_mels:
            self._log_mels[n_mels] = to_db(self.power @ self._mel_filters(n_mels).T)
        return self._log_mels[n_mels]

    @cached_property
    def onset(self) -> np.ndarray:
        """Spectral flux (T,): the mean rise of 40 log-mel bands over 20 ms, in dB."""
        bands = self.log_mel(BANDS)
        onset = np.zeros(self.n_frames)
        onset[_ONSET_LAG:] = np.maximum(bands[_ONSET_LAG:] - bands[:-_ONSET_LAG], 0.0).mean(axis=1)
        return onset

    def _resampled(self, wave: Wave) -> Wave:
        return wave.resample(SAMPLE_RATE)

    def _mel_filters(self, n_mels: int) -> np.ndarray:
        return mel_filters(n_mels)


def short_time_power(samples: np.ndarray, n_frames: int) -> np.ndarray:
    """Return the power (T, 257) float32 of 16 kHz samples at the level of active speech."""
    power = np.empty((n_frames, N_FFT // 2 + 1), dtype=np.float32)
    for first, block in power_blocks(samples, n_frames):
        power[first : first + len(block)] = block
    return power


def power_blocks(samples: np.ndarray, n_frames: int) -> Iterator[tuple[int, np.ndarray]]:
    """Yield (first frame, (m, 257) float32) blocks of what `short_time_power` returns."""
    from scipy.fft import rfft

    window = hann_window()
    for first, frames in centred_frames(samples, WINDOW, n_frames):
        spectrum = rfft(frames * window, N_FFT)
        yield first, spectrum.real**2 + spectrum.imag**2


def hann_window() -> np.ndarray:
    """Return the Hann window (WINDOW,) float32, scaled so that active speech has power 1."""
    window = np.hanning(WINDOW + 1)[:-1]
    active = 10.0 ** (SPEECH_LEVEL_DBFS / 10.0)
    return (window * np.sqrt(2.0 / (np.sum(window**2) * N_FFT * active))).astype(np.float32)


@lru_cache
def mel_filters(n_mels: int) -> np.ndarray:
    """Return (n_mels, 257) float32 triangles of height 1 on Slaney's scale, 50 Hz to 8 kHz."""
    # Bit-identical to librosa.filters.mel(norm=None). Importing librosa takes 20 seconds of
    # compilation when numba's cache is empty.
    lowest, highest = 50.0 / _MEL_HZ, 15.0 + np.log(SAMPLE_RATE / 2 / 1000.0) / _MEL_LOG_STEP
    mels = np.linspace(lowest, highest, n_mels + 2)
    edges = np.where(mels < 15.0, _MEL_HZ * mels, 1000.0 * np.exp(_MEL_LOG_STEP * (mels - 15.0)))
    ramps = np.subtract.outer(edges, np.fft.rfftfreq(N_FFT, 1.0 / SAMPLE_RATE))
    widths = np.diff(edges)[:, None]
    rising, falling = -ramps[:-2] / widths[:-1], ramps[2:] / widths[1:]
    return np.maximum(0.0, np.minimum(rising, falling)).astype(np.float32)
