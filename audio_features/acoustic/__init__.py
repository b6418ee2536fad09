"""Acoustic features: bands, MFCC, prosody, onsets, prosodic range, vocal effort, and music.

The sound has 16 kHz and frames every 10 ms; `track_pitch` gives fundamental frequency and voicing,
`ShortTimeSpectrum` the short-time Fourier transform and what the extractors have in common.
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
from typing import Any

import numpy as np
from filelock import FileLock

from audio_features.errors import FeatureError
from audio_features.track import FeatureTrack
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
        around = np.pad(difference, ((0, 0), (1, 1)), constant_values=np.inf)
        before, after = around[:, :-2], around[:, 2:]
        # The first dip below the threshold, or the global minimum if there is none.
        dips = (difference < before) & (difference <= after) & (difference < _DIP)
        lag = np.where(dips.any(axis=1), dips.argmax(axis=1), difference.argmin(axis=1))
        # The vertex of the parabola through the dip and its neighbours, if it lies between them.
        rows, inner = np.arange(len(lag)), np.clip(lag, 1, difference.shape[1] - 2)
        low, mid, high = (difference[rows, inner + step] for step in (-1, 0, 1))
        bend, slope = high + low - 2 * mid, (high - low) / 2
        inside = (inner == lag) & (np.abs(slope) < np.abs(bend))
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
_AUDIBLE_DB = -30.0  # quieter frames, relative to active speech, are unvoiced and without tilt
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

    Args:
        wave: the sound.
        device: torch device on which torchaudio computes; None for soxr and scipy.

    Attributes:
        wave: the prepared sound, 16 kHz.
        n_frames: number of frames T.
        times: (T,) float64 seconds.
    """

    _backend: Any = None

    def __init__(self, wave: Wave, device: str | None = None) -> None:
        if device is None:
            wave = wave.resample(SAMPLE_RATE)
        else:
            from audio_features.acoustic.torchaudio_backend import Backend

            self._backend = Backend(device)
            wave = self._backend.resampled(wave, SAMPLE_RATE)
        self.wave = wave.at_level()
        self.n_frames = wave.n_frames(FRAME_RATE)
        self.times = np.arange(self.n_frames) / FRAME_RATE
        self._log_mels: dict[int, np.ndarray] = {}

    @classmethod
    def of_frames(cls, times: np.ndarray, power: np.ndarray, melody: Melody) -> ShortTimeSpectrum:
        """Return a spectrum of frames whose power and melody are known."""
        spectrum = cls.__new__(cls)
        known = {"times": times, "n_frames": len(times), "power": power, "melody": melody}
        vars(spectrum).update(known, _log_mels={})
        return spectrum

    @cached_property
    def melody(self) -> Melody:
        """Pitch, voicing and energy."""
        rms = self.wave.rms(self.times, window=0.05)
        energy = to_db(np.square(rms) / 10.0 ** (SPEECH_LEVEL_DBFS / 10.0))
        return audible_melody(*track_pitch(self.wave.samples, self.n_frames), energy)

    @cached_property
    def power(self) -> np.ndarray:
        """Power (T, 257) float32; a frame's sum is its mean square relative to active speech."""
        if self._backend is None:
            return short_time_power(self.wave.samples, self.n_frames)
        return self._backend.power(self.wave.samples, self.n_frames, hann_window(), N_FFT, HOP)

    def log_mel(self, n_mels: int) -> np.ndarray:
        """Return (T, n_mels) float32 band powers in dB relative to active speech, at least -60."""
        if n_mels not in self._log_mels:
            filters = mel_filters if self._backend is None else self._backend.mel_filters
            self._log_mels[n_mels] = to_db(self.power @ filters(n_mels).T)
        return self._log_mels[n_mels]

    @cached_property
    def onset(self) -> np.ndarray:
        """Spectral flux (T,): the mean rise of 40 log-mel bands over 20 ms, in dB."""
        bands = self.log_mel(BANDS)
        onset = np.zeros(self.n_frames)
        onset[_ONSET_LAG:] = np.maximum(bands[_ONSET_LAG:] - bands[:-_ONSET_LAG], 0.0).mean(axis=1)
        return onset


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


_OCTAVE_GUARD = 7.0  # semitones; see `ProsodicRange`


