"""Light features: log-mel bands, MFCC and prosody, each an extractor."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np

from audio_features.errors import FeatureError
from audio_features.pitch import track_pitch
from audio_features.spectrum import MAX_MELS, ShortTimeSpectrum, to_db
from audio_features.track import FeatureTrack
from audio_features.wave import SPEECH_LEVEL_DBFS, Wave

_BANDS = 40  # mel bands behind MFCC and onset strength
_ONSET_LAG = 2  # frames: windows 20 ms apart hardly overlap, so a rise shows in full
_VOICED = 0.6  # periodicity from which a frame counts as voiced
_AUDIBLE_DB = -30.0  # quieter frames than this, relative to active speech, are unvoiced


class AcousticExtractor(ABC):
    """Features computed from a `ShortTimeSpectrum`, 100 frames per second.

    Level is normalised on active speech, and the floor of every logarithm is relative to it:
    the same words 20 dB quieter give the same values. Silence gives the floor.

    Attributes:
        spec: what `extractor_from_spec` needs to make this extractor again, JSON-able.
        names: names of the columns.
    """

    spec: dict[str, Any]
    names: tuple[str, ...]

    @property
    def dim(self) -> int:
        """Number of columns D."""
        return len(self.names)

    def extract(self, wave: Wave) -> FeatureTrack:
        """The features of a sound: values (T, D), frame k centred at k·0.01 s."""
        return self.from_spectrum(ShortTimeSpectrum(wave))

    def from_spectrum(self, spectrum: ShortTimeSpectrum) -> FeatureTrack:
        """The same from a spectrum that other extractors share."""
        return FeatureTrack(self._values(spectrum), spectrum.times, self.spec, self.names)

    @abstractmethod
    def _values(self, spectrum: ShortTimeSpectrum) -> np.ndarray:
        """(T, D) values."""

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.spec})"


class LogMel(AcousticExtractor):
    """Powers of `n_mels` (1 to 80) mel bands in dB relative to active speech, at least -60."""

    def __init__(self, n_mels: int = 24) -> None:
        self.n_mels = _whole("n_mels", n_mels, MAX_MELS)
        self.spec = {"kind": "logmel", "n_mels": self.n_mels}
        self.names = tuple(f"mel_{i}" for i in range(self.n_mels))

    def _values(self, spectrum: ShortTimeSpectrum) -> np.ndarray:
        return spectrum.log_mel(self.n_mels)


class MFCC(AcousticExtractor):
    """The first `n` (1 to 40) mel-frequency cepstral coefficients, the 0th included.

    Orthonormal DCT-II of 40 log-mel bands in dB, no liftering (librosa's convention).
    """

    def __init__(self, n: int = 20) -> None:
        self.n = _whole("n", n, _BANDS)
        self.spec = {"kind": "mfcc", "n": self.n}
        self.names = tuple(f"mfcc_{i}" for i in range(self.n))

    def _values(self, spectrum: ShortTimeSpectrum) -> np.ndarray:
        from scipy.fft import dct

        return dct(spectrum.log_mel(_BANDS), norm="ortho", axis=1)[:, : self.n]


class Prosody(AcousticExtractor):
    """How something is said: four columns.

    - `f0`: semitones relative to the clip's median over voiced frames; 0 where unvoiced.
    - `voicing`: 0 to 1, periodicity at the fundamental; 0 in frames too quiet to be voiced.
    - `energy`: dB of the RMS over 50 ms, relative to active speech, at least -60.
    - `onset`: spectral flux, the mean rise of 40 log-mel bands over 20 ms in dB.
    """

    names = ("f0", "voicing", "energy", "onset")

    def __init__(self) -> None:
        self.spec = {"kind": "prosody"}

    def _values(self, spectrum: ShortTimeSpectrum) -> np.ndarray:
        rms = spectrum.wave.rms(spectrum.times, window=0.05)
        energy = to_db(np.square(rms) / 10.0 ** (SPEECH_LEVEL_DBFS / 10.0))

        f0, voicing = track_pitch(spectrum.wave.samples, spectrum.n_frames)
        voicing[energy < _AUDIBLE_DB] = 0.0
        voiced = voicing >= _VOICED
        semitones = np.zeros_like(f0)
        if voiced.any():
            semitones[voiced] = 12.0 * np.log2(f0[voiced] / np.median(f0[voiced]))

        bands = spectrum.log_mel(_BANDS)
        onset = np.zeros_like(f0)
        onset[_ONSET_LAG:] = np.maximum(bands[_ONSET_LAG:] - bands[:-_ONSET_LAG], 0.0).mean(axis=1)
        return np.stack([semitones, voicing, energy, onset], axis=1)


def _whole(name: str, value: int, highest: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= highest:
        raise FeatureError(f"{name}={value!r}: a whole number from 1 to {highest}")
    return value
