"""Motions of any length: windows that overlap, and agree on the noise at every step.

The network's cost and memory grow in proportion to the length, so that minutes are made as a
whole. Hours are predicted window by window. Where two windows overlap, what they predict is
cross-faded before the motion takes its step: both then go on from the same noisy motion, and there
is no seam to be hidden afterwards.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gesturekit.diffusion.composition.experts import Mixture
from gesturekit.diffusion.sampling.solvers import Predict
from gesturekit.errors import ModelError

LONGEST = 9000
"""Frames that are predicted as a whole: five minutes at 30 fps. At gesture size each thousand take
about 35 MB, an hour 4 GB; time a frame is the same for long and short."""
OVERLAP = 150
"""Frames that neighbouring windows share at least, or a quarter of a window if that is less. The
outer thirds of them are too near the border of one window, and the other's alone; over the third
between them one window's prediction becomes the next one's."""


@dataclass(frozen=True, eq=False)
class Window:
    """Frames first (included) to last (not included), with weights (last - first,) float32."""

    first: int
    last: int
    weights: np.ndarray


def windows_of(n_frames: int, size: int) -> list[Window]:
    """Windows of at most `size` frames, evenly over all, whose weights add up to 1 at each frame.

    Raises:
        ModelError: windows of less than four frames.
    """
    if size < 4:
        raise ModelError(f"window: {size} frames; give at least 4")
    if n_frames <= size:
        return [Window(0, n_frames, np.ones(n_frames, np.float32))]
    overlap = min(OVERLAP, size // 4)
    count = -(-(n_frames - overlap) // (size - overlap))
    size = -(-(n_frames + (count - 1) * overlap) // count)
    starts = [round(k * (n_frames - size) / (count - 1)) for k in range(count)]
    rising = [np.ones(size)]
    for before, start in zip(starts, starts[1:], strict=False):
        shared = before + size - start
        third = shared / 3
        rising.append(np.clip((np.arange(size) + 0.5 - third) / third, 0.0, 1.0))
    windows = []
    for k, start in enumerate(starts):
        weights = rising[k].copy()
        if k + 1 < count:
            own = starts[k + 1] - start
            weights[own:] -= rising[k + 1][: size - own]
        windows.append(Window(start, start + size, weights.astype(np.float32)))
    return windows


def windowed(mixture: Mixture, size: int) -> Predict:
    """`mixture.predict`, in windows of `size` frames where the motion is longer.

    In each window only the experts run that have a say there. What is kept between two calls does
    not grow with the length.
    """
    windows = windows_of(mixture.n_frames, size)
    if len(windows) == 1:
        return mixture.predict

    def predict(noisy: Tensor, step: int) -> Tensor:
        total = torch.zeros_like(noisy)
        for window in windows:
            frames = slice(window.first, window.last)
            weights = torch.from_numpy(window.weights).to(noisy.device, noisy.dtype)
            own = mixture.part(window.first, window.last).predict(noisy[:, frames], step)
            total[:, frames] += weights[:, None] * own
        return total

    return predict