class AcousticExtractor:
    """Features computed from a `ShortTimeSpectrum`, 100 frames per second.

    The level is normalised on active speech, and the floor of every logarithm is relative to
    that level: the same words 20 dB quieter give the same values. Silence gives the floor.

    Attributes:
        spec: JSON-serialisable settings from which `extractor_from_spec` builds this extractor.
        names: names of the D columns.
        centred: D flags; true for columns whose mean over a clip depends only on voice and
            recording conditions, so that it may be subtracted.
        worth_caching: false; extraction is about as fast as reading the result from a cache.
        device: device on which torchaudio computes the spectrum; None for numpy and soxr.
    """

    spec: dict[str, Any]
    names: tuple[str, ...]
    centred: tuple[bool, ...]
    worth_caching = False
    device: str | None = None

    @property
    def dim(self) -> int:
        """Number of columns D."""
        return len(self.names)

    def extract(
        self, wave: Wave, spectra: dict[str | None, ShortTimeSpectrum] | None = None
    ) -> FeatureTrack:
        """Extract the features of a sound: values (T, D), frame k centred at k·0.01 s.

        Args:
            wave: the sound.
            spectra: its spectra by device, which several extractors may share.
        """
        spectra = {} if spectra is None else spectra
        if self.device not in spectra:
            spectra[self.device] = ShortTimeSpectrum(wave, self.device)
        return self.from_spectrum(spectra[self.device])

    def from_spectrum(self, spectrum: ShortTimeSpectrum) -> FeatureTrack:
        """Extract the features (T, D) from a spectrum that other extractors may share."""
        return FeatureTrack(self._values(spectrum), spectrum.times, self.spec, self.names)

    def _values(self, spectrum: ShortTimeSpectrum) -> np.ndarray:
        """Compute the values (T, D)."""
        raise NotImplementedError

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.spec})"


class LogMel(AcousticExtractor):
    """Powers of `n_mels` (1 to 80) mel bands in dB relative to active speech, at least -60.

    Args:
        n_mels: number of bands.
        backend: "numpy", or "torchaudio" if it is installed.
        device: torch device for torchaudio. Not part of the spec.

    Examples:
        The power of a tone of 220 Hz is in the lowest of 8 bands:

        >>> seconds = np.arange(16000) / 16000
        >>> tone = af.Wave.from_array(np.sin(2 * np.pi * 220 * seconds), 16000)
        >>> bands = af.LogMel(n_mels=8).extract(tone).values
        >>> bands.shape
        (100, 8)
        >>> int(bands[50].argmax())
        0
    """

    def __init__(self, n_mels: int = 24, backend: str = "numpy", device: str = "cpu") -> None:
        self.n_mels = _checked("n_mels", n_mels, 1, MAX_MELS)
        self.device = _device(backend, device)
        self.spec = {"kind": "logmel", "n_mels": self.n_mels, "backend": backend}
        self.names = tuple(f"mel_{i}" for i in range(self.n_mels))
        self.centred = (True,) * self.n_mels

    def _values(self, spectrum: ShortTimeSpectrum) -> np.ndarray:
        return spectrum.log_mel(self.n_mels)


class MFCC(AcousticExtractor):
    """First `n` (1 to 40) mel-frequency cepstral coefficients, including the 0th.

    Orthonormal DCT-II of 40 log-mel bands in dB, no liftering (librosa's convention). Listen,
    Denoise, Action (Alexanderson et al. 2023) uses 20 for Trinity speech and 16 for ZeroEGGS,
    computed by madmom with other bands and another logarithm: the values differ.

    Args:
        n: number of coefficients.
        backend, device: see `LogMel`.

    Examples:
        A second of sound has 100 frames:

        >>> seconds = np.arange(16000) / 16000
        >>> tone = af.Wave.from_array(np.sin(2 * np.pi * 220 * seconds), 16000)
        >>> af.MFCC(n=13).extract(tone).values.shape
        (100, 13)
    """

    def __init__(self, n: int = 20, backend: str = "numpy", device: str = "cpu") -> None:
        self.n = _checked("n", n, 1, BANDS)
        self.device = _device(backend, device)
        self.spec = {"kind": "mfcc", "n": self.n, "backend": backend}
        self.names = tuple(f"mfcc_{i}" for i in range(self.n))
        self.centred = (True,) * self.n

    def _values(self, spectrum: ShortTimeSpectrum) -> np.ndarray:
        from scipy.fft import dct

        return dct(spectrum.log_mel(BANDS), norm="ortho")[:, : self.n]


