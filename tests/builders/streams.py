"""Streams of sound in blocks."""

import itertools
from collections.abc import Iterable

import numpy as np

import gesturekit as gk
from gesturekit.motion.concatenation import stacked


def streamed(stream, samples: np.ndarray, sizes: Iterable[int] | None = None) -> gk.Motion:
    """Return the motion of samples in blocks of these sizes, to the end of the stream."""
    made, first = [], 0
    for size in sizes or itertools.repeat(640):
        made.append(stream.step(samples[first : first + size]))
        first += size
        if first >= len(samples):
            break
    return stacked([part for part in [*made, stream.finish()] if part is not None])
