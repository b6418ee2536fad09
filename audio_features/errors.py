"""Errors that audio_features raises on purpose.

Every message states the problem, the place (path or field), the value, and the remedy.
"""

from __future__ import annotations

_BEGINNING, _END = 1000, 300


class ShortMessage(Exception):
    """An exception whose message is short, whatever values of a file it quotes."""

    def __str__(self) -> str:
        text = super().__str__()
        if len(text) <= _BEGINNING + _END:
            return text
        return f"{text[:_BEGINNING]} [...] {text[-_END:]}"


class AudioFeaturesError(ShortMessage):
    """Root of every error that audio_features raises on purpose."""


class AudioError(AudioFeaturesError, ValueError):
    """A sound file, or an array of samples, that cannot be used."""


class WeightsError(AudioFeaturesError, ValueError):
    """A folder of network weights that is missing, incomplete, or not the requested one."""


class FeatureError(AudioFeaturesError, ValueError):
    """A feature track, a feature file, or an extractor setting that cannot be used."""