class Prosody(AcousticExtractor):
    """Pitch, voicing, energy and onsets of speech: four columns.

    - `f0`: semitones relative to the clip's median over voiced frames; 0 where unvoiced.
    - `voicing`: 0 to 1, periodicity at the fundamental; 0 in frames too quiet to be voiced.
    - `energy`: dB of the RMS over 50 ms, relative to active speech, at least -60.
    - `onset`: spectral flux, the mean rise of 40 log-mel bands over 20 ms in dB.

    Args:
        f0: pitch tracker; "yin".

    Examples:
        A tone rises by an octave, 12 semitones, and keeps its energy:

        >>> seconds = np.arange(16000) / 16000
        >>> hertz = np.where(seconds < 0.5, 220, 440)
        >>> wave = af.Wave.from_array(np.sin(2 * np.pi * hertz * seconds), 16000)
        >>> track = af.Prosody().extract(wave).at([0.25, 0.75])
        >>> track.names
        ('f0', 'voicing', 'energy', 'onset')
        >>> np.abs(np.diff(track.values[:, [0, 2]], axis=0).round())
        array([[12.,  0.]], dtype=float32)
    """

    names = ("f0", "voicing", "energy", "onset")
    centred = (True,) * 4

    def __init__(self, f0: str = "yin") -> None:
        if f0 != "yin":
            raise FeatureError(f"f0={f0!r}: only 'yin' is known")
        self.spec = {"kind": "prosody", "f0": f0}

    def _values(self, spectrum: ShortTimeSpectrum) -> np.ndarray:
        melody = spectrum.melody
        columns = [melody.semitones, melody.voicing, melody.energy, spectrum.onset]
        return np.stack(columns, axis=1)


class Onset(AcousticExtractor):
    """Onset strength and onset peaks: two columns.

    - `onset_strength`: spectral flux, the mean rise of 40 log-mel bands over 20 ms in dB.
    - `onset_peak`: 1 at its peaks, as librosa picks them, else 0. Use `to_rate(method="mean")`
      to align it with motion frames: no peak is lost.

    Examples:
        A tone begins after half a second and fades:

        >>> seconds = np.arange(16000) / 16000
        >>> fading = np.where(seconds < 0.5, 0, np.exp(4 - 8 * seconds))
        >>> wave = af.Wave.from_array(fading * np.sin(2 * np.pi * 220 * seconds), 16000)
        >>> track = af.Onset().extract(wave)
        >>> track.times[track.values[:, 1] > 0].round(1)
        array([0.5])
    """

    names = ("onset_strength", "onset_peak")
    centred = (True, False)

    def __init__(self) -> None:
        self.spec = {"kind": "onset"}

    def _values(self, spectrum: ShortTimeSpectrum) -> np.ndarray:
        peaks = np.zeros(spectrum.n_frames)
        peaks[_peaks(spectrum.onset)] = 1.0
        return np.stack([spectrum.onset, peaks], axis=1)


def _peaks(strength: np.ndarray) -> list[int]:
    """Return the peak frames of an onset strength (T,), as librosa.util.peak_pick finds them.

    Uses librosa's default window lengths, in frames of 10 ms; a peak is 1 dB above the local mean.
    librosa itself is not imported: with an empty numba cache it compiles for 20 seconds.
    """
    highest = np.max(np.lib.stride_tricks.sliding_window_view(np.pad(strength, (3, 0)), 4), axis=1)
    around = np.ones(21)
    total, count = (
        np.convolve(values, around)[10:-10] for values in (strength, np.ones(len(strength)))
    )
    picked: list[int] = []
    for frame in np.flatnonzero((strength == highest) & (strength >= total / count + 1.0)).tolist():
        if not picked or frame - picked[-1] > 3:
            picked.append(frame)
    return picked


