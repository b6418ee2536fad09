"""Training of a pyramid: seconds per iteration, compared with masked dense kernels.

One clip of 648 frames, 29 blocks (24 joints, 4 contacts, the root), 7 levels, hidden channels 5, 9
and 9 per joint, batch 1. An iteration is five discriminator steps, one generator step and one
reconstruction step on each level of a training stage, with GANimator's losses (recipes/ganimator,
published.yaml). "other" has the same arithmetic in GANimator's way: dense kernels times a mask in
every call, six channels for every block, reflection padding, each of the seven steps running all
levels up to its own under autograd, a gradient penalty by double backward, an optimiser for each
network of each level, and losses computed level after level.

The two sides alternate every few iterations, so that caches are in the state of real training.

`GANIMATOR` holds the seconds per iteration of the released code on 2 cores for each of its groups,
the minimum of two runs. The dense side is also timed at those lengths, which shows whether the
comparison is fair on this machine. The ratio is taken at our own lengths, equal on both sides.

With `--device cuda` both sides run on the GPU, ours deterministic and in full float32, the other as
torch does by default; a further figure compares ours with the numba engine on the CPU.
"""

from __future__ import annotations

import statistics
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from harness import arguments, compare, gpu_peak, report, timed
from torch import Tensor, nn

import audio_features as af
from gesturekit.corpus import prepare
from gesturekit.formats import write_bvh
from gesturekit.formats.smpl import smpl_skeleton
from gesturekit.motion import Motion
from gesturekit.multires import losses
from gesturekit.multires.config import MultiresConfig
from gesturekit.multires.kinematics import VectorKinematics
from gesturekit.multires.networks import SLOPE, block_neighbours
from gesturekit.multires.training.trainer import Trainer
from gesturekit.training.config import load_config, to_dict
from gesturekit.training.run_folder import Run
from gesturekit.training.session import Processes, prepare_device

FRAMES, FPS, LEVELS = 648, 30, 7
LENGTHS = (129, 172, 229, 305, 406, 541, 648)
"""GANimator's own, of a clip of 648 frames."""
GANIMATOR = {0: 0.54, 6: 0.50}
BLOCK, HIDDEN, KERNEL = 6, (5, 9, 9), 5
TURN = 4
"""Iterations before the other side's turn."""
RECIPE = Path(__file__).resolve().parents[1] / "recipes/ganimator/published.yaml"


def clip(folder: Path) -> Path:
    """A manifest of one made-up clip: every joint swings at its own pace."""
    rng = np.random.default_rng(0)
    seconds = np.arange(FRAMES)[:, None, None] / FPS
    pace, phase = rng.uniform(0.3, 1.5, (1, 24, 3)), rng.uniform(0, 2 * np.pi, (1, 24, 3))
    half = 0.15 * np.sin(2 * np.pi * pace * seconds + phase)
    rotations = np.concatenate([half, np.ones((FRAMES, 24, 1))], axis=-1)
    rotations /= np.linalg.norm(rotations, axis=-1, keepdims=True)
    root = np.zeros((FRAMES, 3))
    root[:, 1] = 0.93 + 0.02 * np.sin(4 * seconds[:, 0, 0])
    root[:, 2] = 0.5 * seconds[:, 0, 0]
    (folder / "clips").mkdir()
    write_bvh(Motion(smpl_skeleton(24), rotations, root, FPS), folder / "clips/clip.bvh")
    prepare([], folder / "clip.jsonl", unpaired_motion=[folder / "clips"], holdout=0.0)
    return folder / "clip.jsonl"


