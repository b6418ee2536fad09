"""Errors that audio_features raises on purpose.

Every message states the problem, the place (path or field), the value, and the remedy.
"""

from __future__ import annotations

from collections.abc import Iterable

_BEGINNING, _END = 1000, 300


class ShortMessage(Exception):
    """An exception whose message is short, whatever values of a file it quotes."""

    def __str__(self) -> str:
        text = super().__str__()
        if len(text) <= _BEGINNING + _END:
            return text
        return f"{text[:_BEGINNING]} [...] {text[-_END:]}"


def check_values(
    error: type[Exception], where: str, values: Iterable[tuple[str, object, bool, str]]
) -> None:
    """Raise an error that names the first value that does not fit.

    Args:
        error: class of the error.
        where: beginning of its message.
        values: (name, value, whether it fits, what is expected) of each.
    """
    for name, value, fits, expected in values:
        if not fits:
            raise error(f"{where}{name} is {value!r:.80}; expected {expected}")


class AudioFeaturesError(ShortMessage):
    """Root of every error that audio_features raises on purpose.

    Examples:
        >>> try:
        ...     af.Wave.load("missing.wav")
        ... except af.AudioFeaturesError as error:
        ...     print(error)
        missing.wav: no such file: give the path of a sound file
    """


class AudioError(AudioFeaturesError, ValueError):
    """A sound file, or an array of samples, that cannot be used.

    Examples:
        >>> af.Wave(np.zeros(16), 16000)
        Traceback (most recent call last):
        audio_features.errors.AudioError: samples: 16 samples at 16000 Hz are 1.0 ms:
        give at least 25 ms
    """


class WeightsError(AudioFeaturesError, ValueError):
    """A folder of network weights or of own features that is missing, incomplete or another one.

    Examples:
        >>> af.extractor_from_spec({"kind": "hf", "model": "hubert"})
        Traceback (most recent call last):
        audio_features.errors.WeightsError: weights of hubert are needed: name their place
        (path: FOLDER in the config to train, else --weights hf=PATH)
    """


class FeatureError(AudioFeaturesError, ValueError):
    """A feature track, a feature file, or an extractor setting that cannot be used.

    Examples:
        >>> af.LogMel(n_mels=0)
        Traceback (most recent call last):
        audio_features.errors.FeatureError: n_mels=0: a whole number from 1 to 80
    """