class ProsodicRange(AcousticExtractor):
    """Local variation of pitch and energy: two columns.

    - `f0_range`: mean distance of the pitch from its local mean over voiced frames, semitones.
      Pitch is clipped to 7 semitones around the clip's median because trackers make octave
      errors.
    - `energy_range`: the same for the energy, in dB.

    Both are averaged with a Gaussian whose standard deviation is `seconds`. A monotonous clip
    has low values throughout, so the clip's mean must not be subtracted.

    Examples:
        A steady tone varies by nothing, one that jumps by an octave does:

        >>> seconds = np.arange(16000) / 16000
        >>> for second in (220, 440):
        ...     hertz = np.where(seconds < 0.5, 220, second)
        ...     wave = af.Wave.from_array(np.sin(2 * np.pi * hertz * seconds), 16000)
        ...     print(af.ProsodicRange().extract(wave).values[50, 0] > 0.1)
        False
        True
    """

    names = ("f0_range", "energy_range")
    centred = (False, False)

    def __init__(self, seconds: float = 1.0) -> None:
        self.seconds = float(_checked("seconds", seconds, 0.05, 60.0))
        self.spec = {"kind": "prosodic_range", "seconds": self.seconds}

    def _values(self, spectrum: ShortTimeSpectrum) -> np.ndarray:
        from scipy.ndimage import gaussian_filter1d

        melody = spectrum.melody
        sigma = self.seconds * FRAME_RATE
        # The small constant keeps the range low where only a few frames are voiced.
        weight = gaussian_filter1d(melody.voiced.astype(float), sigma, mode="constant") + 0.02
        columns = []
        for values in (np.clip(melody.semitones, -_OCTAVE_GUARD, _OCTAVE_GUARD), melody.energy):
            spoken = np.where(melody.voiced, values, 0.0)
            mean = gaussian_filter1d(spoken, sigma, mode="constant") / weight
            distance = np.where(melody.voiced, np.abs(values - mean), 0.0)
            columns.append(gaussian_filter1d(distance, sigma, mode="constant") / weight)
        return np.stack(columns, axis=1)


def _device(backend: str, device: str) -> str | None:
    if backend == "numpy":
        return None
    if backend != "torchaudio":
        raise FeatureError(f"backend={backend!r}: one of numpy, torchaudio")
    from audio_features.acoustic.torchaudio_backend import Backend

    Backend(device)  # an error before any sound is read
    return device


def _checked(name: str, value: Any, low: float, high: float) -> Any:
    """Return a number of the type of `low`; raise FeatureError unless it is in range."""
    is_whole, kinds = isinstance(low, int), int if isinstance(low, int) else (int, float)
    if isinstance(value, bool) or not isinstance(value, kinds) or not low <= value <= high:
        what = "a whole number" if is_whole else "a number"
        raise FeatureError(f"{name}={value!r}: {what} from {low:g} to {high:g}")
    return value


_LOW_BAND, _HIGH_BAND = (80.0, 1000.0), (1000.0, 5000.0)
"""Bands of the spectral tilt, Hz: forceful voices have more of the upper one."""
_FEW = 0.5
"""Seconds of the clip's own value that count into every window, for windows with little speech."""
_HOP = 0.5
"""Seconds between windows; values between them are interpolated."""
_QUIET_TILT = -30.0
"""Spectral tilt of a clip without speech, dB."""


