"""Sampling of a pyramid: 24 joints, 7 levels, hidden channels 6, 9, 9 per joint, no condition.

Compared with real time; with the same arithmetic as in GANimator, whose dense kernels are
multiplied by a mask in every call (10 s took 11 to 12 ms on 2 cores); and an hour tiled with an
hour in one piece, each in its own process, whose peak memory above an idle one's is reported.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from harness import arguments, compare, report

import audio_features as af
from gesturekit.formats.smpl import smpl_skeleton
from gesturekit.motion import Motion
from gesturekit.multires.config import NetworkConfig
from gesturekit.multires.motion_vector import MultiresRepresentation
from gesturekit.multires.networks import SLOPE, MultiresGenerator
from gesturekit.multires.pyramid import TILE, sample

FPS, LEVELS = 30, 7
HOUR = 3600 * FPS


def pyramid() -> MultiresGenerator:
    """An untrained pyramid on SMPL's 24 joints: what it costs does not depend on its weights."""
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    still = np.tile([0.0, 0.0, 0.0, 1.0], (4, 24, 1))
    motion = Motion(
        smpl_skeleton(24), still + rng.normal(0, 0.1, still.shape), np.zeros((4, 3)), FPS
    )
    representation = MultiresRepresentation.fit([motion], "all")
    return MultiresGenerator(representation, 0, NetworkConfig(levels=LEVELS)).eval()


def noise(n_frames: int) -> tuple[list[torch.Tensor | None], list[int]]:
    lengths = af.level_lengths(n_frames, LEVELS)
    rng = torch.Generator().manual_seed(0)
    return [torch.randn(1, 1, lengths[0], generator=rng), *[None] * (LEVELS - 1)], lengths


class DenseMasked:
    """The same pyramid as dense kernels and masks."""

    def __init__(self, network: MultiresGenerator) -> None:
        self.levels = []
        for level in network.levels:
            kernels = [layer.dense_weight().detach() for layer in level.layers]
            self.levels.append(
                [
                    (kernel, (kernel != 0).float(), layer.bias.detach(), layer.padding)
                    for kernel, layer in zip(kernels, level.layers, strict=True)
                ]
            )

    @torch.no_grad()
    def __call__(self, noises: list[torch.Tensor | None], lengths: list[int]) -> torch.Tensor:
        up = torch.zeros(1, len(self.levels[0][0][0][0]), lengths[0])
        for layers, shaken, n_frames in zip(self.levels, noises, lengths, strict=True):
            if up.shape[-1] != n_frames:
                up = F.interpolate(up, size=n_frames, mode="linear", align_corners=False)
            x = up if shaken is None else up + shaken
            for i, (kernel, mask, bias, padding) in enumerate(layers):
                x = F.leaky_relu(x, SLOPE) if i else x
                x = F.conv1d(F.pad(x, (padding, padding), mode="reflect"), kernel * mask, bias)
            up = x + up
        return up


def peak_mib() -> float:
    # Linux; getrusage would count what the parent had in memory.
    rows = Path("/proc/self/status").read_text().splitlines()
    return int(next(row for row in rows if row.startswith("VmHWM")).split()[1]) / 1024


def hour(tile: int) -> None:
    """Measure an hour in its own process: seconds and MiB, as JSON."""
    network = pyramid()
    sample(network, *noise(10 * FPS), None)
    idle, start = peak_mib(), time.perf_counter()
    sample(network, *noise(HOUR), None, tile=tile)
    print(json.dumps([time.perf_counter() - start, peak_mib() - idle]))


def measured_hour(tile: int) -> tuple[float, float]:
    command = [sys.executable, __file__, "--hour", str(tile)]
    run = subprocess.run(command, check=True, capture_output=True, text=True)
    return tuple(json.loads(run.stdout))


def main() -> None:
    options = arguments(__doc__.splitlines()[0])
    network = pyramid()
    dense = DenseMasked(network)
    figures = {}
    for seconds, runs in ((10, 20 if options.quick else 200), (60, 8 if options.quick else 60)):
        noises, lengths = noise(seconds * FPS)
        ours = sample(network, noises, lengths, None)
        apart = float((ours - dense(noises, lengths)).abs().max())
        assert apart < 1e-5, f"not the same motion: {apart} apart"
        row = compare(
            lambda n=noises, t=lengths: sample(network, n, t, None),
            lambda n=noises, t=lengths: dense(n, t),
            runs,
            f"{seconds} s of motion; other: dense masked kernels, one piece",
        )
        figures[f"sample_{seconds}s"] = row
        figures[f"sample_{seconds}s_real_time"] = {
            "ours": row["ours"],
            "other": float(seconds),
            "ratio": seconds / row["ours"],
            "note": "the same; other: real time",
        }
    pieces, whole = measured_hour(TILE), measured_hour(HOUR)
    motion = HOUR * network.levels[0].layers[-1].shape[0] * 4 / 2**20
    figures["sample_hour"] = {
        "ours": pieces[0],
        "other": whole[0],
        "ratio": whole[0] / pieces[0],
        "note": f"an hour, peak {pieces[1]:.0f} MiB; other: in one piece, peak {whole[1]:.0f} MiB; "
        f"the motion itself has {motion:.0f}",
    }
    report(figures, options.json)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--hour"]:
        hour(int(sys.argv[2]))
    else:
        main()
