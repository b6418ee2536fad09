"""Skeleton-aware convolution: compiled sparse kernels against gathering.

Forward and backward pass of one hidden layer of the light recipe: 29 blocks of 6 channels, kernel
5. The other way gathers each block's neighbours and runs torch's grouped convolution.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from harness import arguments, compare, report

from gesturekit.multires.backend import choose_backend
from gesturekit.multires.networks import SkeletonConv1d
from gesturekit.multires.resampling import reflect

BLOCKS, WIDTH, KERNEL, MEAN_NEIGHBOURS = 29, 6, 5, 6


def main() -> None:
    options = arguments(__doc__.splitlines()[0])
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    near = np.eye(BLOCKS, dtype=bool) | (rng.random((BLOCKS, BLOCKS)) < MEAN_NEIGHBOURS / BLOCKS)
    sizes = (WIDTH,) * BLOCKS
    conv = SkeletonConv1d(near, sizes, sizes, KERNEL)
    backend = choose_backend("numba", conv)
    # Every group has as many inputs as the best-connected block needs; the rest are unused.
    most = int(near.sum(axis=1).max())
    index = np.zeros((BLOCKS, most, WIDTH), dtype=np.int64)
    for block in range(BLOCKS):
        seen = np.flatnonzero(near[block])
        index[block, : len(seen)] = seen[:, None] * WIDTH + np.arange(WIDTH)
    gather = torch.from_numpy(index.reshape(-1))
    weight = torch.randn(BLOCKS * WIDTH, most * WIDTH, KERNEL, requires_grad=True)
    figures = {}
    for n_frames in (19, 106, 250):
        x = torch.randn(2, BLOCKS * WIDTH, n_frames, requires_grad=True)

        def ours(x: torch.Tensor = x) -> None:
            backend.convolve([conv], x, 1.0, 1.0).square().mean().backward()

        def other(x: torch.Tensor = x) -> None:
            gathered = reflect(x, KERNEL // 2).index_select(1, gather)
            F.conv1d(gathered, weight, groups=BLOCKS).square().mean().backward()

        runs = 30 if options.quick else 200
        note = f"2 windows of {n_frames} frames; other: gathered, grouped convolution"
        figures[f"skeleton_conv_{n_frames}"] = compare(ours, other, runs, note)
    report(figures, options.json)


if __name__ == "__main__":
    main()
