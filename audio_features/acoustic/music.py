"""Music: harmony, spectral flux and beats, for dance."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from audio_features.acoustic.analysis import (
    FRAME_RATE,
    SAMPLE_RATE,
    ShortTimeSpectrum,
    centred_frames,
)
from audio_features.acoustic.extractors import AcousticExtractor, whole_number
from audio_features.librosa_import import import_librosa

BEATS_PER_MINUTE = (50.0, 200.0)
"""Slowest and fastest tempo that is searched for."""

_WINDOW = 3072  # 192 ms (madmom: 186 ms): long enough for semitones, short enough for chords
_LOWEST, _HIGHEST = 100.0, 5000.0  # Hz, madmom's range for pitch classes
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
        self.n_chroma = whole_number("n_chroma", n_chroma, 36)
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
            return spectrum.melody().energy[:, None]
        from scipy.fft import rfft

        window = np.hanning(_WINDOW + 1)[:-1].astype(np.float32)
        classes = _pitch_classes(self.n_chroma)
        chroma = np.empty((spectrum.n_frames, self.n_chroma), dtype=np.float32)
        for first, frames in centred_frames(spectrum.wave.samples, _WINDOW, spectrum.n_frames):
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
    frequencies = np.fft.rfftfreq(_WINDOW, 1 / SAMPLE_RATE)
    inside = (frequencies >= _LOWEST) & (frequencies <= _HIGHEST)
    place = n * np.log2(np.maximum(frequencies, 1.0) / 440.0)
    nearest = np.mod(np.rint(place).astype(int), n)
    classes = np.zeros((len(frequencies), n), dtype=np.float32)
    classes[np.arange(len(frequencies))[inside], nearest[inside]] = 1.0
    return classes
