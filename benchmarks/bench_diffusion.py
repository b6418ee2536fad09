"""Diffusion sampling of a 10 s clip at the paper's gesture size, on two threads.

"other" is a plain version with the released code's algorithm: in every layer of every step the bias
is a sum of 21 kernels at every pair of frames, attention is full, and convolutions use conv1d. The
released code took 0.65 to 0.72 s per step on 2 quiet cores. Further comparisons: few steps with
many, bfloat16 with single precision, and 100 s with 10 s, each in its own process, whose peak
memory is reported. Weights are random: the cost does not depend on them.
"""

from __future__ import annotations

import copy
import json
import os
import statistics
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import torch
import torch.nn.functional as F
from harness import arguments, compare, report, timed
from torch import Tensor

from gesturekit.diffusion.composition.experts import clip_denoised
from gesturekit.diffusion.config import NetworkConfig, NoiseConfig
from gesturekit.diffusion.network.attention import Attention
from gesturekit.diffusion.network.denoiser import Conformer, Denoiser, DilatedConv
from gesturekit.diffusion.sampling.noise_schedule import NoiseSchedule
from gesturekit.diffusion.sampling.solvers import sample
from gesturekit.training.seeds import rng_for

N_MOTION, N_CONDITION, CLIP = 70, 35, 300
FEW = 12
SCHEDULE = NoiseSchedule.of(NoiseConfig())
CONFIG = NetworkConfig()
ALLOCATOR = {"MALLOC_MMAP_MAX_": "0", "MALLOC_TRIM_THRESHOLD_": str(2**40)}
"""Read by glibc when a process starts: keep the plain version's temporaries of 60 MB for the next
operation. Otherwise each fetches and clears them anew, and a step takes far longer."""
Predict = Callable[[Tensor, int], Tensor]


def network() -> Denoiser:
    """The gesture network with random weights everywhere, also where training starts at zero."""
    torch.manual_seed(0)
    made = Denoiser(N_MOTION, N_CONDITION, CONFIG).eval()
    torch.nn.init.normal_(made.leave.weight, std=CONFIG.channels**-0.5)
    for name, value in made.named_parameters():
        if name.endswith("bias.amplitudes"):
            torch.nn.init.normal_(value)
    return made


def noise_at(k: int, n_frames: int = CLIP) -> Tensor:
    return torch.randn(1, n_frames, N_MOTION, generator=rng_for("bench", k))


def condition(n_frames: int) -> Tensor:
    return torch.randn(1, n_frames, N_CONDITION, generator=rng_for("condition"))


class Plain:
    """The same function in the released code's way, from the same weights."""

    def __init__(self, net: Denoiser, told: Tensor) -> None:
        self.net, self.told = net, told
        self.kernels = {
            layer: kernel(layer) for layer in net.modules() if isinstance(layer, DilatedConv)
        }

    @torch.no_grad()
    def __call__(self, noisy: Tensor, step: int) -> Tensor:
        net = self.net
        x = net.enter(noisy).relu()
        steps = net._steps(torch.tensor([step]))
        told = net.project_condition.weight.chunk(CONFIG.blocks)
        biases = net.project_condition.bias.chunk(CONFIG.blocks)
        total = torch.zeros_like(x)
        for i, (stack, split) in enumerate(zip(net.stacks, net.split, strict=True)):
            y = stack.enter(x + steps[i][:, None] + F.linear(self.told, told[i], biases[i]))
            for layer in stack.layers:
                y = self.conformer(layer, y)
            gate, signal = stack.leave(y).chunk(2, -1)
            kept, skipped = split(gate.sigmoid() * signal.tanh()).chunk(2, -1)
            x = (x + kept) / 2**0.5
            total = total + skipped
        return net.leave(net.gather(total / len(net.stacks) ** 0.5).relu())

    def conformer(self, layer: Conformer, x: Tensor) -> Tensor:
        x = layer.norm_attention(x + self.attention(layer.attention, x))
        if isinstance(layer.widen, DilatedConv):
            d = layer.widen.dilation
            y = F.conv1d(x.mT, self.kernels[layer.widen], padding=d, dilation=d).relu()
            y = F.conv1d(y, self.kernels[layer.narrow], padding=d, dilation=d).mT
        else:
            y = layer.narrow(layer.widen(x).relu())
        return layer.norm(x + y)

    def attention(self, layer: Attention, x: Tensor) -> Tensor:
        n_frames = x.shape[1]
        q, k, v = layer.read(x).unflatten(-1, (3, CONFIG.heads, -1)).permute(2, 0, 3, 1, 4)
        frame = torch.arange(n_frames, dtype=x.dtype)
        distance = frame[:, None] - frame
        bias = layer.bias
        a, o, s = (p.T[..., None, None] for p in (bias.amplitudes, bias.offsets, bias.widths))
        kernels = a.abs() * torch.sigmoid(a.sign() * (distance - o) / s)
        position = torch.log(kernels.sum(0) + bias.floors.abs()[:, None, None] + 1e-8)
        position = position - bias.slopes[:, None, None] * distance.abs()
        weights = (q @ k.mT / q.shape[-1] ** 0.5 + position).softmax(-1)
        return F.glu(layer.write((weights @ v).transpose(1, 2).flatten(2)))


