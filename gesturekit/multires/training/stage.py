"""Training of two levels of a pyramid: discriminator, random and reconstruction steps."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

import audio_features as af
from gesturekit.errors import ModelError
from gesturekit.multires import losses
from gesturekit.multires.backend import choose_backend, requested_backend
from gesturekit.multires.network.discriminator import LevelDiscriminator
from gesturekit.multires.network.resampling import resample
from gesturekit.multires.sampling.styles import agreed_style
from gesturekit.multires.training.arm_speed import ArmTarget, log_movement
from gesturekit.multires.training.detail import DetailTarget
from gesturekit.multires.training.kinematics import CAPTURE_SECONDS
from gesturekit.multires.training.window_cache import Windows
from gesturekit.training.seeds import rng_for, seeded

if TYPE_CHECKING:
    from gesturekit.multires.training.trainer import Trainer
    from gesturekit.training.run.steps import Steps


class Pair:
    """Training of two levels; the ones below are finished, the ones above not begun.

    Args:
        trainer: of the whole pyramid.
        first: index of the coarser level.
        iterations: how many there are for this pair.
    """

    def __init__(self, trainer: Trainer, first: int, iterations: int) -> None:
        self.trainer = trainer
        self.config = trainer.config
        self.first = first
        self.iterations = iterations
        self.indices = range(first, min(first + 2, self.config.network.levels))
        self.generators = nn.ModuleList(trainer.network.levels[i] for i in self.indices)
        self.discriminators = nn.ModuleList(
            seeded(
                (self.config.seed, "discriminator", i),
                lambda: LevelDiscriminator(
                    trainer.data.representation, self.config.network, self._n_told
                ),
            )
            for i in self.indices
        ).to(trainer.device)
        requested = requested_backend(self.config.backend)
        self.backend = choose_backend(requested, self.generators, self.discriminators)
        rate, betas = self.config.training.learning_rate, self.config.training.betas
        self.optimisers = {
            name: torch.optim.Adam(networks.parameters(), lr=rate, betas=betas, fused=True)
            for name, networks in (
                ("generator", self.generators),
                ("discriminator", self.discriminators),
            )
        }
        self.targets = self._arm_targets() if self.config.uses_arm_speed else []
        self.details = self._detail_targets() if self.config.losses.detail else {}
        self._bank: dict[str, dict[int, Windows]] = {}

    def state(self) -> dict[str, Any]:
        """All that training goes on from, for a checkpoint."""
        return {
            "first": self.first,
            "generator": self.trainer.network.state_dict(),
            "discriminators": self.discriminators.state_dict(),
            "optimisers": {name: o.state_dict() for name, o in self.optimisers.items()},
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on from what `state` gave; the generators' weights are loaded by the trainer."""
        self.discriminators.load_state_dict(state["discriminators"])
        for name, optimiser in self.optimisers.items():
            optimiser.load_state_dict(state["optimisers"][name])

    def train(self, begin: int, offset: int, progress: Steps, cost: float) -> None:
        """Run iterations `begin` to the last; `offset` iterations belong to earlier pairs."""
        training = self.config.training
        totals: dict[str, float] = {}
        since, clock = 0, time.monotonic()
        for iteration in range(begin, self.iterations):
            late = iteration >= training.decay_at * self.iterations
            for optimiser in self.optimisers.values():
                for group in optimiser.param_groups:
                    group["lr"] = training.learning_rate * (0.1 if late else 1.0)
            for name, value in self.iterate(iteration).items():
                totals[name] = totals.get(name, 0.0) + value
            since += 1
            step = offset + iteration + 1
            self._check_finite(step, totals)
            progress.step(cost)
            last = iteration + 1 == self.iterations
            first = self.trainer.processes.is_first
            if first and (step % self.config.log_every == 0 or last):
                means = {name: value / since for name, value in totals.items()}
                pace = (time.monotonic() - clock) / since
                self.trainer.folder.log(
                    step, {**means, "seconds_per_iteration": pace}, level=self.first + 1
                )
                shown = ", ".join(f"{name} {value:.3g}" for name, value in means.items())
                progress.set_postfix_str(f"level {self.first + 1}-{self.indices[-1] + 1}: {shown}")
                totals, since, clock = {}, 0, time.monotonic()
            if first and self.config.eval_every and (step % self.config.eval_every == 0 or last):
                self.trainer.evaluate(step, self.first, self.indices[-1] + 1)
            fires = self.config.eval_every and step % self.config.eval_every == 0
            if first and not last and (fires or self.trainer.held_out.is_due()):
                self.trainer.measure(step, self.indices[-1] + 1)
            if step % self.config.checkpoint_every == 0 or last:
                networks = nn.ModuleList([self.generators, self.discriminators])
                norms = [weight.detach().norm() for weight in networks.parameters()]
                self._check_finite(step, {"weights": float(torch.stack(norms).sum())})
                if first:
                    self.trainer.folder.checkpoints.save(step, self.state())

    def _check_finite(self, step: int, values: dict[str, float]) -> None:
        """Stop before a checkpoint is written over what can still be used."""
        wrong = [name for name, value in values.items() if not math.isfinite(value)]
        if wrong:
            raise ModelError(
                f"training diverged at step {step} ({', '.join(wrong)} are no numbers any more); "
                "the last checkpoint stands. A lower training.learning_rate usually helps"
            )

    def _fill_bank(self, renewal: int) -> None:
        """Draw and pre-generate windows for reconstruction and for random steps."""
        trainer, bank = self.trainer, self.trainer.bank
        self._bank = {"paired": {}, "random": {}}
        rng = rng_for(self.config.seed, "bank", self.first, renewal)
        total = sum(len(members) for members in trainer.groups.values())
        training = self.config.training
        for n_frames, members in trainer.groups.items():
            sequences = [trainer.data.paired[i] for i in members]
            count = max(1, training.window_cache * len(members) // total)
            if training.reconstruction_steps:
                self._bank["paired"][n_frames] = bank.paired(
                    sequences, n_frames, self.first, count, rng
                )
            if training.discriminator_steps or training.generator_steps:
                self._bank["random"][n_frames] = bank.random(
                    sequences, n_frames, self.first, count, rng
                )

    def _windows(
        self, kind: str, n_frames: int, rng: torch.Generator, batches: int = 1
    ) -> tuple[Windows, Tensor]:
        """Windows, and the (batches, B) numbers of those that are used, for all processes."""
        size = (batches, self.trainer.batch)
        if self.config.training.window_cache is not None:
            windows = self._bank[kind][n_frames]
            return windows, torch.randint(len(windows), size, generator=rng)
        draw = self.trainer.bank.paired if kind == "paired" else self.trainer.bank.random
        sequences = [self.trainer.data.paired[i] for i in self.trainer.groups[n_frames]]
        windows = draw(sequences, n_frames, self.first, math.prod(size), rng)
        if len(windows) == math.prod(size):
            return windows, torch.arange(len(windows)).reshape(size)
        return windows, torch.randint(len(windows), size, generator=rng)

    def _draw(self, kind: str, n_frames: int, rng: torch.Generator) -> Windows:
        """My share of a batch of windows."""
        windows, chosen = self._windows(kind, n_frames, rng)
        return windows.take(chosen[0, self._share])

    @property
    def _n_told(self) -> int:
        """K, how many styles discriminators are told of; 0 where they are told nothing."""
        styles = self.config.styles
        return (
            len(self.trainer.data.styles)
            if styles is not None and styles.condition_discriminator
            else 0
        )

    def _told(self, styles: Tensor) -> list[Tensor | None]:
        """What each discriminator is told of motions whose levels have these styles, (B, L)."""
        count = self._n_told
        return [agreed_style(styles, count, i) if count else None for i in self.indices]

    @property
    def _share(self) -> slice:
        return self.trainer.processes.share(self.trainer.batch)

    def iterate(self, iteration: int) -> dict[str, float]:
        """One iteration: discriminator, random-generation and reconstruction steps."""
        with self._precision():
            threads = self.backend.threads()
        with threads:
            return self._iterate(iteration)

    def _iterate(self, iteration: int) -> dict[str, float]:
        training = self.config.training
        if training.window_cache is not None and (
            iteration % training.renew_every == 0 or not self._bank
        ):
            self._fill_bank(iteration // training.renew_every)
        rng = rng_for(self.config.seed, "iteration", self.first, iteration)
        lengths = list(self.trainer.groups)
        report: dict[str, float] = {}

        def length() -> int:
            return lengths[int(torch.multinomial(self.trainer.group_frames, 1, generator=rng))]

        if training.discriminator_steps:
            chosen = [length() for _ in range(training.discriminator_steps)]
            report["critic"] = self._discriminator_steps(chosen, rng)
        for _ in range(training.generator_steps):
            report.update(self._random_step(length(), rng))
        for _ in range(training.reconstruction_steps):
            report["rec"] = self._reconstruction_step(length(), rng)
        values = self.trainer.processes.mean(torch.tensor(list(report.values())))
        return dict(zip(report, values.tolist(), strict=True))

    def _precision(self) -> torch.autocast:
        """What networks run under; losses and sums over time stay in float32."""
        half = self.config.precision == "bfloat16"
        return torch.autocast(self.trainer.device.type, torch.bfloat16, enabled=half)

    def _generate(self, windows: Windows) -> list[Tensor]:
        with self._precision():
            made = self.trainer.network(
                windows.noise,
                windows.conditions,
                first=self.first,
                coarser=windows.coarser,
                lengths=[level.shape[-1] for level in windows.conditions],
                convolve=self.backend.convolve,
            )
        return [level.float() for level in made]

    def _within(self, made: Sequence[Tensor], n_frames: int) -> list[Tensor]:
        """The levels of the pair, (B, C, T_i), without the margins."""
        if not self.config.random_margin:
            return list(made)
        lengths = af.level_lengths(n_frames, self.config.network.levels)
        kept = []
        for level, i in zip(made, self.indices, strict=True):
            length = lengths[i]
            start = (level.shape[-1] - length) // 2
            kept.append(level[..., start : start + length].contiguous())
        return kept

    def _descend(self, losses: Callable[[int], dict[str, Tensor]]) -> dict[str, float]:
        """One step of the generators, each down the sum of its level's losses.

        No gradient runs from a level into the one below, so levels go side by side.

        Args:
            losses: by name, of the level of this number in the pair.

        Returns:
            the sum over levels of each loss.
        """
        self.optimisers["generator"].zero_grad(set_to_none=True)

        def level(i: int) -> dict[str, Tensor]:
            parts = losses(i)
            if parts:
                # Only this level gets gradients; its discriminator's would be thrown away.
                own = list(self.generators[i].parameters())
                torch.stack(list(parts.values())).sum().backward(inputs=own)
            return {name: value.detach() for name, value in parts.items()}

        sums: dict[str, float] = {}
        for parts in self.backend.run_tasks(*(partial(level, i) for i in range(len(self.indices)))):
            for name, value in parts.items():
                sums[name] = sums.get(name, 0.0) + float(value)
        if sums:
            self._update("generator")
        return sums

    def _update(self, name: str) -> None:
        """One step down the mean gradient of all processes."""
        processes, share = self.trainer.processes, self._share
        parameters = [p for group in self.optimisers[name].param_groups for p in group["params"]]
        processes.average_gradients(parameters, (share.stop - share.start) / self.trainer.batch)
        self.optimisers[name].step()

    def _discriminator_steps(self, lengths: Sequence[int], rng: torch.Generator) -> float:
        """Steps on windows of these lengths; the generator stands, so fakes are made beforehand."""
        fakes: dict[int, Iterator[Sequence[Tensor]]] = {}
        for n_frames in dict.fromkeys(lengths):
            count = lengths.count(n_frames)
            windows, chosen = self._windows("random", n_frames, rng, count)
            with torch.no_grad():
                made = self._generate(windows.take(chosen[:, self._share].flatten()))
            split = (level.chunk(count) for level in self._within(made, n_frames))
            fakes[n_frames] = iter(zip(windows.styles[chosen], *split, strict=True))
        gap = 0.0
        for n_frames in lengths:
            styles, *fake = next(fakes[n_frames])
            gap = self._discriminator_step(n_frames, fake, styles, rng)
        return gap

    def _discriminator_step(
        self, n_frames: int, fakes: Sequence[Tensor], styles: Tensor, rng: torch.Generator
    ) -> float:
        """Fakes are my share of a batch, styles (B, L) those of all of it."""
        sequences = [self.trainer.data.paired[i] for i in self.trainer.groups[n_frames]]
        batch, share = self.trainer.batch, self._share
        beside = styles[:, 0].tolist() if self._n_told else None
        reals = self.trainer.bank.reals(sequences, n_frames, self.first, batch, rng, beside)
        told = self._told(styles[share])
        mixes = [torch.rand(batch, 1, 1, generator=rng).to(self.trainer.device) for _ in reals]
        with self._precision():
            gaps = self.backend.discriminator_gradients(
                self.discriminators,
                [real[share] for real in reals],
                fakes,
                [mix[share] for mix in mixes],
                self.config.losses,
                told,
            )
        self._update("discriminator")
        return float(gaps.mean())

    def _random_step(self, n_frames: int, rng: torch.Generator) -> dict[str, float]:
        """Random generation from unpaired speech; there is no recorded motion to compare with."""
        weights = self.config.losses
        windows = self._draw("random", n_frames, rng)
        made = self._generate(windows)
        within = self._within(made, n_frames)
        told = self._told(windows.styles)
        aims: list[Tensor] = []
        if self.targets:
            heard = zip(self.targets, windows.speech, strict=True)
            aims = self._within([target(speech) for target, speech in heard], n_frames)

        def of_level(i: int) -> dict[str, Tensor]:
            motion, kinematics = within[i], self.trainer.kinematics
            stride = n_frames / motion.shape[-1]
            values = self.trainer.normaliser.inverse(motion)
            parts: dict[str, Tensor] = {}
            if weights.adversarial:
                critic = self.discriminators[i]
                critic.requires_grad_(False)  # what the score is by its weights is not asked for
                with self._precision():
                    scores = critic(motion, told[i], self.backend.convolve)
                    loss = losses.adversarial(scores)
                critic.requires_grad_(True)
                parts["adversarial"] = weights.adversarial * loss
            # One frame, the coarsest level of a very short recording, has no speed.
            moves = motion.shape[-1] > 1
            if weights.contact and moves:  # 0 on a rig without feet
                loss = losses.contact(
                    kinematics.foot_velocity(values, stride),
                    kinematics.contact_labels(values),
                    weights.contact_slope,
                    squared=weights.contact_speed == "squared",
                )
                parts["contact"] = weights.contact * loss
            # Rounding makes strides of two levels straddle 2; half the full rate is meant.
            smooth, detailed = weights.smoothness and stride < 2.05, self.first + i in self.details
            places = kinematics.places(values) if smooth or detailed else None
            if smooth:
                loss = losses.smoothness(kinematics.bend(values, places, stride))
                parts["smooth"] = weights.smoothness * loss
            if weights.coarse and self.first + i:
                given = windows.coarser if i == 0 else made[i - 1].detach()
                loss = losses.coarse(resample(made[i], given.shape[-1]), given)
                parts["coarse"] = weights.coarse * loss
            if detailed:
                loss = self.details[self.first + i](places, windows.styles[:, self.first + i])
                parts["detail"] = weights.detail * loss
            if aims and moves:
                arms = log_movement(
                    kinematics.arm_speed(values, stride),
                    kinematics.arm_acceleration(values, stride),
                    stride / self.config.fps,
                )
                distances = losses.movement(arms, aims[i])
                for name, distance in zip(
                    ("arm_speed", "arm_acceleration"), distances, strict=True
                ):
                    if weight := getattr(weights, name):
                        parts[name] = weight * distance
            return parts

        return self._descend(of_level)

    def _reconstruction_step(self, n_frames: int, rng: torch.Generator) -> float:
        """Reconstruction of paired motion from z* and its own speech (eq. 15)."""
        windows = self._draw("paired", n_frames, rng)
        if self.config.losses.rec_input == "real":
            # Every level starts from the recorded motion below it, the pair's second one too.
            below = (windows.coarser, *windows.targets)
            with self._precision():
                made = [
                    self.trainer.network(
                        windows.noise[i : i + 1],
                        windows.conditions[i : i + 1],
                        first=self.first + i,
                        coarser=below[i],
                        lengths=[target.shape[-1]],
                        convolve=self.backend.convolve,
                    )[0].float()
                    for i, target in enumerate(windows.targets)
                ]
        else:
            made = self._generate(windows)
        errors = [
            losses.reconstruction(generated, recorded)
            for generated, recorded in zip(made, windows.targets, strict=True)
        ]
        self._descend(lambda i: {"rec": self.config.losses.reconstruction * errors[i]})
        return float(torch.stack(errors).detach().mean())

    def _detail_targets(self) -> dict[int, DetailTarget]:
        """The detail of the pair's levels, by their index; the first of all has none below it."""
        data, to = self.trainer.data, self.trainer.device
        styles, levels = max(1, len(data.styles)), self.config.network.levels

        def places(motion: Tensor) -> Tensor:
            values = self.trainer.normaliser.inverse(motion.to(to))
            return self.trainer.kinematics.places(values)

        return {
            i: DetailTarget(data.paired, i, levels, places, data.window, styles).to(to)
            for i in self.indices
            if i
        }

    def _arm_targets(self) -> list[ArmTarget]:
        """One regression a level, from the paired speech to how the recorded arms move.

        The recording's speed is taken raw, with all that is fast in it, and the generated one
        without trembling (`VectorKinematics.arm_speed`): the arms shall be as fast as the
        recorded ones by moving, not by shaking. Acceleration is the other way round: recorded
        without capture noise, generated with all that trembles.
        """
        targets = []
        levels = self.config.network.levels
        kinematics = self.trainer.kinematics
        for i in self.indices:
            speeches, movements = [], []
            stride = 1.0
            for sequence in self.trainer.data.paired:
                n = af.level_lengths(sequence.n_frames, levels)[i]
                if n < 2:
                    continue  # a single frame has no speed
                stride = sequence.n_frames / n
                motion = resample(sequence.motion[None].to(self.trainer.device), n)
                values = self.trainer.normaliser.inverse(motion)
                movement = log_movement(
                    kinematics.arm_speed(values, stride, smoothing=0.0),
                    kinematics.arm_acceleration(values, stride, smoothing=CAPTURE_SECONDS),
                    stride / self.config.fps,
                )
                movements.append(movement[0])
                speeches.append(resample(sequence.speech.to(self.trainer.device), n))
            target = ArmTarget(stride / self.config.fps).to(self.trainer.device)
            targets.append(target.fit(speeches, movements))
        return targets
