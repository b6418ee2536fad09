"""Fixtures of the viewer's tests."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest


@pytest.fixture(scope="session")
def read_video() -> Callable[[Path], tuple[np.ndarray, float]]:
    """read_video(path): frames (T, H, W, 3) and frames a second."""
    import imageio_ffmpeg

    def read(path: Path) -> tuple[np.ndarray, float]:
        stream = imageio_ffmpeg.read_frames(path)
        facts = next(stream)
        width, height = facts["size"]
        frames = [np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in stream]
        return np.array(frames), facts["fps"]

    return read
