"""Acoustic features of a minute of speech, and the feature cache compared with extraction.

"other" computes each feature by a separate call of librosa; ours share one spectrum. The speech is
the bundled recording, repeated with varying loudness.
"""

from __future__ import annotations

import tempfile
import time

import librosa
import numpy as np
from harness import arguments, compare, report

import audio_features as af
from gesturekit.systems import bundled_speech

SECONDS = 60.0


def main() -> None:
    options = arguments(__doc__.splitlines()[0])
    runs = 3 if options.quick else 10
    wave = minute()
    extractors = {
        "logmel_mfcc_onset": af.Stack([af.LogMel(24), af.MFCC(20), af.Onset()]),
        "everything_light": af.Stack([af.LogMel(24), af.MFCC(20), af.Prosody()]),
    }
    figures = {
        name: compare(
            lambda stack=stack: stack.extract(wave),
            lambda pitch=name == "everything_light": by_librosa(wave, pitch),
            runs,
            f"60 s, {stack.dim} columns; other: one librosa call a feature; "
            f"ours is {SECONDS / seconds(lambda stack=stack: stack.extract(wave)):.0f}x real time",
        )
        for name, stack in extractors.items()
    }
    figures["music"] = compare(
        lambda: af.Music().extract(wave),
        lambda: music_by_librosa(wave),
        runs,
        "60 s; other: librosa's chroma_stft, onset_strength and plp at the same 100 frames/s",
    )
    with tempfile.TemporaryDirectory() as folder:
        cache = af.FeatureCache(folder)
        # Why light features are not kept: what a cache could save at best.
        kept = Kept(af.Stack([af.LogMel(24), af.Prosody()]))
        figures["cache_light_if_it_were_kept"] = compare(
            lambda: cache.extract(kept, fresh(wave)),
            lambda: kept.extract(wave),
            runs,
            "60 s of log-mel and prosody; the cache leaves these out",
        )
    report(figures, options.json)


class Kept:
    """An extractor that the cache does not know to be light."""

    def __init__(self, inner: af.Stack) -> None:
        self.spec, self.names, self.extract = inner.spec, inner.names, inner.extract


def minute() -> af.Wave:
    spoken = af.Wave.load(bundled_speech()).resample(16_000)
    n = round(SECONDS * 16_000)
    loudness = 0.7 + 0.3 * np.sin(np.arange(n) / 16_000)
    return af.Wave((np.resize(spoken.samples, n) * loudness).astype(np.float32), 16_000)


def fresh(wave: af.Wave) -> af.Wave:
    """The same sound without what a Wave remembers."""
    return af.Wave(wave.samples, wave.sample_rate)


def seconds(work) -> float:
    work()
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def by_librosa(wave: af.Wave, pitch: bool) -> None:
    y, frames = wave.samples, {"n_fft": 512, "hop_length": 160}
    librosa.power_to_db(librosa.feature.melspectrogram(y=y, sr=16_000, n_mels=24, **frames))
    librosa.feature.mfcc(y=y, sr=16_000, n_mfcc=20, n_mels=40, **frames)
    librosa.onset.onset_strength(y=y, sr=16_000, n_mels=40, **frames)
    if pitch:
        librosa.feature.rms(y=y, frame_length=800, hop_length=160)
        librosa.yin(y, fmin=60, fmax=500, sr=16_000, frame_length=1024, hop_length=160)


def music_by_librosa(wave: af.Wave) -> None:
    y = wave.samples
    librosa.feature.chroma_stft(y=y, sr=16_000, n_fft=3072, hop_length=160, tuning=0.0)
    flux = librosa.onset.onset_strength(y=y, sr=16_000, n_mels=40, n_fft=512, hop_length=160)
    librosa.beat.plp(
        onset_envelope=flux, sr=100, hop_length=1, win_length=600, tempo_min=50, tempo_max=200
    )


if __name__ == "__main__":
    main()
