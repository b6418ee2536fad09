"""Training of a multires model: its data, stages, steps, checkpoints and the model folder.

A stage trains two levels, the coarsest first. One iteration of a stage (section 4.2 of the paper)
is some discriminator steps, a random-generation step and a reconstruction step.
"""

from __future__ import annotations

import copy
import logging
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

import audio_features as af
from gesturekit.errors import GestureKitError
from gesturekit.multires.backend import choose_backend
from gesturekit.multires.config import MultiresConfig
from gesturekit.multires.kinematics import VectorKinematics
from gesturekit.multires.losses import LevelMotion, random_losses, reconstruction
from gesturekit.multires.model import MultiresModel
from gesturekit.multires.networks import LevelDiscriminator, MultiresGenerator
from gesturekit.multires.pyramid import agreed_style
from gesturekit.multires.retrieval import RecordedLibrary
from gesturekit.multires.training.data import TrainingData
from gesturekit.multires.training.loading import (
    adapted,
    described,
    load_training_data,
    read_recordings,
    warn_of_speech,
)
from gesturekit.multires.training.monitor import Monitor, distance_from_recordings
from gesturekit.multires.training.result import live_predictions, trained_model
from gesturekit.multires.training.state import TrainingState
from gesturekit.multires.training.targets import (
    MOST_WINDOWS,
    ArmTarget,
    DetailTarget,
    StateTarget,
    arm_target,
)
from gesturekit.multires.training.windows import Batches, Windows, usage
from gesturekit.state.prediction import AheadPrediction
from gesturekit.training.model_folder import TrainedModel
from gesturekit.training.origin import widened
from gesturekit.training.seeds import rng_for, seeded
from gesturekit.training.session import Processes
from gesturekit.training.trainer import BaseTrainer, Estimate, quickest, run_training
from gesturekit.wording import counted, roughly

log = logging.getLogger(__name__)


def train(config: MultiresConfig, *, resume: bool = False) -> Path:
    """Train a multires model and write it; see `run_training`."""
    return run_training(Trainer, config, resume=resume)