class MaskedConv(nn.Module):
    """A dense kernel, a mask, and reflection padding."""

    def __init__(self, near: np.ndarray, n_in: int, n_out: int) -> None:
        super().__init__()
        mask = np.repeat(np.repeat(near, n_out, axis=0), n_in, axis=1)[..., None]
        self.register_buffer("mask", torch.from_numpy(mask).float())
        self.conv = nn.Conv1d(mask.shape[1], mask.shape[0], KERNEL)

    def forward(self, x: Tensor) -> Tensor:
        x = F.pad(x, (KERNEL // 2, KERNEL // 2), mode="reflect")
        return F.conv1d(x, self.conv.weight * self.mask, self.conv.bias)


class Masked:
    """The same training, all of it under autograd and dense."""

    def __init__(self, trainer: Trainer, lengths: tuple[int, ...], first: int) -> None:
        torch.manual_seed(0)
        self.device = device = next(trainer.network.parameters()).device
        self.lengths, self.levels = lengths, range(first, min(first + 2, LEVELS))
        self.blocks = trainer.data.representation.block_sizes
        near = block_neighbours(trainer.data.representation, 2)
        widths = (BLOCK, *HIDDEN)
        hidden = [[near, *pair] for pair in zip(widths, widths[1:], strict=False)]
        self.generators, self.critics = [], []
        for _ in range(self.levels.stop):
            convs = [MaskedConv(*size) for size in (*hidden, [near, HIDDEN[-1], BLOCK])]
            self.generators.append(nn.ModuleList(convs).to(device))
            score = nn.Conv1d(HIDDEN[-1] * len(near), 1, KERNEL, padding=2, padding_mode="reflect")
            critic = [MaskedConv(*size) for size in hidden]
            steps = [part for conv in critic for part in (conv, nn.LeakyReLU(SLOPE))]
            self.critics.append(nn.Sequential(*steps, score).to(device))
        self.optimisers = {
            side: [torch.optim.Adam(net.parameters(), lr=1e-4) for net in nets]
            for side, nets in (("g", self.generators), ("d", self.critics))
        }
        self.kinematics = VectorKinematics(trainer.data.representation, FPS).to(device)
        # Six channels for every block: a contact and the root leave some of them unused.
        width = BLOCK * len(self.blocks)
        places = [BLOCK * i + k for i, size in enumerate(self.blocks) for k in range(size)]
        self.places = torch.tensor(places, device=device)
        motion = trainer.data.paired[0].motion.to(device)
        whole = torch.zeros(1, width, motion.shape[-1], device=device)
        whole[0, self.places] = motion
        self.reals = [F.interpolate(whole, size=n, mode="linear") for n in lengths]
        self.z_star = torch.randn(1, width, lengths[0], device=device)
        self.pools: dict[int, list[Tensor]] = {i: [] for i in self.levels}

    def generate(self, noises: list[Tensor]) -> list[Tensor]:
        made, up = [], torch.zeros_like(self.reals[0])
        for level, noise in zip(self.generators, noises, strict=True):
            if up.shape[-1] != noise.shape[-1]:
                up = F.interpolate(up, size=noise.shape[-1], mode="linear")
            x = up + noise
            for i, conv in enumerate(level):
                x = conv(F.leaky_relu(x, SLOPE) if i else x)
            up = x + up
            made.append(up)
        return made

    def random(self) -> list[Tensor]:
        lengths = self.lengths[: self.levels.stop]
        return self.generate([torch.randn(1, 1, n, device=self.device) * 0.1 for n in lengths])

    def pooled(self, level: int, fake: Tensor) -> Tensor:
        pool = self.pools[level]
        if len(pool) < 50:
            pool.append(fake)
            return fake
        if torch.rand(()) < 0.5:
            return fake
        which = int(torch.randint(len(pool), ()))
        fake, pool[which] = pool[which], fake
        return fake

    def discriminator_step(self) -> None:
        made = self.random()
        for i in self.levels:
            critic, real, fake = self.critics[i], self.reals[i], made[i].detach()
            self.optimisers["d"][i].zero_grad()
            (-0.5 * critic(real).mean()).backward()
            (0.5 * critic(self.pooled(i, fake)).mean()).backward()
            mix = torch.rand(1, 1, 1, device=self.device)
            between = (mix * real + (1 - mix) * fake).requires_grad_(True)
            score = critic(between)
            (gradient,) = torch.autograd.grad(
                score, between, torch.ones_like(score), create_graph=True, retain_graph=True
            )
            ((gradient.norm(dim=1) - 1) ** 2).mean().backward()
            self.optimisers["d"][i].step()

    def generator_step(self) -> None:
        made = self.random()
        sums = []
        for i in self.levels:
            values = made[i].index_select(1, self.places)
            contact = losses.contact(
                self.kinematics.foot_velocity(values, FRAMES / self.lengths[i]),
                self.kinematics.contact_labels(values),
                slope=12.0,
                squared=False,
            )
            sums.append(5 * contact - self.critics[i](made[i]).mean())
        self.step(sums)

    def reconstruction_step(self) -> None:
        lengths = self.lengths[1 : self.levels.stop]
        still = [torch.zeros(1, 1, n, device=self.device) for n in lengths]
        made = self.generate([self.z_star, *still])
        self.step([50 * F.l1_loss(made[i], self.reals[i]) for i in self.levels])

    def step(self, losses: list[Tensor]) -> None:
        for i in self.levels:
            self.optimisers["g"][i].zero_grad()
        for loss in losses:
            loss.backward(retain_graph=True)
        for i in self.levels:
            self.optimisers["g"][i].step()

    def iterate(self) -> None:
        with torch_defaults():
            for _ in range(5):
                self.discriminator_step()
            self.generator_step()
            self.reconstruction_step()


@contextmanager
def torch_defaults() -> Iterator[None]:
    """Turn off what `prepare_device` sets: deterministic algorithms, and full float32."""
    ours = torch.are_deterministic_algorithms_enabled(), torch.backends.cudnn.allow_tf32
    torch.use_deterministic_algorithms(False)
    torch.backends.cudnn.allow_tf32 = True
    yield
    torch.use_deterministic_algorithms(ours[0], warn_only=True)
    torch.backends.cudnn.allow_tf32 = ours[1]


class Ours:
    """Iterations of a stage, renewals of the window cache included."""

    def __init__(self, trainer: Trainer, first: int) -> None:
        self.stage = trainer.stage(first, 15000)
        self.iteration = 0

    def iterate(self) -> None:
        self.stage.iterate(self.iteration)
        self.iteration += 1


def trainer_on(folder: Path, manifest: Path, device: str) -> Trainer:
    settings = [f"corpus={manifest}", f"out={folder / device}", f"fps={FPS}", "joints=all"]
    config = load_config(RECIPE, MultiresConfig, settings)
    run = Run(config.out, to_dict(config), resume=False)
    return Trainer(config, run, prepare_device(device), Processes(), resume=False)


def main() -> None:
    options = arguments(__doc__.splitlines()[0], takes_device=True)
    torch.set_num_threads(2)
    runs = 3 if options.quick else 8
    figures = {}
    with tempfile.TemporaryDirectory() as name:
        folder, manifest = Path(name), clip(Path(name))
        trainer = trainer_on(folder, manifest, options.device)
        on_cpu = None if options.device == "cpu" else trainer_on(folder, manifest, "cpu")
        own = tuple(af.level_lengths(FRAMES, LEVELS))
        for first, known in GANIMATOR.items():
            ours = Ours(trainer, first)
            masked, published = Masked(trainer, own, first), Masked(trainer, LENGTHS, first)
            seconds = statistics.median(timed(published.iterate, runs))
            levels = f"levels {first + 1} to {masked.levels.stop}"
            figures[f"train_levels_{first + 1}"] = compare(
                ours.iterate,
                masked.iterate,
                runs,
                f"an iteration of {levels}; other: dense, masked, all under autograd, which at "
                f"GANimator's lengths takes {seconds:.2f} s, GANimator {known:.2f}",
                turn=TURN,
            )
            if on_cpu is not None:
                figures[f"train_levels_{first + 1}_cpu"] = compare(
                    ours.iterate,
                    Ours(on_cpu, first).iterate,
                    runs,
                    f"an iteration of {levels} on the GPU{gpu_peak(ours.iterate)}; other: on the "
                    "CPU, two threads, by the numba engine",
                    turn=TURN,
                )
    report(figures, options.json)


if __name__ == "__main__":
    main()
