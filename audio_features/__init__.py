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
from typing import TYPE_CHECKING, Any

from audio_features.kinds import KINDS

if TYPE_CHECKING:
    from audio_features.acoustic import MFCC as MFCC
    from audio_features.acoustic import Effort as Effort
    from audio_features.acoustic import LogMel as LogMel
    from audio_features.acoustic import Music as Music
    from audio_features.acoustic import Onset as Onset
    from audio_features.acoustic import ProsodicRange as ProsodicRange
    from audio_features.acoustic import Prosody as Prosody
    from audio_features.cache import FeatureCache as FeatureCache
    from audio_features.cache import cache_from_environment as cache_from_environment
    from audio_features.errors import AudioError as AudioError
    from audio_features.errors import AudioFeaturesError as AudioFeaturesError
    from audio_features.errors import FeatureError as FeatureError
    from audio_features.errors import WeightsError as WeightsError
    from audio_features.extractor import Extractor as Extractor
    from audio_features.extractor import Stack as Stack
    from audio_features.extractor import extractor_from_spec as extractor_from_spec
    from audio_features.files import Files as Files
    from audio_features.huggingface import HuggingFace as HuggingFace
    from audio_features.huggingface.word_embeddings import WordEmbeddings as WordEmbeddings
    from audio_features.pyramid import from_residual_pyramid as from_residual_pyramid
    from audio_features.pyramid import interpolation_weights as interpolation_weights
    from audio_features.pyramid import level_lengths as level_lengths
    from audio_features.pyramid import resample_frames as resample_frames
    from audio_features.pyramid import residual_level as residual_level
    from audio_features.pyramid import residual_pyramid as residual_pyramid
    from audio_features.track import FeatureTrack as FeatureTrack
    from audio_features.voice import speech_only as speech_only
    from audio_features.voice import voice_activity as voice_activity
    from audio_features.wave import Wave as Wave
    from audio_features.wave import exact_rate as exact_rate
    from audio_features.wavlm import WavLM as WavLM
    from audio_features.words import Word as Word
    from audio_features.words import Words as Words
    from audio_features.words import load_words as load_words

# Modules of the public names, imported on first use, so that `import audio_features` is fast.
_HOMES = {
    "cache": ("FeatureCache", "cache_from_environment"),
    "errors": ("AudioError", "AudioFeaturesError", "FeatureError", "WeightsError"),
    "extractor": ("Extractor", "Stack", "extractor_from_spec"),
    "huggingface.word_embeddings": ("WordEmbeddings",),
    "pyramid": (
        *("from_residual_pyramid", "interpolation_weights", "level_lengths"),
        *("resample_frames", "residual_level", "residual_pyramid"),
    ),
    "track": ("FeatureTrack",),
    "voice": ("speech_only", "voice_activity"),
    "wave": ("Wave", "exact_rate"),
    "words": ("Word", "load_words"),
}
_EXPORTS = {entry.name: entry.module for entry in KINDS.values()}
_EXPORTS |= {name: module for module, names in _HOMES.items() for name in names}
__all__ = sorted(_EXPORTS)


def __getattr__(name: str) -> Any:
    if name not in _EXPORTS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_EXPORTS[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
