"""Diffusion sampling of a 10 s clip at the paper's gesture size, on two threads.

"other" is a plain version with the released code's algorithm: in every layer of every step the bias
is a sum of 21 kernels at every pair of frames, attention is full, and convolutions use conv1d. The
released code took 0.65 to 0.72 s per step on 2 quiet cores. Further comparisons: few steps with
many, bfloat16 with single precision, and 100 s with 10 s, each in its own process, whose peak
memory is reported. Weights are random: the cost does not depend on them.

`--device cuda` measures the same steps and clips on a GPU, clips of 60 s, updates of a training on
batches of 80 windows of 5 s, and our attention beside compiled FlexAttention with the same bias.
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
from harness import arguments, compare, gpu_peak, report, timed
from torch import Tensor, nn
from torch.nn.attention.flex_attention import create_block_mask, flex_attention

from gesturekit.diffusion.config import NetworkConfig, NoiseConfig
from gesturekit.diffusion.network import (
    Attention,
    Conformer,
    Denoiser,
    DilatedConv,
    PositionBias,
    attend,
    bands,
)
from gesturekit.diffusion.noise_schedule import NoiseSchedule, clip_denoised, sample
from gesturekit.training.seeds import rng_for
from gesturekit.training.session import prepare_device

N_MOTION, N_CONDITION, CLIP = 70, 35, 300
FEW = 12
BATCH, WINDOW = 80, 150
"""Windows and frames of the published training."""
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


def noise_on(device: torch.device | str = "cpu", n_frames: int = CLIP) -> Callable[[int], Tensor]:
    """The noise of each step: drawn on the CPU, as in the product."""
    shape = 1, n_frames, N_MOTION
    return lambda k: torch.randn(shape, generator=rng_for("bench", k)).to(device)


def random_condition(n_frames: int) -> Tensor:
    return torch.randn(1, n_frames, N_CONDITION, generator=rng_for("condition"))


class Plain:
    """The same function in the released code's way, from the same weights."""

    def __init__(self, net: Denoiser, condition: Tensor) -> None:
        self.net, self.condition = net, condition
        convs = [layer for layer in net.modules() if isinstance(layer, DilatedConv)]
        with torch.no_grad():
            self.kernels = {layer: kernel(layer) for layer in convs}

    @torch.no_grad()
    def __call__(self, noisy: Tensor, step: int) -> Tensor:
        return self.forward(noisy, self.condition, torch.tensor([step], device=noisy.device))

    def train(self, noisy: Tensor, condition: Tensor, steps: Tensor) -> Tensor:
        """Predict with gradients, and with weights that differ from call to call."""
        self.kernels = {layer: kernel(layer) for layer in self.kernels}
        return self.forward(noisy, condition, steps)

    def forward(self, noisy: Tensor, given: Tensor, step: Tensor) -> Tensor:
        net = self.net
        x = net.enter(noisy).relu()
        steps = net._steps(step)
        projections = net.project_condition.weight.chunk(CONFIG.blocks)
        biases = net.project_condition.bias.chunk(CONFIG.blocks)
        total = torch.zeros_like(x)
        for i, (stack, split) in enumerate(zip(net.stacks, net.split, strict=True)):
            y = stack.enter(x + steps[i][:, None] + F.linear(given, projections[i], biases[i]))
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
        frame = torch.arange(n_frames, dtype=x.dtype, device=x.device)
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
    weight = layer.weight
    if layer.gathers:
        return weight.unflatten(1, (3, -1)).permute(0, 2, 1).contiguous()
    return weight.unflatten(0, (3, -1)).permute(1, 2, 0).contiguous()


def peak_mib() -> float:
    # Linux; getrusage would count what the parent had in memory.
    rows = Path("/proc/self/status").read_text().splitlines()
    return int(next(row for row in rows if row.startswith("VmHWM")).split()[1]) / 1024