class Effort(AcousticExtractor):
    """Vocal effort in a window around each frame: three columns.

    - `effort_f0_median`, `effort_f0_high`: median and 90 % quantile of the pitch over voiced
      frames, semitones above 60 Hz; 0 in a clip without voice.
    - `effort_tilt`: 90 % quantile of the spectral tilt, the power in 1 to 5 kHz over that in 80 Hz
      to 1 kHz, over audible frames, in dB.

    Raised voices are higher and have more power in the upper band (Traunmüller and Eriksson 2000).
    Neither depends on the level of the recording. A calm clip has low values throughout, so the
    clip's mean must not be subtracted.

    Args:
        seconds: length of the window.

    Examples:
        A tone of 120 Hz is an octave, 12 semitones, above 60 Hz:

        >>> seconds = np.arange(16000) / 16000
        >>> tone = af.Wave.from_array(np.sin(2 * np.pi * 120 * seconds), 16000)
        >>> af.Effort().extract(tone).values[50, 0].round()
        np.float32(12.0)
    """

    names = ("effort_f0_median", "effort_f0_high", "effort_tilt")
    centred = (False, False, False)

    def __init__(self, seconds: float = 8.0) -> None:
        self.seconds = float(_checked("seconds", seconds, 0.5, 120.0))
        self.spec = {"kind": "effort", "seconds": self.seconds}

    def _values(self, spectrum: ShortTimeSpectrum) -> np.ndarray:
        melody = spectrum.melody
        pitch = 12.0 * np.log2(melody.f0 / F0_RANGE[0])
        hertz = np.fft.rfftfreq(N_FFT, 0.5 / 8000.0)
        bands = [(hertz >= low) & (hertz < high) for low, high in (_LOW_BAND, _HIGH_BAND)]
        power = spectrum.power @ np.stack(bands, axis=1).astype(np.float32) + 1e-6
        tilt = 10.0 * np.log10(power[:, 1] / power[:, 0])
        audible = melody.energy >= _AUDIBLE_DB
        columns = [self._quantile(pitch, melody.voiced, share, 0.0) for share in (0.5, 0.9)]
        return np.stack([*columns, self._quantile(tilt, audible, 0.9, _QUIET_TILT)], axis=1)

    def _quantile(
        self, values: np.ndarray, valid: np.ndarray, share: float, empty: float
    ) -> np.ndarray:
        """Return the quantile (T,) of the valid values in the window around each frame."""
        if not valid.any():
            return np.full(len(values), empty)
        own, few = np.quantile(values[valid], share), _FEW * FRAME_RATE
        hop, half = round(_HOP * FRAME_RATE), round(self.seconds * FRAME_RATE / 2)
        centres = np.arange(0, len(values) + hop, hop)
        quantiles = []
        for centre in centres:
            window = slice(max(0, centre - half), centre + half)
            inside = values[window][valid[window]]
            found = np.quantile(inside, share) if len(inside) else own
            quantiles.append((len(inside) * found + few * own) / (len(inside) + few))
        return np.interp(np.arange(len(values)), centres, quantiles)


BEATS_PER_MINUTE = (50.0, 200.0)
"""Slowest and fastest tempo that is searched for."""

_CHROMA_WINDOW = 3072  # 192 ms (madmom: 186 ms): long enough for semitones, short enough for chords
_CHROMA_RANGE = 100.0, 5000.0  # Hz, madmom's range for pitch classes
_TEMPO_FRAMES = 6 * FRAME_RATE  # the tempo is estimated in windows of 6 s


class Music(AcousticExtractor):
    """Chroma, spectral flux and beats of music: `n_chroma` + 2 columns, 100 frames per second.

    - `chroma_0` … : share of the energy in each of `n_chroma` pitch classes from A upwards, over
      192 ms, 100 Hz to 5 kHz. The shares sum to 1, and to 0 in silence. With `n_chroma=1` the
      single column is the total loudness in dB, as `Prosody`'s energy.
    - `spectral_flux`: the mean rise of 40 log-mel bands over 20 ms in dB.
    - `beat_activation`: 0 to 1, highest on the beats; the predominant local pulse (Grosche and
      Müller 2011) of the flux, 50 to 200 beats per minute. Steady beats reach 1, uncertain ones
      stay lower.

    Listen, Denoise, Action (Alexanderson et al. 2023) uses three columns of the same names,
    computed by madmom: one chroma, an unnormalised spectral flux, and the activation of its
    RNNDownBeatProcessor (Böck et al. 2016). Their code is not published. `Music(n_chroma=1)` has
    the same columns on another scale. Beats of another tracker are read from files: `Files`.

    Args:
        n_chroma: pitch classes per octave, 1 to 36; 12 gives semitones.

    Raises FeatureError for a number out of range.

    Examples:
        The note A, 440 Hz, is the first of 12 pitch classes:

        >>> seconds = np.arange(16000) / 16000
        >>> tone = af.Wave.from_array(np.sin(2 * np.pi * 440 * seconds), 16000)
        >>> track = af.Music().extract(tone)
        >>> track.values.shape, track.names[int(track.values[50, :12].argmax())]
        ((100, 14), 'chroma_0')
    """

    def __init__(self, n_chroma: int = 12) -> None:
        self.n_chroma = _checked("n_chroma", n_chroma, 1, 36)
        self.spec = {"kind": "music", "n_chroma": self.n_chroma}
        chroma = tuple(f"chroma_{i}" for i in range(self.n_chroma))
        self.names = (*chroma, "spectral_flux", "beat_activation")
        # The means of chroma (key) and activation (beat strength) are properties of the music.
        self.centred = (False,) * self.n_chroma + (True, False)

    def _values(self, spectrum: ShortTimeSpectrum) -> np.ndarray:
        flux, beats = spectrum.onset[:, None], local_pulse(spectrum.onset)[:, None]
        return np.concatenate([self._chroma(spectrum), flux, beats], axis=1)

    def _chroma(self, spectrum: ShortTimeSpectrum) -> np.ndarray:
        if self.n_chroma == 1:
            return spectrum.melody.energy[:, None]
        from scipy.fft import rfft

        window = np.hanning(_CHROMA_WINDOW + 1)[:-1].astype(np.float32)
        classes = _pitch_classes(self.n_chroma)
        chroma = np.empty((spectrum.n_frames, self.n_chroma), dtype=np.float32)
        blocks = centred_frames(spectrum.wave.samples, _CHROMA_WINDOW, spectrum.n_frames)
        for first, frames in blocks:
            for at in range(0, len(frames), 500):  # frames are long here: 500 are 6 MB
                short = rfft(frames[at : at + 500] * window)
                power = (short.real**2 + short.imag**2) @ classes
                total = power.sum(axis=1, keepdims=True)
                chroma[first + at : first + at + len(power)] = power / (total + 1e-3)
        return chroma


