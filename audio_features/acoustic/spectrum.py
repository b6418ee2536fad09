"""ShortTimeSpectrum: the short-time Fourier transform that all acoustic features share."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from audio_features.acoustic.frames import FRAME_RATE, SAMPLE_RATE, centred_frames
from audio_features.acoustic.pitch import track_pitch
from audio_features.errors import FeatureError
from audio_features.wave import SPEECH_LEVEL_DBFS, Wave

FLOOR_DB = -60.0
"""Added to every power before the logarithm, relative to the active speech level."""
MAX_MELS = 80
"""Largest number of mel bands; more would be narrower than the 31 Hz between two FFT bins."""

BANDS = 40
"""Mel bands from which MFCC and onset strength are computed."""

WINDOW = 400  # 25 ms
N_FFT = 512
_VOICED = 0.6  # periodicity from which a frame counts as voiced
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
        self._melodies: dict[str, Melody] = {}

    def melody(self, tracker: str = "yin") -> Melody:
        """Return pitch, voicing and energy, computed once for each tracker."""
        if tracker not in self._melodies:
            self._melodies[tracker] = self._track(tracker)
        return self._melodies[tracker]

    def _track(self, tracker: str) -> Melody:
        rms = self.wave.rms(self.times, window=0.05)
        energy = to_db(np.square(rms) / 10.0 ** (SPEECH_LEVEL_DBFS / 10.0))
        f0, voicing = track_pitch(self.wave.samples, self.n_frames, tracker)
        voicing[energy < _AUDIBLE_DB] = 0.0
        voiced = voicing >= _VOICED
        semitones = np.zeros_like(f0)
        if voiced.any():
            semitones[voiced] = 12.0 * np.log2(f0[voiced] / np.median(f0[voiced]))
        return Melody(semitones, voicing, energy, voiced, f0)

    @cached_property
    def power(self) -> np.ndarray:
        """Power (T, 257) float32; a frame's sum is its mean square relative to active speech."""
        from scipy.fft import rfft

        window = hann_window()
        power = np.empty((self.n_frames, N_FFT // 2 + 1), dtype=np.float32)
        for first, frames in centred_frames(self.wave.samples, WINDOW, self.n_frames):
            spectrum = rfft(frames * window, N_FFT, axis=1, overwrite_x=True)
            power[first : first + len(frames)] = spectrum.real**2 + spectrum.imag**2
        return power

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


def hann_window() -> np.ndarray:
    """Return the Hann window (WINDOW,) float32, scaled so that active speech has power 1."""
    window = np.hanning(WINDOW + 1)[:-1]
    active = 10.0 ** (SPEECH_LEVEL_DBFS / 10.0)
    return (window * np.sqrt(2.0 / (np.sum(window**2) * N_FFT * active))).astype(np.float32)


@lru_cache
def mel_filters(n_mels: int) -> np.ndarray:
    """Return (n_mels, 257) float32 triangles of height 1 on Slaney's scale, 50 Hz to 8 kHz."""
    if not 1 <= n_mels <= MAX_MELS:
        raise FeatureError(f"n_mels={n_mels}: from 1 to {MAX_MELS}")
    # Bit-identical to librosa.filters.mel(norm=None). Importing librosa takes 20 seconds of
    # compilation when numba's cache is empty.
    lowest, highest = 50.0 / _MEL_HZ, 15.0 + np.log(SAMPLE_RATE / 2 / 1000.0) / _MEL_LOG_STEP
    mels = np.linspace(lowest, highest, n_mels + 2)
    edges = np.where(mels < 15.0, _MEL_HZ * mels, 1000.0 * np.exp(_MEL_LOG_STEP * (mels - 15.0)))
    ramps = np.subtract.outer(edges, np.fft.rfftfreq(N_FFT, 1.0 / SAMPLE_RATE))
    widths = np.diff(edges)[:, None]
    rising, falling = -ramps[:-2] / widths[:-1], ramps[2:] / widths[1:]
    return np.maximum(0.0, np.minimum(rising, falling)).astype(np.float32)