def clip(n_frames: int, runs: int) -> None:
    """Measure a step in its own process: median seconds and peak MiB, as JSON."""
    predict, noisy = (
        network().for_condition(random_condition(n_frames), [50]),
        noise_on("cpu", n_frames)(0),
    )
    predict(noisy, 50)
    times = timed(lambda: predict(noisy, 50), runs)
    print(json.dumps([statistics.median(times), peak_mib()]))


def measured_clip(n_frames: int, runs: int) -> tuple[float, float]:
    command = [sys.executable, __file__, "--clip", str(n_frames), str(runs)]
    plain = {name: value for name, value in os.environ.items() if name not in ALLOCATOR}
    run = subprocess.run(command, check=True, capture_output=True, text=True, env=plain)
    return tuple(json.loads(run.stdout))


def main() -> None:
    options = arguments(__doc__.splitlines()[0], takes_device=True)
    device = prepare_device(options.device)
    net, condition = network().to(device), random_condition(CLIP).to(device)
    ours, plain = net.for_condition(condition, range(SCHEDULE.steps)), Plain(net, condition)
    short = copy.deepcopy(net).to(torch.bfloat16).for_condition(condition, range(SCHEDULE.steps))
    noise_at = noise_on(device)
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
    if device.type == "cpu":
        figures["diffusion_long"] = long_clip(1 if options.quick else 5)
    else:
        figures |= clips(net, device, runs) | training(net, device, runs)
        try:
            figures |= attention(net, device, runs)
        except RuntimeError as error:  # such as no C compiler, which is no reason to lose the rest
            print(f"FlexAttention: not measured: {error}")
    report(figures, options.json)


def long_clip(runs: int) -> dict[str, float | str]:
    """A step of 100 s beside one of 10 s."""
    (long, long_peak), (brief, brief_peak) = measured_clip(3000, runs), measured_clip(300, runs)
    return {
        "ours": long,
        "other": brief,
        "ratio": long / brief,
        "note": f"one step of 3,000 frames, peak of the process {long_peak:.0f} MiB; other: of "
        f"300, {brief_peak:.0f} MiB; here the ratio is ours by other",
    }


def clips(net: Denoiser, device: torch.device, runs: int) -> dict[str, dict[str, float | str]]:
    """Clips of 10 and 60 s in many and few steps beside real time, noise from the CPU included."""
    figures = {}
    for dtype in (torch.float32, torch.bfloat16):
        own = copy.deepcopy(net).to(dtype)
        for seconds, steps in ((10, None), (10, FEW), (60, None), (60, FEW)):
            n_frames = 30 * seconds
            condition, noise_at = random_condition(n_frames).to(device), noise_on(device, n_frames)

            def made(condition=condition, noise_at=noise_at, steps=steps, own=own) -> Tensor:
                predict = clip_denoised(
                    own.for_condition(condition, range(SCHEDULE.steps)), SCHEDULE
                )
                solver = "dpm" if steps else "ancestral"
                return sample(predict, noise_at, SCHEDULE, solver=solver, steps=steps)

            made()
            spent = statistics.median(timed(made, runs))
            kind = "bfloat16" if dtype == torch.bfloat16 else "single precision"
            figures[f"diffusion_{seconds}s_{steps or SCHEDULE.steps}_{kind.split()[0]}"] = {
                "ours": spent,
                "other": seconds,
                "ratio": seconds / spent,
                "note": f"{seconds} s in {steps or SCHEDULE.steps} steps, {kind}{gpu_peak(made)}; "
                "other: real time",
            }
    return figures


class Training:
    """Updates of the published training on one random batch."""

    def __init__(self, net: Denoiser, device: torch.device, *, half: bool, plain: bool) -> None:
        self.net, self.half, self.device = copy.deepcopy(net).train(), half, device
        self.predict = self.net
        torch.manual_seed(0)
        self.noisy, self.target = torch.randn(2, BATCH, WINDOW, N_MOTION, device=device)
        self.condition = torch.randn(BATCH, WINDOW, N_CONDITION, device=device)
        self.steps = torch.randint(SCHEDULE.steps, (BATCH,), device=device)
        self.optimiser = torch.optim.Adam(self.net.parameters())
        if plain:
            self.predict = Plain(self.net, self.condition).train

    def update(self) -> None:
        self.optimiser.zero_grad(set_to_none=True)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.half):
            predicted = self.predict(self.noisy, self.condition, self.steps)
        (predicted.float() - self.target).square().mean().backward()
        nn.utils.clip_grad_norm_(self.net.parameters(), 25.0)
        self.optimiser.step()


