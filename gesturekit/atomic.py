"""Writing a file so that nothing partial ever has a final name."""

from audio_features.atomic import atomic_write

__all__ = ["atomic_write"]
