"""The errors gesturekit raises on purpose.

Every message states what went wrong, where (file and line, or field), the value, and what to do.
The command line prints them on one line, without a traceback.
"""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager

from audio_features.errors import (
    AudioError,
    AudioFeaturesError,
    FeatureError,
    ShortMessage,
    WeightsError,
)

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


class GestureKitError(ShortMessage):
    """Root of every error that gesturekit raises on purpose.

    Errors of sounds, weights and features (`SpeechError`, `SpeechWeightsError`,
    `SpeechFeatureError`) are also subclasses of those of `audio_features` (`AudioError`, ...).

    Examples:
        One `except` catches whatever a user can mend:

        >>> try:
        ...     gk.load("no_such_model")
        ... except gk.GestureKitError as error:
        ...     print(type(error).__name__)
        ModelError
    """


class MotionError(GestureKitError, ValueError):
    """A skeleton or a motion with invalid or inconsistent values."""


class FormatError(GestureKitError, ValueError):
    """A file that cannot be read, or a motion that a format cannot hold."""


class CorpusError(GestureKitError, ValueError):
    """A manifest, or a folder of recordings, that cannot be used."""


class ConfigError(GestureKitError, ValueError):
    """A configuration with an unknown key, a wrong type, or a value out of range."""


class OutputError(GestureKitError, OSError):
    """An output folder that can no longer be written to, such as on a full disk."""


def is_full(error: BaseException | None) -> bool:
    """Return whether an error says that nothing more can be written, such as to a full disk."""
    return isinstance(error, OSError) and error.errno in _FULL


class ModelError(GestureKitError, ValueError):
    """A model folder or WavLM weights that cannot be used, or an argument that a model lacks."""


class EvaluationError(GestureKitError, ValueError):
    """A metric that cannot be computed from its inputs."""


class SpeechError(GestureKitError, AudioError):
    """A sound file, or an array of samples, that cannot be used."""


class SpeechWeightsError(GestureKitError, WeightsError):
    """A folder of WavLM weights that is missing, incomplete, or not the expected one."""


class SpeechFeatureError(GestureKitError, FeatureError):
    """A feature track, a feature file, or an extractor setting that cannot be used."""


_SPEECH_ERRORS = {
    AudioError: SpeechError,
    WeightsError: SpeechWeightsError,
    FeatureError: SpeechFeatureError,
}


@contextmanager
def gesturekit_errors() -> Iterator[None]:
    """Raise errors of `audio_features` as the `GestureKitError` that is also of their class.

    Used as a decorator of public functions, so that `except gesturekit.GestureKitError` catches
    every error that they raise on purpose.
    """
    try:
        yield
    except AudioFeaturesError as error:
        ours = _SPEECH_ERRORS.get(type(error))
        if ours is None:
            raise
        raise ours(*error.args) from error
