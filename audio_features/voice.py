"""Voice activity: the stretches of a sound in which somebody speaks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from audio_features.wave import Wave

_RATE = 8000  # Hz; higher harmonics of a voice are seldom above noise
_FRAME, _HOP = 512, 160  # samples: 64 ms every 20 ms
_FPS = _RATE / _HOP
_F0_RANGE = (65.0, 500.0)  # Hz; from 65 Hz on, so that mains hum of 50 and 60 Hz is below it
_BLOCK, _CONTEXT = 100, 50  # frames: stationary sound is measured over 2 s and 1 s on both sides
_QUANTILE = 0.3  # fraction of frames at or below the level of stationary sound
_LOUD, _RANGE_DB = 0.97, 25.0  # no more than 25 dB below the loudest 3 % of frames is examined
_CHI_DB = 5.57  # dB; standard deviation of a bin of noise (10 log10 of chi-squared, 2 degrees)
_CORNER = 800.0  # Hz; higher harmonics count less: they are weaker, and blurred as pitch moves
_FINER = 4  # quefrencies per sample
_SALIENCE = 2.75  # height of a cepstral peak; of noise, 1 frame in 200 has a higher one
_JUMP = 0.12  # largest change of ln(f0) from frame to frame of one voiced sound
_VOICED = 7  # frames of a voiced sound
_SHORTEST = 1.0  # s; shorter sounds are too short to judge
_GAP = 3.0  # s; longer stretches without a voiced sound are not speech
_MARGIN = 0.5  # s of speech before the first and after the last voiced sound: consonants, breath
_FADE = 0.25  # s at the ends of a stretch: a noise floor that begins abruptly is an onset


def voice_activity(wave: Wave) -> np.ndarray:
    """Find the stretches of a sound in which somebody speaks.

    A voice is periodic, and its pitch and timbre change within seconds. Each frame of 64 ms is
    judged by the peak of its cepstrum between 65 and 500 Hz (Noll 1967), after the spectrum that
    is present most of the time (noise floor, hum) has been subtracted, in dB, in every bin. Voiced
    sounds of at least 0.14 s, at most 3 s from one another, make a stretch of voice; it includes
    the unvoiced sounds and pauses between them, and half a second on both sides. The level of the
    sound has no influence. Whispers have no voice, most music has one, and a sound of less than
    a second counts as voice.

    Returns (K, 2) float64: start and end of each stretch, in seconds.

    Examples:
        A voice of 150 Hz from 5 to 7 s, and the half second on both sides:

        >>> seconds = np.arange(12 * 8000) / 8000
        >>> phase = 2 * np.pi * 150 * seconds
        >>> voice = sum(np.sin(k * phase) for k in range(1, 10)) * ((seconds > 5) & (seconds < 7))
        >>> noise = np.random.default_rng(0).normal(0, 0.01, len(voice))
        >>> af.voice_activity(af.Wave.from_array(0.1 * voice + noise, 8000)).round(1)
        array([[4.5, 7.5]])
    """
    seconds = len(wave.samples) / wave.sample_rate
    if seconds < _SHORTEST:
        return np.array([[0.0, seconds]])
    salience, f0 = _pitch_salience(wave.resample(_RATE).samples)
    stretches: list[list[float]] = []
    for first, last in _voiced_sounds(salience, f0):
        start, stop = first / _FPS - _MARGIN, last / _FPS + _MARGIN
        start = 0.0 if start < _GAP else start
        stop = seconds if stop > seconds - _GAP else stop
        if stretches and start - stretches[-1][1] < _GAP - 2 * _MARGIN:
            stretches[-1][1] = stop
        else:
            stretches.append([start, stop])
    return np.array(stretches, dtype=np.float64).reshape(-1, 2)


def speech_only(wave: Wave) -> Wave:
    """Replace the stretches of a sound without voice (see `voice_activity`) by digital silence.

    The sound fades in and out within a quarter of a second. A sound with voice from end to end is
    returned as it is.

    Examples:
        Noise remains within the voice from 5 to 7 s, and becomes silence where there is none:

        >>> seconds = np.arange(12 * 8000) / 8000
        >>> phase = 2 * np.pi * 150 * seconds
        >>> voice = sum(np.sin(k * phase) for k in range(1, 10)) * ((seconds > 5) & (seconds < 7))
        >>> noise = np.random.default_rng(0).normal(0, 0.01, len(voice))
        >>> wave = af.speech_only(af.Wave.from_array(0.1 * voice + noise, 8000))
        >>> wave.rms([2.0, 6.0]).round(2)
        array([0.  , 0.21])
    """
    n = len(wave.samples)
    stretches = np.rint(voice_activity(wave) * wave.sample_rate).astype(int).tolist()
    if stretches == [[0, n]]:
        return wave
    samples = np.zeros_like(wave.samples)
    rise = np.linspace(0.0, 1.0, round(_FADE * wave.sample_rate)) ** 3
    for start, stop in stretches:
        samples[start:stop] = wave.samples[start:stop]
        if start > 0:
            samples[start : start + len(rise)] *= rise
        if stop < n:
            samples[stop - len(rise) : stop] *= rise[::-1]
    return replace(wave, samples=samples)


def _pitch_salience(samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the salience of the strongest pitch of each frame (T,) and its frequency in Hz (T,).

    The salience is a cepstral coefficient, less that at half the quefrency (which a smooth
    spectrum raises as well), divided by the standard deviation that noise gives to the first.

    Args:
        samples: (N,) float32 at 8 kHz.
    """
    n_frames = len(samples) // _HOP
    # Shorter sounds are judged between silence, or their only word would be the stationary sound.
    window = _BLOCK + 2 * _CONTEXT
    padded = np.pad(samples, (_FRAME // 2, _FRAME // 2 + _HOP * window))
    frames = np.lib.stride_tricks.sliding_window_view(padded, _FRAME)[::_HOP]
    last = max(0, n_frames - window)
    salience, f0 = np.empty(n_frames), np.empty(n_frames)
    for first in range(0, n_frames, _BLOCK):
        start = min(max(0, first - _CONTEXT), last)
        block = slice(first, min(first + _BLOCK, n_frames))
        wanted = slice(block.start - start, block.stop - start)
        salience[block], f0[block] = _cepstral_peaks(frames[start : start + window], wanted)
    return salience, f0


def _cepstral_peaks(frames: np.ndarray, wanted: slice) -> tuple[np.ndarray, np.ndarray]:
    """Return salience and f0 of the wanted of frames (T, 512), less their stationary spectrum."""
    from scipy.fft import irfft, rfft
    from scipy.ndimage import uniform_filter1d

    spectrum = rfft(frames * np.hanning(_FRAME).astype(np.float32))
    power = 10.0 * np.log10(spectrum.real**2 + spectrum.imag**2 + np.float32(1e-20))
    some = power[::2]  # frames overlap by two thirds
    ordered = [round(share * (len(some) - 1)) for share in (_QUANTILE, _LOUD)]
    floor, loud = np.partition(some, ordered, axis=0)[ordered]
    first = max(0, wanted.start - 1)  # neighbours for the mean over three frames
    above = np.maximum(power[first : wanted.stop + 1] - np.maximum(floor, loud - _RANGE_DB), 0.0)
    weights = _weights()
    above = (above - (above @ weights)[:, None] / weights.sum()) * weights
    size = _FINER * _FRAME
    cepstrum = irfft(above, size) * (size / (_CHI_DB * np.linalg.norm(weights)))
    lags = np.arange(*(int(_FINER * _RATE / hertz) for hertz in reversed(_F0_RANGE)))
    cepstrum = uniform_filter1d(cepstrum[:, : lags[-1] + 1], 3, axis=0)
    cepstrum = cepstrum[wanted.start - first :][: wanted.stop - wanted.start]
    peaks = cepstrum[:, lags] - np.maximum(cepstrum[:, lags // 2], 0.0)
    best = peaks.argmax(axis=1)
    return peaks[np.arange(len(peaks)), best], _FINER * _RATE / lags[best]


def _weights() -> np.ndarray:
    """Return the weights (257,) float32 of the bins: from 60 Hz on, falling with frequency."""
    hertz = np.fft.rfftfreq(_FRAME, 1 / _RATE)
    return ((hertz >= 60.0) / (1.0 + np.square(hertz / _CORNER))).astype(np.float32)


def _voiced_sounds(salience: np.ndarray, f0: np.ndarray) -> list[tuple[int, int]]:
    """Return (first, last + 1) of each run of salient frames with continuous pitch, by time."""
    salient = salience > _SALIENCE
    linked = salient[1:] & salient[:-1] & (np.abs(np.diff(np.log(f0))) < _JUMP)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], linked.astype(np.int8), [0]])))
    runs = edges.reshape(-1, 2) + [0, 1]  # links (a, b) join the frames a to b, included
    return [(a, b) for a, b in runs.tolist() if b - a >= _VOICED]
