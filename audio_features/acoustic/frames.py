"""Time base of the acoustic features: frames every 10 ms of a 16 kHz sound."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

SAMPLE_RATE = 16_000
"""Sample rate in Hz of every acoustic feature."""
FRAME_RATE = 100
"""Frames per second: frame k is centred at k·10 ms."""
HOP = SAMPLE_RATE // FRAME_RATE
"""Samples between two frames."""

_BLOCK_FRAMES = 3000  # 30 s processed at a time, which bounds the memory for long files


def centred_frames(
    samples: np.ndarray, length: int, n_frames: int
) -> Iterator[tuple[int, np.ndarray]]:
    """Yield (first frame, (m, length) view) blocks of frames centred every 10 ms, zero-padded."""
    for first in range(0, n_frames, _BLOCK_FRAMES):
        count = min(_BLOCK_FRAMES, n_frames - first)
        start = first * HOP - length // 2
        stop = start + (count - 1) * HOP + length
        block = samples[max(start, 0) : max(stop, 0)]
        block = np.pad(block, (max(-start, 0), stop - max(start, 0) - len(block)))
        yield first, np.lib.stride_tricks.sliding_window_view(block, length)[::HOP]
