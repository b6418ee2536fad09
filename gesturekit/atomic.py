"""Atomic file writing: a partial file never has its final name."""

from audio_features.atomic import atomic_write, remove_unfinished

__all__ = ["atomic_write", "remove_unfinished"]