def training(net: Denoiser, device: torch.device, runs: int) -> dict[str, dict[str, float | str]]:
    """Updates of ours, in both precisions, and of the plain version, which has no dropout."""
    figures = {}
    kinds = {"": ("plain version", False, True), "_bf16": ("single precision", True, False)}
    for name, (other, half, plain) in kinds.items():
        own = Training(net, device, half=half, plain=False)
        peak = gpu_peak(own.update)
        beside = Training(net, device, half=False, plain=plain)
        figures[f"diffusion_training{name}"] = row = compare(own.update, beside.update, runs, "")
        row["note"] = (
            f"an update of {BATCH} windows of {WINDOW} frames, {1 / row['ours']:.2f} a second{peak}"
            f"; other: {other}{gpu_peak(beside.update)} (both in memory)"
        )
    return figures


def flex(bias: PositionBias, n_frames: int, *, compiled: bool) -> Callable[..., Tensor]:
    """FlexAttention with this position bias, and no pairs of frames beyond a head's reach."""
    table = bias.table(n_frames - 1)
    reaches = torch.tensor(bias.reaches, device=table.device)

    def score(value: Tensor, batch: Tensor, head: Tensor, query: Tensor, key: Tensor) -> Tensor:
        return value + table[head, query - key + n_frames - 1]

    def sees(batch: Tensor, head: Tensor, query: Tensor, key: Tensor) -> Tensor:
        return (query - key).abs() <= reaches[head]

    heads = len(bias.reaches)
    mask = create_block_mask(sees, None, heads, n_frames, n_frames, device=table.device.type)
    attention = torch.compile(flex_attention) if compiled else flex_attention
    return lambda q, k, v: attention(q, k, v, score_mod=score, block_mask=mask)


def attention(net: Denoiser, device: torch.device, runs: int) -> dict[str, dict[str, float | str]]:
    """Attention of one layer: sampling of one clip, and forward and backward of a batch."""
    figures, bias = {}, net.stacks[0].layers[0].attention.bias
    for n_frames, batch, trains in ((300, 1, False), (1800, 1, False), (WINDOW, BATCH, True)):
        with torch.no_grad():
            own, other = bands(bias, n_frames), flex(bias, n_frames, compiled=device.type != "cpu")
        shape = 3, batch, CONFIG.heads, n_frames, CONFIG.channels // CONFIG.heads
        qkv = torch.randn(shape, device=device).requires_grad_(trains)

        def ours(qkv=qkv, own=own, trains=trains) -> Tensor:
            return attend(*qkv, own, 0.0, fused=not trains)

        def theirs(qkv=qkv, other=other) -> Tensor:
            return other(*qkv)

        def work(made: Callable[[], Tensor], qkv=qkv, trains=trains) -> Callable[[], object]:
            return lambda: torch.autograd.grad(made().sum(), qkv) if trains else made()

        with torch.set_grad_enabled(trains):
            apart = float((ours() - theirs()).detach().abs().max())
            assert apart < 1e-2, f"not the same attention: {apart} apart"
            what = "forward and backward without the bias" if trains else "forward"
            figures[f"diffusion_attention_{n_frames}x{batch}"] = compare(
                work(ours),
                work(theirs),
                5 * runs,
                f"{batch} x {n_frames} frames, {what}{gpu_peak(work(ours))}; other: compiled "
                f"FlexAttention, {apart:.0e} apart{gpu_peak(work(theirs))}",
            )
    return figures


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
