"""The errors gesturekit raises on purpose.

Every message holds what went wrong, where (file and line, or field), the value met, and
what to do. On the command line they become one line and an exit code, never a traceback.
"""

from __future__ import annotations


class GestureKitError(Exception):
    """Root of every error that gesturekit raises on purpose."""


class MotionError(GestureKitError, ValueError):
    """A skeleton or a motion that cannot be what it claims to be."""


class FormatError(GestureKitError, ValueError):
    """A file that cannot be read, or a motion that a format cannot hold."""


class CorpusError(GestureKitError, ValueError):
    """A manifest, or a folder of recordings, that cannot be used."""


class ConfigError(GestureKitError, ValueError):
    """A configuration with an unknown key, a wrong type, or a value out of range."""


class ModelError(GestureKitError, ValueError):
    """A model folder, or the weights it asks for, that cannot be used."""


class EvaluationError(GestureKitError, ValueError):
    """A metric that cannot be computed from what it was given."""