class Trainer(BaseTrainer):
    """A training run: its data, its network and its stages, one after another."""

    config: MultiresConfig
    data: TrainingData
    read_data = staticmethod(load_training_data)
    load_data = staticmethod(TrainingData.load)
    read_recordings = staticmethod(partial(read_recordings, trial=True))

    def set_up(self) -> None:
        """Announce the training, and make its network."""
        config, processes = self.config, self.processes
        self._live: tuple[AheadPrediction, ...] | None = None
        data, skeleton = self.data, self.data.representation.skeleton
        self.config = config = adapted(config, skeleton, quiet=not processes.is_first)
        if processes.is_first:
            warn_of_speech(config, data)
        self.announce(*described(config, data), sum(count for _, count in self.stages()))
        self.network = seeded(
            (config.seed, "generator"),
            lambda: MultiresGenerator(data.representation, data.conditions.width, config.network),
        )
        if data.start:
            self.network.load_state_dict(
                widened(data.start, self.network, lambda name: name.endswith("embed.weight"))
            )
        self.network.to(self.device)
        self.monitor = None
        if config.eval_every and processes.is_first:
            convolve = choose_backend(config.backend, self.network).convolve
            self.monitor = Monitor(data, config, convolve, self.state)

    @cached_property
    def state(self) -> TrainingState | None:
        """Return the state of movement of the recordings; None for a model without it."""
        return TrainingState(self.data, self.config) if self.config.state else None

    @cached_property
    def library(self) -> RecordedLibrary | None:
        """Return the recorded motion that the model plays; None without."""
        return None if self.state is None else self.state.library()

    def stages(self) -> list[tuple[int, int]]:
        """Return (first level, iterations) of each stage."""
        training = self.config.training
        first = self.config.lengthened(training.first_stage)
        further = self.config.lengthened(training.further_stages)
        levels = range(0, self.config.network.levels, training.stage_levels)
        return [(level, further if level else first) for level in levels]

    def stage(self, first: int, iterations: int) -> Stage:
        """Return the stage that begins with this level, its discriminators untrained."""
        return Stage(
            self.config, self.data, self.network, self.processes, first, iterations, self.state
        )

    def run(self) -> None:
        """Train all stages, or those that are left, and write the model."""
        done, state = self.loop.resume()
        if state is not None:
            self.network.load_state_dict(state["generator"])
        stages, network = self.stages(), self.config.network
        # Part of an iteration's cost grows with its number of frames.
        costs = [20 + 100 * network.factor ** (first + 2 - network.levels) for first, _ in stages]
        end, reported = 0, None
        with self.loop.progress([(n, cost) for (_, n), cost in zip(stages, costs)], done):
            for (first, iterations), cost in zip(stages, costs, strict=True):
                before, end = end, end + iterations
                if end <= done:
                    continue
                stage = self.stage(first, iterations)
                if self.processes.is_first and stage.backend.reason != reported:
                    reported = stage.backend.reason
                    log.info("Backend: %s (%s).", stage.backend.name, reported)
                if state is not None and state["first"] == first:
                    stage.load_state(state)
                last = stage.indices[-1] + 1
                steps = range(max(done, before) + 1, end + 1)
                name = f"level {first + 1}-{last}: "
                for step in self.loop.begin(steps, cost, name, level=first + 1):
                    due = self.loop.count(step, stage.iterate(step - before - 1))
                    if due.evaluation:
                        self.evaluate(step, first, last)
                    if due.measurement:
                        self.measure(step, last)
                    if due.checkpoint:
                        self.loop.save(step, stage.weights(), stage.state())
        if self.processes.is_first:
            self.finish(end, self._calibrated(self._model(self.network)))

    def measure(self, step: int, levels: int) -> str:
        """Log and return the verdict on held-out recordings, at the finest level so far."""
        model = self._model(copy.deepcopy(self.network))
        if levels == self.config.network.levels:
            return self.held_out.measure(step, model)
        so_far = f", levels 1-{levels} of {self.config.network.levels}"
        return self.held_out.measure(step, model, so_far, levels=levels)

    def evaluate(self, step: int, first: int, levels: int) -> None:
        """Log cheap metrics, write a sample, and keep the best model of the last stage."""
        if self.monitor is None:
            return
        metrics = self.monitor.metrics(self.network, levels)
        self.monitor.warn_of_collapse(metrics, step)
        self.monitor.write_sample(self.folder.folder / "samples", step)
        if levels == self.config.network.levels:
            # Models of earlier stages lack the finest levels.
            before = self.folder.evaluations(level=first + 1)
            distance = distance_from_recordings(metrics)
            if all(distance < distance_from_recordings(other) for other in before):
                model = self._calibrated(self._model(copy.deepcopy(self.network)))
                steps = f"{step}, the best by the cheap evaluations"
                self.write("best", model, {"Training steps": steps})
        self.folder.log(step, metrics, level=first + 1, kind="evaluation")

    def _model(self, network: MultiresGenerator) -> MultiresModel:
        """Return the model of a network, which is moved to the CPU."""
        return trained_model(self.config, self.data, network, self.state, self.library)

    def about_data(self) -> dict[str, str]:
        """Return what README.md says of the data beside the recordings, and of their use."""
        (spoken, files), sources = self.data.spoken, len(self.data.sources)
        unpaired = f"{roughly(spoken)} in {counted(files, 'file')}" if files else "none"
        shortest = min(iterations for _, iterations in self.stages())
        return {
            "Unpaired speech": unpaired,
            "Not used": "; ".join(self.unused),
            "Use of the recordings": usage(self.config, shortest, self.data.seconds, sources),
        }

    def write(self, name: str, model: TrainedModel, rows: Mapping[str, str]) -> None:
        """Write a model of the run, its state of movement as its network shows it."""
        assert isinstance(model, MultiresModel)
        if (process := model.state_process) is not None:
            if self._live is None:
                try:
                    self._live = live_predictions(model, self.config.corpus)
                except (GestureKitError, af.AudioFeaturesError) as error:
                    # A trained model is worth more than its use for live speech.
                    self._live = ()
                    what = "The model cannot stream, without predictions for live speech"
                    log.warning("%s: %s", what, error)
            model = replace(model, state_process=replace(process, ahead=self._live))
        super().write(name, model, rows)

    def _calibrated(self, model: MultiresModel) -> MultiresModel:
        """Return a model with a state of movement that its network shows as it is drawn."""
        if self.state is None or self.config.retrieval:
            return model
        return replace(model, state_process=self.state.calibrated(model))

    def estimate(self) -> Estimate:
        """Estimate the cost of the training from a few iterations of each stage.

        They change the networks: for a run that is not kept.
        """
        data, config = self.data, self.config
        whole = data.seconds * config.fps
        frames = sum(sequence.n_frames for sequence in data.paired)
        # Whole recordings differ in length, and each iteration takes one of them.
        longer = 1.0
        if config.training.window is None:
            longer = whole / len(data.sources) / (frames / len(data.paired))
        sampled = min(whole, 60 * config.in_memory * config.fps)
        seconds = quickest(lambda: self.state, 1) * sampled / frames
        for first, iterations in self.stages():
            began = time.monotonic()
            stage = self.stage(first, iterations)
            begin = time.monotonic() - began
            seconds += begin * min(sampled, MOST_WINDOWS) / min(frames, MOST_WINDOWS)
            renewals = math.ceil(iterations / config.training.renew_every)
            seconds += renewals * quickest(partial(stage.batches.renew, 0), 2)
            # The first iteration compiles too.
            seconds += iterations * longer * quickest(partial(stage.iterate, 1), 4)
        speech = 0.0
        if data.conditions.conditioner is not None:
            speech = 4 * config.fps * (data.conditions.conditioner.extractor.dim + 1)
        motion = data.representation.n_features + data.paired[0].passive.shape[0]
        return Estimate(seconds, (4 * config.fps * motion + speech, speech))


