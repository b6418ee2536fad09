"""Atomic file writing: a partial file never has its final name."""

from audio_features.atomic import atomic_write

__all__ = ["atomic_write"]
