"""Acoustic features: bands, MFCC, prosody, onsets, prosodic range, vocal effort, and music."""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import lru_cache
from typing import Any

import numpy as np

from audio_features.acoustic.analysis import (
    BANDS,
    F0_RANGE,
    FRAME_RATE,
    MAX_MELS,
    N_FFT,
    SAMPLE_RATE,
    ShortTimeSpectrum,
    centred_frames,
    import_librosa,
)
from audio_features.errors import FeatureError
from audio_features.track import FeatureTrack
from audio_features.wave import Wave

BACKENDS = ("numpy", "torchaudio")
_OCTAVE_GUARD = 7.0  # semitones; see `ProsodicRange`


class AcousticExtractor(ABC):
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

    def extract(self, wave: Wave) -> FeatureTrack:
        """Extract the features of a sound: values (T, D), frame k centred at k·0.01 s."""
        return self.from_spectrum(self.spectrum_of(wave))

    def spectrum_of(self, wave: Wave) -> ShortTimeSpectrum:
        """Compute the input of `from_spectrum`; extractors with the same `device` can share it."""
        if self.device is None:
            return ShortTimeSpectrum(wave)
        from audio_features.acoustic.torchaudio_backend import TorchaudioSpectrum

        return TorchaudioSpectrum(wave, self.device)

    def from_spectrum(self, spectrum: ShortTimeSpectrum) -> FeatureTrack:
        """Extract the features (T, D) from a spectrum that other extractors may share."""
        return FeatureTrack(self._values(spectrum), spectrum.times, self.spec, self.names)

    @abstractmethod
    def _values(self, spectrum: ShortTimeSpectrum) -> np.ndarray:
        """Compute the values (T, D)."""

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
        self.n_mels = _whole_number("n_mels", n_mels, MAX_MELS)
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
        self.n = _whole_number("n", n, BANDS)
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
        self.seconds = _checked_seconds(seconds, 0.05, 60)
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
    if backend not in BACKENDS:
        raise FeatureError(f"backend={backend!r}: one of {', '.join(BACKENDS)}")
    if backend == "numpy":
        return None
    from audio_features.acoustic.torchaudio_backend import check_device

    check_device(device)
    return device


def _checked_seconds(seconds: float, low: float, high: float) -> float:
    if not isinstance(seconds, (int, float)) or not low <= seconds <= high:
        raise FeatureError(f"seconds={seconds!r}: a number from {low:g} to {high:g}")
    return float(seconds)


def _whole_number(name: str, value: int, highest: int) -> int:
    """Return `value`; raise FeatureError unless it is a whole number from 1 to `highest`."""
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= highest:
        raise FeatureError(f"{name}={value!r}: a whole number from 1 to {highest}")
    return value


_LOW_BAND, _HIGH_BAND = (80.0, 1000.0), (1000.0, 5000.0)
"""Bands of the spectral tilt, Hz: forceful voices have more of the upper one."""
_AUDIBLE_DB = -30.0
"""Frames below this, relative to active speech, have no spectral tilt."""
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
        self.seconds = _checked_seconds(seconds, 0.5, 120)
        self.spec = {"kind": "effort", "seconds": self.seconds}

    def _values(self, spectrum: ShortTimeSpectrum) -> np.ndarray:
        melody = spectrum.melody
        pitch = 12.0 * np.log2(melody.f0 / F0_RANGE[0])
        hertz = np.fft.rfftfreq(N_FFT, 0.5 / 8000.0)
        bands = [(hertz >= low) & (hertz < high) for low, high in (_LOW_BAND, _HIGH_BAND)]
        power = spectrum.power @ np.stack(bands, axis=1).astype(np.float32) + 1e-6
        tilt = 10.0 * np.log10(power[:, 1] / power[:, 0])
        audible = melody.energy >= _AUDIBLE_DB
        columns = [
            self._quantile(pitch, melody.voiced, 0.5, 0.0),
            self._quantile(pitch, melody.voiced, 0.9, 0.0),
            self._quantile(tilt, audible, 0.9, _QUIET_TILT),
        ]
        return np.stack(columns, axis=1)

    def _quantile(
        self, values: np.ndarray, valid: np.ndarray, share: float, empty: float
    ) -> np.ndarray:
        """Return the quantile (T,) of the valid values in the window around each frame."""
        if not valid.any():
            return np.full(len(values), empty)
        own = np.quantile(values[valid], share)
        hop, half = round(_HOP * FRAME_RATE), round(self.seconds * FRAME_RATE / 2)
        centres = np.arange(0, len(values) + hop, hop)
        quantiles = []
        for centre in centres:
            window = slice(max(0, centre - half), centre + half)
            inside = values[window][valid[window]]
            few = _FEW * FRAME_RATE
            found = np.quantile(inside, share) if len(inside) else own
            quantiles.append((len(inside) * found + few * own) / (len(inside) + few))
        return np.interp(np.arange(len(values)), centres, quantiles)


BEATS_PER_MINUTE = (50.0, 200.0)
"""Slowest and fastest tempo that is searched for."""

_CHROMA_WINDOW = 3072  # 192 ms (madmom: 186 ms): long enough for semitones, short enough for chords
_CHROMA_RANGE = 100.0, 5000.0  # Hz, madmom's range for pitch classes
_TEMPO_FRAMES = 6 * FRAME_RATE  # the tempo is estimated in windows of 6 s
_BLOCK_FRAMES = 3000  # 30 s processed at a time, which bounds the memory for long files


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
        self.n_chroma = _whole_number("n_chroma", n_chroma, 36)
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
        for first, frames in centred_frames(
            spectrum.wave.samples, _CHROMA_WINDOW, spectrum.n_frames
        ):
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
    n = len(flux)
    if n < _TEMPO_FRAMES:
        return local_pulse(np.pad(flux, (0, _TEMPO_FRAMES - n)))[:n]
    pulse = np.empty(n)
    context = _TEMPO_FRAMES
    tempo = librosa.fourier_tempo_frequencies(sr=FRAME_RATE, win_length=_TEMPO_FRAMES, hop_length=1)
    wanted = (tempo >= BEATS_PER_MINUTE[0]) & (tempo <= BEATS_PER_MINUTE[1])
    for first in range(0, n, _BLOCK_FRAMES):
        start, stop = max(0, first - context), min(n, first + _BLOCK_FRAMES + context)
        tempogram = librosa.feature.fourier_tempogram(
            onset_envelope=flux[start:stop], sr=FRAME_RATE, hop_length=1, win_length=_TEMPO_FRAMES
        )
        size = np.where(wanted[:, None], np.abs(tempogram), 0.0)
        best, columns = size.argmax(axis=0), np.arange(tempogram.shape[1])
        present = size[best, columns] > 1e-3 * _TEMPO_FRAMES  # a constant flux has no beat
        tempogram[:, :] = np.where(
            (np.arange(len(tempo))[:, None] == best) & present,
            tempogram / np.maximum(np.abs(tempogram), 1e-9),
            0.0,
        )
        sinusoids = librosa.istft(tempogram, hop_length=1, n_fft=_TEMPO_FRAMES, length=stop - start)
        last = min(first + _BLOCK_FRAMES, n)
        pulse[first:last] = sinusoids[first - start : last - start]
    # A bin of magnitude 1 is a sinusoid of amplitude 2/n in each window. The overlapping Hann
    # windows sum to n/2, and istft divides by the sum of their squares, 3n/8.
    return np.clip(pulse * _TEMPO_FRAMES * 3 / 8, 0.0, 1.0)


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