def local_pulse(flux: np.ndarray) -> np.ndarray:
    """Return the predominant local pulse (T,) of Grosche and Müller 2011.

    Finds the strongest tempo of the flux and its phase in a window of 6 s around every frame,
    overlap-adds the sinusoids of all windows, and sets negative values to zero.

    Args:
        flux: (T,) at 100 frames per second.

    The result is 1 on beats that all windows agree on, and 0 between beats or without flux.
    Unlike librosa.beat.plp, every window has the same weight, and the scale does not depend on
    the clip's maximum.
    """
    librosa = import_librosa()
    n, size = len(flux), _TEMPO_FRAMES
    if n < size:
        return local_pulse(np.pad(flux, (0, size - n)))[:n]
    pulse = np.empty(n)
    tempo = librosa.fourier_tempo_frequencies(sr=FRAME_RATE, win_length=size, hop_length=1)
    wanted = (tempo >= BEATS_PER_MINUTE[0]) & (tempo <= BEATS_PER_MINUTE[1])
    for first in range(0, n, _BLOCK_FRAMES):
        last = min(first + _BLOCK_FRAMES, n)
        start, stop = max(0, first - size), min(n, last + size)
        tempogram = librosa.feature.fourier_tempogram(
            onset_envelope=flux[start:stop], sr=FRAME_RATE, hop_length=1, win_length=size
        )
        strength = np.where(wanted[:, None], np.abs(tempogram), 0.0)
        # The strongest tempo alone, at magnitude 1; a constant flux has no beat.
        is_best = np.arange(len(tempo))[:, None] == strength.argmax(axis=0)
        is_best &= strength.max(axis=0) > 1e-3 * size
        unit = tempogram / np.maximum(np.abs(tempogram), 1e-9)
        tempogram[:, :] = np.where(is_best, unit, 0.0)
        sinusoids = librosa.istft(tempogram, hop_length=1, n_fft=size, length=stop - start)
        pulse[first:last] = sinusoids[first - start : last - start]
    # A bin of magnitude 1 is a sinusoid of amplitude 2/n in each window. The overlapping Hann
    # windows sum to n/2, and istft divides by the sum of their squares, 3n/8.
    return np.clip(pulse * size * 3 / 8, 0.0, 1.0)


@lru_cache
def _pitch_classes(n: int) -> np.ndarray:
    """Return a (1537, n) float32 one-hot map of FFT bins to pitch classes, from A (440 Hz) up."""
    frequencies = np.fft.rfftfreq(_CHROMA_WINDOW, 1 / SAMPLE_RATE)
    inside = (frequencies >= _CHROMA_RANGE[0]) & (frequencies <= _CHROMA_RANGE[1])
    place = n * np.log2(np.maximum(frequencies, 1.0) / 440.0)
    nearest = np.mod(np.rint(place).astype(int), n)
    classes = np.zeros((len(frequencies), n), dtype=np.float32)
    classes[np.arange(len(frequencies))[inside], nearest[inside]] = 1.0
    return classes