def kernel(layer: DilatedConv) -> Tensor:
    """(n_out, n_in, 3) of a convolution of three frames, as torch's own wants it."""
    weight = layer.weight.detach()
    if layer.gathers:
        return weight.unflatten(1, (3, -1)).permute(0, 2, 1).contiguous()
    return weight.unflatten(0, (3, -1)).permute(1, 2, 0).contiguous()


def peak_mib() -> float:
    # Linux; getrusage would count what the parent had in memory.
    rows = Path("/proc/self/status").read_text().splitlines()
    return int(next(row for row in rows if row.startswith("VmHWM")).split()[1]) / 1024


def clip(n_frames: int, runs: int) -> None:
    """Measure a step in its own process: median seconds and peak MiB, as JSON."""
    predict, noisy = network().for_condition(condition(n_frames), [50]), noise_at(0, n_frames)
    predict(noisy, 50)
    times = timed(lambda: predict(noisy, 50), runs)
    print(json.dumps([statistics.median(times), peak_mib()]))


def measured_clip(n_frames: int, runs: int) -> tuple[float, float]:
    command = [sys.executable, __file__, "--clip", str(n_frames), str(runs)]
    plain = {name: value for name, value in os.environ.items() if name not in ALLOCATOR}
    run = subprocess.run(command, check=True, capture_output=True, text=True, env=plain)
    return tuple(json.loads(run.stdout))


def main() -> None:
    options = arguments(__doc__.splitlines()[0])
    net, told = network(), condition(CLIP)
    ours, plain = net.for_condition(told, range(SCHEDULE.steps)), Plain(net, told)
    short = copy.deepcopy(net).to(torch.bfloat16).for_condition(told, range(SCHEDULE.steps))
    noisy = noise_at(0)
    exact = ours(noisy, 50)
    apart = float((exact - plain(noisy, 50)).abs().max())
    assert apart < 1e-4, f"not the same function: {apart} apart"
    off = float((short(noisy, 50) - exact).norm() / exact.norm())

    def made(predict: Predict, solver: str = "ancestral", steps: int | None = None) -> Tensor:
        return sample(
            clip_denoised(predict, SCHEDULE), noise_at, SCHEDULE, solver=solver, steps=steps
        )

    few, runs = lambda: made(ours, "dpm", FEW), 3 if options.quick else 9
    alike = f"{off:.1e} apart (relative L2)"
    figures = {
        "diffusion_step": compare(
            lambda: ours(noisy, 50),
            lambda: plain(noisy, 50),
            runs,
            f"one step of {CLIP} frames; other: plain version, {apart:.0e} apart",
        ),
        "diffusion_step_bf16": compare(
            lambda: short(noisy, 50),
            lambda: ours(noisy, 50),
            runs,
            f"one step in bfloat16; other: single precision, {alike}",
        ),
    }
    if not options.quick:
        figures["diffusion_clip"] = once(
            lambda: made(ours),
            # As the released code: the network is asked in steps of pure noise too.
            lambda: sample(plain, noise_at, SCHEDULE),
            "10 s in 100 steps; other: plain version",
        )
        figures["diffusion_clip_bf16"] = once(
            lambda: made(short), lambda: made(ours), "the same in bfloat16; other: single precision"
        )
        figures["diffusion_few_steps"] = compare(
            few, lambda: made(ours), 3, f"10 s in {FEW} steps of dpm; other: 100 steps"
        )
        figures["diffusion_few_steps_bf16"] = compare(
            lambda: made(short, "dpm", FEW), few, 3, "the same in bfloat16; other: single precision"
        )
    runs = 1 if options.quick else 5
    (long, long_peak), (brief, brief_peak) = measured_clip(3000, runs), measured_clip(300, runs)
    figures["diffusion_long"] = {
        "ours": long,
        "other": brief,
        "ratio": long / brief,
        "note": f"one step of 3,000 frames, peak of the process {long_peak:.0f} MiB; other: of "
        f"300, {brief_peak:.0f} MiB; here the ratio is ours by other",
    }
    report(figures, options.json)


def once(
    ours: Callable[[], object], other: Callable[[], object], note: str
) -> dict[str, float | str]:
    """As `compare`, for work of a minute that needs no warming up."""
    one, two = (timed(work, 1)[0] for work in (ours, other))
    return {"ours": one, "other": two, "ratio": two / one, "note": note}


if __name__ == "__main__":
    torch.set_num_threads(2)
    if sys.argv[1:2] == ["--clip"]:
        clip(int(sys.argv[2]), int(sys.argv[3]))
    elif os.environ.keys() >= ALLOCATOR.keys():
        main()
    else:
        os.execve(sys.executable, [sys.executable, *sys.argv], {**os.environ, **ALLOCATOR})
