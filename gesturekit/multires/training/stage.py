"""Training of two levels of a pyramid: discriminator, random and reconstruction steps."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

import audio_features as af
from gesturekit.multires.backend import choose_backend
from gesturekit.multires.config import MultiresConfig
from gesturekit.multires.kinematics import VectorKinematics
from gesturekit.multires.losses import LossInputs, losses, reconstruction
from gesturekit.multires.network.discriminator import LevelDiscriminator
from gesturekit.multires.network.generator import MultiresGenerator
from gesturekit.multires.network.resampling import resample
from gesturekit.multires.sampling.conditions import agreed_style
from gesturekit.multires.training.batches import Batches
from gesturekit.multires.training.data import TrainingData
from gesturekit.multires.training.state import TrainingState, state_targets
from gesturekit.multires.training.targets import (
    ArmTarget,
    DetailTarget,
    arm_targets,
    detail_targets,
    log_movement,
)
from gesturekit.multires.training.window_cache import Windows, random_part
from gesturekit.training.run.session import Processes
from gesturekit.training.seeds import rng_for, seeded


class Stage:
    """Training of two adjacent levels; the coarser ones are finished, the finer ones untrained.

    Args:
        config: of the run.
        data: recordings and speech.
        network: the whole pyramid.
        processes: that share each batch.
        first: index of the coarser level.
        iterations: of this stage.
        state: the state of movement; None for a model without it.
    """

    def __init__(
        self,
        config: MultiresConfig,
        data: TrainingData,
        network: MultiresGenerator,
        processes: Processes,
        first: int,
        iterations: int,
        state: TrainingState | None = None,
    ) -> None:
        self.config = config
        self.network = network
        self.processes = processes
        self.first = first
        self.iterations = iterations
        self.device = next(network.parameters()).device
        self.indices = range(first, min(first + 2, config.network.levels))
        self.n_styles = (
            len(data.styles) if config.styles and config.styles.condition_discriminator else 0
        )
        self.generators = nn.ModuleList(network.levels[i] for i in self.indices)
        self.discriminators = nn.ModuleList(
            seeded(
                (config.seed, "discriminator", i),
                lambda: LevelDiscriminator(data.representation, config.network, self.n_styles),
            )
            for i in self.indices
        ).to(self.device)
        self.backend = choose_backend(config.backend, self.generators, self.discriminators)
        self.batches = Batches(data, config, network, first, self.backend.convolve, state)
        rate, (beta, decay) = config.training.learning_rate, config.training.betas
        self.optimisers = {
            name: torch.optim.Adam(networks.parameters(), lr=rate, betas=(beta, decay), fused=True)
            for name, networks in (
                ("generator", self.generators),
                ("discriminator", self.discriminators),
            )
        }
        self.normaliser = data.normaliser.to(self.device)
        self.kinematics = VectorKinematics(
            data.representation, config.fps, arms=config.uses_arm_speed
        ).to(self.device)
        self.targets: list[ArmTarget] = []
        if config.uses_arm_speed:
            self.targets = arm_targets(
                data.sample,
                self.indices,
                config.network.levels,
                self.normaliser.inverse,
                self.kinematics,
                self.device,
            )
        self.states = state_targets(state, self.indices, config, self._places, self.device)
        self.details: dict[int, DetailTarget] = {}
        if config.losses.detail:
            self.details = detail_targets(
                data, self.indices, config.network.levels, self._places, self.device
            )

    def state(self) -> dict[str, Any]:
        """Return what a checkpoint holds."""
        return {
            "first": self.first,
            "generator": self.network.state_dict(),
            "discriminators": self.discriminators.state_dict(),
            "optimisers": {name: o.state_dict() for name, o in self.optimisers.items()},
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore discriminators and optimisers; the trainer restores the generators."""
        self.discriminators.load_state_dict(state["discriminators"])
        for name, optimiser in self.optimisers.items():
            optimiser.load_state_dict(state["optimisers"][name])

    def weights(self) -> list[Tensor]:
        """Return the parameters that this stage trains."""
        return [*self.generators.parameters(), *self.discriminators.parameters()]

    def _places(self, motion: Tensor) -> Tensor:
        """Return the joints' positions (B, K, 3, T) of normalised motion (B, D, T), metres."""
        return self.kinematics.places(self.normaliser.inverse(motion.to(self.device)))

    def _draw(self, kind: str, n_frames: int, rng: torch.Generator) -> Windows:
        """Return this process's share of a batch of windows."""
        windows, chosen = self.batches.windows(kind, n_frames, rng)
        return windows.take(chosen[0, self._share])

    def _style_conditions(self, styles: Tensor) -> list[Tensor | None]:
        """Return each discriminator's style condition (B, K) from the levels' styles (B, L)."""
        n = self.n_styles
        return [agreed_style(styles, n, i) if n else None for i in self.indices]

    @property
    def _share(self) -> slice:
        return self.processes.share(self.batches.size)

    def iterate(self, iteration: int) -> dict[str, float]:
        """Run discriminator, random-generation and reconstruction steps; return their losses.

        Losses are those of this process's share, summed over levels. `discriminator` is eq. 12 and
        `reconstruction` eq. 15, without weights and averaged over levels.
        """
        training = self.config.training
        late = iteration >= training.decay_at * self.iterations
        for optimiser in self.optimisers.values():
            for group in optimiser.param_groups:
                group["lr"] = training.learning_rate * (0.1 if late else 1.0)
        with self._precision():
            threads = self.backend.threads()
        with threads:
            return self._iterate(iteration)

    def _iterate(self, iteration: int) -> dict[str, float]:
        training = self.config.training
        self.batches.renew(iteration)
        rng = rng_for(self.config.seed, "iteration", self.first, iteration)
        report: dict[str, float] = {}
        if training.discriminator_steps:
            steps = range(training.discriminator_steps)
            lengths = [self.batches.length("random", rng) for _ in steps]
            report["discriminator"] = self._discriminator_steps(lengths, rng)
        for _ in range(training.generator_steps):
            report.update(self._random_step(self.batches.length("random", rng), rng))
        for _ in range(training.reconstruction_steps):
            n_frames = self.batches.length("paired", rng)
            report["reconstruction"] = self._reconstruction_step(n_frames, rng)
        return report

    def _precision(self) -> torch.autocast:
        """Return the autocast context of networks; losses and sums over time stay in float32."""
        half = self.config.precision == "bfloat16"
        return torch.autocast(self.device.type, torch.bfloat16, enabled=half)

    def _generate(self, windows: Windows) -> list[Tensor]:
        with self._precision():
            made = self.network(
                windows.noise,
                windows.conditions,
                first=self.first,
                coarser=windows.coarser,
                lengths=[level.shape[-1] for level in windows.conditions],
                convolve=self.backend.convolve,
            )
        return [level.float() for level in made]

    def _within(self, made: Sequence[Tensor], n_frames: int) -> list[Tensor]:
        """Return the generated levels (B, D, T_i) without margins."""
        lengths = af.level_lengths(n_frames, self.config.network.levels)
        kept = []
        for level, i in zip(made, self.indices, strict=True):
            length = lengths[i]
            start = (level.shape[-1] - length) // 2
            kept.append(level[..., start : start + length].contiguous())
        return kept

    def _descend(self, inputs_of: Callable[[int], LossInputs]) -> dict[str, float]:
        """Make one generator step on the losses of each level; return {name: sum over levels}.

        No gradient runs from a level into the one below, so levels are computed in parallel.
        """
        self.optimisers["generator"].zero_grad(set_to_none=True)

        def level(i: int) -> dict[str, Tensor]:
            parts = losses(inputs_of(i), self.config.losses)
            if parts:
                # The discriminator needs no gradients here.
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
        """Average gradients over processes, and step an optimiser."""
        share = self._share
        parameters = [p for group in self.optimisers[name].param_groups for p in group["params"]]
        self.processes.average_gradients(parameters, (share.stop - share.start) / self.batches.size)
        self.optimisers[name].step()

    def _discriminator_steps(self, lengths: Sequence[int], rng: torch.Generator) -> float:
        """Make a discriminator step for each window length; return the last value of eq. 12.

        Generators do not change between them, so all motions are generated at once.
        """
        fakes: dict[int, Iterator[Sequence[Tensor]]] = {}
        for n_frames in dict.fromkeys(lengths):
            count = lengths.count(n_frames)
            windows, chosen = self.batches.windows("random", n_frames, rng, count)
            with torch.no_grad():
                made = self._generate(windows.take(chosen[:, self._share].flatten()))
            split = (level.chunk(count) for level in self._within(made, n_frames))
            fakes[n_frames] = iter(zip(windows.styles[chosen], *split, strict=True))
        for n_frames in lengths:
            styles, *fake = next(fakes[n_frames])
            gap = self._discriminator_step(n_frames, fake, styles, rng)
        return float(gap)  # which waits for a GPU

    def _discriminator_step(
        self, n_frames: int, fakes: Sequence[Tensor], styles: Tensor, rng: torch.Generator
    ) -> Tensor:
        """Make one discriminator step on windows of `n_frames` at the full rate.

        `fakes` (B, D, T_i) of each level are this process's share; `styles` (B, L) are of the whole
        batch. Fakes that are longer than the recordings are cropped.
        """
        batch, share = self.batches.size, self._share
        beside = styles[:, 0].tolist() if self.n_styles else None
        reals = self.batches.reals(n_frames, rng, beside)
        # The penalty interpolates between both, so that they need the same length.
        fakes = [
            random_part(fake, real.shape[-1], rng) for fake, real in zip(fakes, reals, strict=True)
        ]
        conditions = self._style_conditions(styles[share])
        mixes = [torch.rand(batch, 1, 1, generator=rng).to(self.device) for _ in reals]
        with self._precision():
            gaps = self.backend.discriminator_gradients(
                [own for own in self.discriminators if isinstance(own, LevelDiscriminator)],
                [real[share] for real in reals],
                fakes,
                [mix[share] for mix in mixes],
                self.config.losses,
                conditions,
            )
        self._update("discriminator")
        return gaps.mean()

    def _random_step(self, n_frames: int, rng: torch.Generator) -> dict[str, float]:
        """Make a generator step on motions from random noise and unpaired speech."""
        weights, kinematics = self.config.losses, self.kinematics
        windows = self._draw("random", n_frames, rng)
        made = self._generate(windows)
        within = self._within(made, n_frames)
        conditions = self._style_conditions(windows.styles)
        given = self._given(windows, n_frames)
        aims: list[Tensor] = []
        if self.targets:
            pairs = zip(self.targets, windows.speech or (), strict=True)
            aims = self._within([target(speech) for target, speech in pairs], n_frames)

        def of_level(i: int) -> LossInputs:
            motion, level = within[i], self.first + i
            stride = n_frames / motion.shape[-1]
            values = self.normaliser.inverse(motion)
            # One frame, the coarsest level of a very short recording, has no speed.
            moves = motion.shape[-1] > 1
            # Rounding makes strides of two levels straddle 2; half the full rate is meant.
            smooth = weights.smoothness and stride < 2.05 and motion.shape[-1] > 2
            detailed = level in self.details
            parts: dict[str, Tensor] = {}
            if weights.adversarial:
                parts["scores"] = self._scores(i, motion, conditions[i])
            if weights.contact and moves:  # 0 on a rig without feet
                parts["foot_velocity"] = kinematics.foot_velocity(
                    values, stride, weights.contact_time
                )
                parts["contact_labels"] = kinematics.contact_labels(values)
            stated = level in self.states
            places = kinematics.places(values) if smooth or detailed or stated else None
            if smooth and places is not None:
                parts["bend"] = kinematics.bend(values, places, stride)
            coarser = made[i - 1].detach() if i else windows.coarser
            if weights.coarse and coarser is not None:
                parts["coarser"] = coarser
                parts["downsampled"] = resample(made[i], coarser.shape[-1])
            if detailed:
                parts["detail"] = self.details[level](places, windows.styles[:, level])
            if stated:
                parts["state"] = self.states[level](places, given[i])
            if aims and moves:
                parts["arm_target"] = aims[i]
                parts["arms"] = self._arm_movement(values, stride)
            return LossInputs(**parts)

        return self._descend(of_level)

    def _given(self, windows: Windows, n_frames: int) -> list[Tensor]:
        """Return the channels of the state (B, C, T_i) that each level was given, if any."""
        if not self.states:
            return []
        channels = self.batches.cache.data.state_channels
        rows = slice(-channels.width, len(channels.names) - channels.width)
        return self._within([level[:, rows] for level in windows.conditions], n_frames)

    def _arm_movement(self, values: Tensor, stride: float) -> Tensor:
        """Return (B, 2, T) log arm movement of vectors (B, D, T) in their own units."""
        return log_movement(
            self.kinematics.arm_speed(values, stride),
            self.kinematics.arm_acceleration(values, stride),
            stride / self.config.fps,
        )

    def _scores(self, i: int, motion: Tensor, style: Tensor | None) -> Tensor:
        """Return the (B,) scores of generated motions, without gradients for the discriminator."""
        discriminator = self.discriminators[i]
        discriminator.requires_grad_(False)
        with self._precision():
            scores = discriminator(motion, style, self.backend.convolve)
        discriminator.requires_grad_(True)
        return scores

    def _reconstruction_step(self, n_frames: int, rng: torch.Generator) -> float:
        """Make a generator step on recordings reconstructed from z* and their speech (eq. 15)."""
        windows = self._draw("paired", n_frames, rng)
        targets = windows.targets or ()
        if self.config.losses.rec_input == "real":
            # Both levels upsample recorded motion.
            below = (windows.coarser, *targets)
            with self._precision():
                made = [
                    self.network(
                        windows.noise[i : i + 1],
                        windows.conditions[i : i + 1],
                        first=self.first + i,
                        coarser=below[i],
                        lengths=[target.shape[-1]],
                        convolve=self.backend.convolve,
                    )[0].float()
                    for i, target in enumerate(targets)
                ]
        else:
            made = self._generate(windows)
        self._descend(lambda i: LossInputs(generated=made[i], recorded=targets[i]))
        pairs = zip(made, targets, strict=True)
        errors = [reconstruction(level.detach(), recorded) for level, recorded in pairs]
        return float(torch.stack(errors).mean())
