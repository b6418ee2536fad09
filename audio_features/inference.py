"""Steps that all speech encoders share: normalisation, chunks of long sounds, devices."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from audio_features.errors import FeatureError


def normalized(samples: np.ndarray, eps: float | None) -> np.ndarray:
    """Scale a waveform (N,) float32 to mean 0 and variance 1, with `eps` added to the variance.

    Returns the waveform itself if `eps` is None.
    """
    if eps is None:
        return samples
    # In float32, as in the networks' own code: Large normalises frames one by one, which would
    # amplify the rounding difference of another precision in near silence.
    return (samples - samples.mean()) / np.sqrt(samples.var() + np.float32(eps))


def chunk_slices(n_frames: int, longest: int, context: int) -> Iterator[tuple[slice, slice]]:
    """Yield (input frames, output frames) of as few chunks as possible, all of one length.

    The output frames are contiguous and leave out a chunk's context, except at the start and the
    end of the sound.
    """
    count = max(1, -(-(n_frames - 2 * context) // (longest - 2 * context)))
    length = min(n_frames, -(-(n_frames + (count - 1) * 2 * context) // count))
    done = 0
    while done < n_frames:
        start = min(max(0, done - context), n_frames - length)
        stop = start + length
        keep = slice(done, n_frames if stop == n_frames else stop - context)
        yield slice(start, stop), keep
        done = keep.stop


def checked_device(name: str) -> Any:
    """Return the torch device of that name; raises FeatureError if it cannot be used."""
    import torch

    try:
        device = torch.device(name)
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError, TypeError) as error:
        reason = str(error).splitlines()[0]
        raise FeatureError(f"device={name!r} cannot be used: {reason}: give 'cpu'") from error
    return device