class Stage:
    """Training of adjacent levels; the coarser ones are finished, the finer ones untrained.

    Args:
        config: of the run.
        data: recordings and speech.
        network: the whole pyramid.
        processes: that share each batch.
        first: index of the coarsest of them.
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
        self.config, self.network, self.processes = config, network, processes
        self.first, self.iterations = first, iterations
        self.device = next(network.parameters()).device
        last = first + config.training.stage_levels
        self.indices = range(first, min(last, config.network.levels))
        conditioned = config.styles is not None and config.styles.condition_discriminator
        self.n_styles = len(data.conditions.styles) if conditioned else 0
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
        adam = partial(torch.optim.Adam, lr=rate, betas=(beta, decay), fused=True)
        self.optimisers = {
            "generator": adam(self.generators.parameters()),
            "discriminator": adam(self.discriminators.parameters()),
        }
        share = processes.share(self.batches.size)
        self.share, self.weight = share, (share.stop - share.start) / self.batches.size
        self.normaliser = data.normaliser.to(self.device)
        arms = config.uses_arm_speed
        self.kinematics = VectorKinematics(data.representation, config.fps, arms).to(self.device)
        self._fit_targets(data, state)

    def _fit_targets(self, data: TrainingData, state: TrainingState | None) -> None:
        """Fit the targets of each level to the recordings; none for losses that are off."""
        losses, styles = self.config.losses, max(1, len(data.conditions.styles))

        def places(motion: Tensor) -> Tensor:
            return self.kinematics.places(self.normaliser.inverse(motion.to(self.device)))

        self.arms, self.details, self.states = list[ArmTarget](), {}, list[StateTarget]()
        if self.config.uses_arm_speed:
            fit = partial(arm_target, normaliser=self.normaliser, kinematics=self.kinematics)
            self.arms = [fit(data.sample, i) for i in self.indices]
        if losses.detail:
            self.details = {
                i: DetailTarget(data.sample, i, places, data.window, styles).to(self.device)
                for i in self.indices
                if i  # the first level has no coarser one
            }
        if losses.state and state is not None:
            self.states = [StateTarget(state, i, places).to(self.device) for i in self.indices]

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

    def iterate(self, iteration: int) -> dict[str, float]:
        """Run discriminator, random-generation and reconstruction steps; return their losses.

        Losses are those of this process's share, summed over levels. `discriminator` is eq. 12 and
        `reconstruction` eq. 15, without weights and averaged over levels.
        """
        training, batches = self.config.training, self.batches
        late = iteration >= training.decay_at * self.iterations
        for optimiser in self.optimisers.values():
            for group in optimiser.param_groups:
                group["lr"] = training.learning_rate * (0.1 if late else 1.0)
        with self._precision():
            threads = self.backend.threads()
        report: dict[str, float] = {}
        with threads:
            batches.renew(iteration)
            rng = rng_for(self.config.seed, "iteration", self.first, iteration)
            if training.discriminator_steps:
                steps = range(training.discriminator_steps)
                lengths = [batches.length("random", rng) for _ in steps]
                report["discriminator"] = self._discriminator_steps(lengths, rng)
            for _ in range(training.generator_steps):
                report |= self._random_step(batches.length("random", rng), rng)
            for _ in range(training.reconstruction_steps):
                n_frames = batches.length("paired", rng)
                report["reconstruction"] = self._reconstruction_step(n_frames, rng)
        return report

    def _discriminator_steps(self, lengths: Sequence[int], rng: torch.Generator) -> float:
        """Make a discriminator step for each window length; return the last value of eq. 12.

        Generators do not change between them, so all motions are generated at once.
        """
        fakes: dict[int, Iterator[Sequence[Tensor]]] = {}
        for n_frames in dict.fromkeys(lengths):
            count = lengths.count(n_frames)
            windows, chosen = self.batches.windows("random", n_frames, rng, count)
            with torch.no_grad():
                made = self._generate(windows.take(chosen[:, self.share].flatten()))
            split = (level.chunk(count) for level in self._within(made, n_frames))
            fakes[n_frames] = iter(zip(windows.styles[chosen], *split, strict=True))
        for n_frames in lengths:
            styles, *fake = next(fakes[n_frames])
            gap = self._discriminator_step(n_frames, fake, styles, rng)
        return float(gap)  # which waits for a GPU

    def _discriminator_step(
        self, n_frames: int, fakes: Sequence[Tensor], styles: Tensor, rng: torch.Generator
    ) -> Tensor:
        """Make one discriminator step on windows of `n_frames` at the full rate (eqs. 12 and 13).

        `fakes` (B, D, T_i) of each level are this process's share; `styles` (B, L) are of the whole
        batch. Fakes that are longer than the recordings are cropped.
        """
        share = self.share
        beside = styles[:, 0].tolist() if self.n_styles else None
        reals = self.batches.reals(n_frames, rng, beside)
        # The penalty interpolates between both, so that they need the same length.
        cropped = [
            _random_crop(fake, real.shape[-1], rng) for fake, real in zip(fakes, reals, strict=True)
        ]
        mixes = [torch.rand(len(styles), 1, 1, generator=rng).to(self.device) for _ in reals]
        with self._precision():
            gaps = self.backend.discriminator_gradients(
                [d for d in self.discriminators if isinstance(d, LevelDiscriminator)],
                [real[share] for real in reals],
                cropped,
                [mix[share] for mix in mixes],
                self.config.losses,
                self._style_conditions(styles[share]),
            )
        self._update("discriminator")
        return gaps.mean()

    def _random_step(self, n_frames: int, rng: torch.Generator) -> dict[str, float]:
        """Make a generator step on motions from random noise and unpaired speech (eq. 11)."""
        windows = self._draw("random", n_frames, rng)
        made = self._generate(windows)
        within = self._within(made, n_frames)
        conditions = self._style_conditions(windows.styles)
        given, aims = self._targets_of(windows, n_frames)

        def losses_of(i: int) -> dict[str, Tensor]:
            number = self.first + i
            detail, styles = self.details.get(number), windows.styles[:, number]
            level = LevelMotion(
                self.normaliser.inverse(within[i]),
                n_frames / within[i].shape[-1],
                lambda: self._scores(i, within[i], conditions[i]),
                made[i],
                made[i - 1].detach() if i else windows.coarser,
                aims[i] if aims else None,
                detail and partial(detail, styles=styles),
                partial(self.states[i], state=given[i]) if given else None,
            )
            return random_losses(level, self.kinematics, self.config.losses)

        return self._descend(losses_of)

    def _reconstruction_step(self, n_frames: int, rng: torch.Generator) -> float:
        """Make a generator step on recordings reconstructed from z* and their speech (eq. 15)."""
        windows = self._draw("paired", n_frames, rng)
        is_real = self.config.losses.rec_input == "real"
        made = self._generate(windows, windows.targets if is_real else ())
        errors: dict[int, Tensor] = {}

        def losses_of(i: int) -> dict[str, Tensor]:
            errors[i] = reconstruction(made[i], windows.targets[i])
            return {"reconstruction": self.config.losses.reconstruction * errors[i]}

        self._descend(losses_of)
        return float(torch.stack([errors[i].detach() for i in sorted(errors)]).mean())

    def _descend(self, losses_of: Callable[[int], dict[str, Tensor]]) -> dict[str, float]:
        """Make one generator step on the losses of each level; return {name: sum over levels}.

        No gradient runs from a level into the one below, so levels are computed in parallel.
        """
        self.optimisers["generator"].zero_grad(set_to_none=True)

        def level(i: int) -> dict[str, Tensor]:
            terms = losses_of(i)
            if terms:
                # The discriminator needs no gradients here.
                weights = list(self.generators[i].parameters())
                torch.stack(list(terms.values())).sum().backward(inputs=weights)
            return {name: value.detach() for name, value in terms.items()}

        sums: dict[str, float] = {}
        for terms in self.backend.run_tasks(*(partial(level, i) for i in range(len(self.indices)))):
            for name, value in terms.items():
                sums[name] = sums.get(name, 0.0) + float(value)
        if sums:
            self._update("generator")
        return sums

    def _update(self, name: str) -> None:
        """Average gradients over processes, and step an optimiser."""
        optimiser = self.optimisers[name]
        parameters = [p for group in optimiser.param_groups for p in group["params"]]
        self.processes.average_gradients(parameters, self.weight)
        optimiser.step()

    def _draw(self, kind: str, n_frames: int, rng: torch.Generator) -> Windows:
        """Return this process's share of a batch of windows."""
        windows, chosen = self.batches.windows(kind, n_frames, rng)
        return windows.take(chosen[0, self.share])

    def _precision(self) -> torch.autocast:
        """Return the autocast context of networks; losses and sums over time stay in float32."""
        half = self.config.precision == "bfloat16"
        return torch.autocast(self.device.type, torch.bfloat16, enabled=half)

    def _generate(self, windows: Windows, recorded: Sequence[Tensor] = ()) -> list[Tensor]:
        """Return the output (B, D, T_i) of each level; see `MultiresGenerator.forward`."""
        with self._precision():
            made = self.network(
                windows.noise,
                windows.conditions,
                first=self.first,
                coarser=windows.coarser,
                recorded=recorded,
                lengths=[level.shape[-1] for level in windows.conditions],
                convolve=self.backend.convolve,
            )
        return [level.float() for level in made]

    def _within(self, made: Sequence[Tensor], n_frames: int) -> list[Tensor]:
        """Return the generated levels (B, D, T_i) without margins."""
        lengths = self.config.network.lengths(n_frames)
        kept = []
        for level, i in zip(made, self.indices, strict=True):
            start = (level.shape[-1] - lengths[i]) // 2
            kept.append(level[..., start : start + lengths[i]].contiguous())
        return kept

    def _targets_of(self, windows: Windows, n_frames: int) -> tuple[list[Tensor], list[Tensor]]:
        """Return what each level was given of the state (B, C, T_i), and the predicted arm movement
        (B, 2, T_i); empty without such targets."""
        given, aims = list[Tensor](), list[Tensor]()
        if self.states:
            channels = self.states[0].channels
            rows = slice(-channels.width, len(channels.names) - channels.width)
            given = self._within([level[:, rows] for level in windows.conditions], n_frames)
        if self.arms:
            pairs = zip(self.arms, windows.speech, strict=True)
            aims = self._within([target(speech) for target, speech in pairs], n_frames)
        return given, aims

    def _style_conditions(self, styles: Tensor) -> list[Tensor | None]:
        """Return each discriminator's style condition (B, K) from the levels' styles (B, L)."""
        n = self.n_styles
        return [agreed_style(styles, n, i) if n else None for i in self.indices]

    def _scores(self, i: int, motion: Tensor, style: Tensor | None) -> Tensor:
        """Return the (B,) scores of generated motions, without gradients for the discriminator."""
        discriminator = self.discriminators[i]
        discriminator.requires_grad_(False)
        with self._precision():
            scores = discriminator(motion, style, self.backend.convolve)
        discriminator.requires_grad_(True)
        return scores


def _random_crop(motion: Tensor, n_frames: int, rng: torch.Generator) -> Tensor:
    """Return `n_frames` consecutive frames of a motion (B, D, T) that has at least as many."""
    slack = motion.shape[-1] - n_frames
    start = int(torch.randint(slack + 1, (), generator=rng)) if slack else 0
    return motion[..., start : start + n_frames].contiguous()
