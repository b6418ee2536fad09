"""Sound in, feature tracks out.

>>> import numpy as np
>>> import audio_features as af
>>> wave = af.Wave(np.zeros(160_000), 16_000)  # ten seconds of silence; or af.Wave.load("a.wav")
>>> track = af.Stack([af.LogMel(), af.Prosody()]).extract(wave)
>>> track.to_rate(25.0, n_frames=wave.n_frames(25.0)).values.shape
(250, 28)
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

from audio_features.kinds import KINDS

# Public name -> module. Imported on first use, so that `import audio_features` is fast.
_EXPORTS = {entry.name: entry.module for entry in KINDS.values()} | {
    "AudioError": "errors",
    "AudioFeaturesError": "errors",
    "Extractor": "extractor",
    "FeatureCache": "cache",
    "FeatureError": "errors",
    "FeatureTrack": "track",
    "Stack": "extractor",
    "Wave": "wave",
    "Word": "words",
    "WordEmbeddings": "huggingface.word_embeddings",
    "WeightsError": "errors",
    "cache_from_environment": "cache",
    "exact_rate": "wave",
    "extractor_from_spec": "extractor",
    "from_residual_pyramid": "pyramid",
    "interpolation_weights": "pyramid",
    "level_lengths": "pyramid",
    "load_words": "words",
    "resample_frames": "pyramid",
    "residual_level": "pyramid",
    "residual_pyramid": "pyramid",
    "speech_only": "voice",
    "voice_activity": "voice",
}
__all__ = sorted(_EXPORTS)


def __getattr__(name: str) -> Any:
    if name not in _EXPORTS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_EXPORTS[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
