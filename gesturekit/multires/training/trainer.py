"""Training of a multires model, stage by stage: two levels at a time, the coarsest first."""

from __future__ import annotations

import copy
import logging
import math
import time
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import torch

import audio_features as af
from gesturekit.corpus.manifest import Manifest
from gesturekit.errors import ConfigError, GestureKitError
from gesturekit.motion.parts import find_legs, is_upper_body, unidentified
from gesturekit.multires.backend import choose_backend, requested_backend
from gesturekit.multires.config import MultiresConfig
from gesturekit.multires.constraints.constraint import fastest_second
from gesturekit.multires.model import MultiresModel
from gesturekit.multires.network.generator import MultiresGenerator
from gesturekit.multires.retrieval.library import RecordedLibrary
from gesturekit.multires.sampling.trained_model import TrainedNoise, TrainedSequence
from gesturekit.multires.training.ahead import with_ahead, with_live_predictions
from gesturekit.multires.training.batches import usage
from gesturekit.multires.training.data import TrainingData
from gesturekit.multires.training.library import build_library
from gesturekit.multires.training.loading import load_training_data
from gesturekit.multires.training.monitor import Monitor, distance_from_recordings
from gesturekit.multires.training.stage import Stage
from gesturekit.multires.training.state import TrainingState
from gesturekit.multires.training.targets import MOST_WINDOWS
from gesturekit.state.ahead import AheadPrediction
from gesturekit.training.data.sources import describe_recordings, save_sources, unused_labels
from gesturekit.training.data.start_model import widened
from gesturekit.training.recordings import load_recordings, training_items
from gesturekit.training.run.device import prepare_device
from gesturekit.training.run.folder import Run
from gesturekit.training.run.held_out import HeldOutMetrics
from gesturekit.training.run.loop import Loop, last_losses, read_once
from gesturekit.training.run.plan import Estimate, log_arrays, log_plan, quickest
from gesturekit.training.run.processes import Processes
from gesturekit.training.run.session import session
from gesturekit.training.run_config import LEGLESS, UNIDENTIFIED
from gesturekit.training.seeds import seeded
from gesturekit.wording import counted, roughly

log = logging.getLogger(__name__)


def train(config: MultiresConfig, *, resume: bool = False) -> Path:
    """Train a multires model and write it.

    Under torchrun each process takes its share of every batch, and the first one writes.

    Args:
        config: settings of the run.
        resume: continue from the last checkpoint in `config.out`.

    Returns:
        The model folder, `config.out / "model"`.

    Raises:
        ConfigError: `config.out` holds a run already (or none to resume), or no such device.
        CorpusError: the corpus cannot be trained on.
        ModelError: the loss or a weight became NaN or infinite.
    """
    with session(config, resume=resume) as (run, device, processes):
        return Trainer(config, run, device, processes, resume=resume).run()


def plan_training(config: MultiresConfig) -> None:
    """Log the plan of `train` and its estimated duration; see `training.run.plan`."""
    device = str(prepare_device(config.device, config.threads))
    log_plan(
        config,
        partial(load_training_data, config, device, trial=True),
        partial(
            load_recordings,
            config,
            config.parts,
            speech=config.features is not None,
            styles=config.styles is not None,
            trial=True,
        ),
        Trainer,
    )


def make_arrays(config: MultiresConfig) -> None:
    """Make the arrays of a corpus that is not held in memory; see `gesturekit.systems`."""
    data = load_training_data(config, str(prepare_device(config.device, config.threads)))
    log_arrays(config, data.stored is not None)


class Trainer:
    """A training run: its data, its network and its stages, one after another."""

    def __init__(
        self,
        config: MultiresConfig,
        run: Run,
        device: torch.device,
        processes: Processes,
        *,
        resume: bool,
        trial: bool = False,
    ) -> None:
        self.folder = run
        self.processes = processes
        windows = config.training.windows_per_step
        if windows < processes.count:
            raise ConfigError(
                f"training.batch: {windows} window(s) a step cannot be shared by "
                f"{processes.count} processes (whole sequences go one at a time)"
            )
        requested_backend(config.backend)  # refused here, before the run folder is made
        self.ahead: tuple[AheadPrediction, ...] | None = None
        self.data = read_once(
            run,
            processes,
            resume=resume,
            read=lambda: load_training_data(config, str(device), trial=trial),
            load=lambda folder: TrainingData.load(folder, config, str(device)),
        )
        self.config = config = self._adapted(config)
        if self.data.unpaired_is_paired and processes.is_first:
            log.warning("The corpus has no unpaired speech: random steps take the paired speech.")
        self._warn_of_short_clips()
        self.seconds = sum(source.duration for source in self.data.sources)
        self.held_out = HeldOutMetrics(
            config, run, speech=self.data.conditioner is not None, styles=self.data.styles
        )
        self.loop = Loop(config, run, processes, self.held_out)
        levels, steps = config.network.levels, sum(count for _, count in self.stages())
        self.unused = unused_labels(self.data.sources, self.data.styles, state=config.state)
        kind = ["multires", self._mode(), f"{levels} levels"]
        self.loop.announce(kind, steps, self._contents(), self.unused)
        self.network = seeded(
            (config.seed, "generator"),
            lambda: MultiresGenerator(
                self.data.representation,
                self.data.conditions(config).width,
                config.network,
            ),
        )
        if self.data.start:
            weights = widened(
                self.data.start, self.network, lambda name: name.endswith("embed.weight")
            )
            self.network.load_state_dict(weights)
        self.network.to(device)
        watched = config.eval_every and processes.is_first
        convolve = choose_backend(config.backend, self.network).convolve
        self.monitor = Monitor(self.data, config, convolve, self.state) if watched else None

    @cached_property
    def library(self) -> RecordedLibrary | None:
        """Return the recorded motion that the model plays; None without."""
        return build_library(self.data, self.config, self.state)

    @cached_property
    def state(self) -> TrainingState | None:
        """Return the state of movement of the recordings; None for a model without it."""
        return TrainingState(self.data, self.config) if self.config.state else None

    def _adapted(self, config: MultiresConfig) -> MultiresConfig:
        """Return the settings without losses on body parts that the rig lacks; log them."""
        skeleton = self.data.representation.skeleton
        missing = unidentified(skeleton)
        if is_upper_body(skeleton):
            if self.processes.is_first:
                log.info(LEGLESS)
            return replace(config, losses=replace(config.losses, contact=0.0))
        if not missing:
            return config
        off: dict[str, Any] = {"arm_speed": 0.0, "arm_acceleration": 0.0}
        follows = []
        if config.uses_arm_speed:
            follows.append("no losses on the arms")
        if find_legs(skeleton) is None:
            off["contact"] = 0.0
            follows += ["no contact labels or loss", "recordings keep their heading"]
        if config.joints == "body":
            follows.append("all joints are modelled")
        if follows and self.processes.is_first:
            log.info(UNIDENTIFIED, missing.capitalize(), ", ".join(follows))
        return replace(config, losses=replace(config.losses, **off))

    def _warn_of_short_clips(self) -> None:
        """Warn about clips that are shorter at level 1 than the patches of the discriminator."""
        network, lengths = self.config.network, [clip.shape[-1] for clip in self.data.unpaired]
        least = network.n_frames_of_patch
        short = [n for n in lengths if af.level_lengths(n, network.levels)[0] < least]
        if self.data.own_lengths and short and self.processes.is_first:
            log.warning(
                "%d of %d clips of unpaired speech have fewer than the %d frames of a "
                "discriminator's patch at level 1, which sees them reflected: of %d levels, clips "
                "of %.1f s or more have enough.",
                *(len(short), len(lengths), least, network.levels),
                math.ceil((least - 0.5) * (4 / 3) ** (network.levels - 1)) / self.config.fps,
            )

    def _contents(self) -> list[str]:
        """Return descriptions of the training data."""
        data = self.data
        parts = [describe_recordings(data.sources, self.seconds, self.config.fps)]
        if data.conditioner is not None:
            if not data.unpaired_is_paired:
                parts.append(f"{roughly(data.spoken[0])} of unpaired speech")
            parts.append(counted(data.conditioner.dim, "speech feature"))
        if data.styles:
            parts.append(counted(len(data.styles), "style"))
        representation = data.representation
        joints = counted(representation.skeleton.n_joints, "joint")
        return [*parts, f"{len(representation.joints)} of {joints} modelled"]

    def _mode(self) -> str:
        """Return the model's inputs in words."""
        given = ["speech"] * bool(self.data.conditioner) + ["labels"] * bool(self.data.styles)
        return f"{' and '.join(given)} mode" if given else "no condition"

    def estimate(self) -> Estimate:
        """Estimate the cost of the training from a few iterations of each stage.

        They change the networks: for a run that is not kept.
        """
        data, config = self.data, self.config
        whole = self.seconds * config.fps
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
        if data.conditioner is not None:
            speech = 4 * config.fps * (data.conditioner.extractor.dim + 1)
        motion = data.representation.n_features + data.paired[0].passive.shape[0]
        rates = (4 * config.fps * motion + speech, speech)
        return Estimate(seconds, self.held_out.seconds, rates)

    def _usage(self) -> str:
        """Return how much of the recordings is drawn."""
        shortest = min(iterations for _, iterations in self.stages())
        return usage(self.config.training, shortest, self.seconds, len(self.data.sources))

    def stages(self) -> list[tuple[int, int]]:
        """Return (first level, iterations) of each stage."""
        training, levels = self.config.training, self.config.network.levels
        first = self.config.lengthened(training.first_stage)
        further = self.config.lengthened(training.further_stages)
        return [(level, further if level else first) for level in range(0, levels, 2)]

    def stage(self, first: int, iterations: int) -> Stage:
        """Return the stage that begins with this level, its networks untrained."""
        return Stage(
            self.config,
            self.data,
            self.network,
            self.processes,
            first,
            iterations,
            self.state,
        )

    def run(self) -> Path:
        """Train all stages, or those that are left, and write the model."""
        done, state = self.loop.resume()
        if state is not None:
            self.network.load_state_dict(state["generator"])
        stages, levels = self.stages(), self.config.network.levels
        # Part of an iteration's cost grows with its number of frames.
        costs = [20 + 100 * 0.75 ** (levels - 2 - first) for first, _ in stages]
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
        return self._finish(end)

    def measure(self, step: int, levels: int) -> str:
        """Log and return the verdict on held-out recordings, at the finest level so far."""
        whole = levels == self.config.network.levels
        return self.held_out.measure(
            step,
            self._model(copy.deepcopy(self.network)),
            "" if whole else f", levels 1-{levels} of {self.config.network.levels}",
            keep=False,
            **({} if whole else {"levels": levels}),
        )

    def evaluate(self, step: int, first: int, levels: int) -> None:
        """Log cheap metrics, write a sample, and keep the best model of the last stage."""
        monitor = self.monitor
        if monitor is None:
            return
        metrics = monitor.metrics(self.network, levels)
        monitor.warn_of_collapse(metrics, step)
        monitor.write_sample(self.folder.folder / "samples", step)
        if levels == self.config.network.levels:
            # Models of earlier stages lack the finest levels.
            before = self.folder.evaluations(level=first + 1)
            distance = distance_from_recordings(metrics)
            if all(distance < distance_from_recordings(other) for other in before):
                self._save(
                    "best",
                    self._calibrated(self._model(copy.deepcopy(self.network))),
                    {"Training steps": f"{step}, the best by the cheap evaluations"},
                )
        self.folder.log(step, metrics, level=first + 1, kind="evaluation")

    def _finish(self, steps: int) -> Path:
        """Measure and write the model."""
        if self.processes.is_first:
            model = self._calibrated(self._model(self.network))
            measured = self.held_out.measure(steps, model, "", keep=True)
            self._save(
                "model",
                model,
                {
                    "Training steps": str(steps),
                    "Last losses": last_losses(self.folder),
                    **({"Measured": measured} if measured else {}),
                },
            )
        self.processes.wait()
        return self.folder.folder / "model"

    def _calibrated(self, model: MultiresModel) -> MultiresModel:
        """Return a model with a state of movement that its network shows as it is drawn."""
        if self.state is None or self.config.retrieval:
            return model
        return replace(model, state_process=self.state.calibrated(model))

    def _save(self, name: str, model: MultiresModel, notes: dict[str, str]) -> None:
        """Write a model of the run."""
        spoken, files = self.data.spoken
        if model.state_process is not None:
            if self.ahead is None:
                self.ahead = self._live_predictions(model)
            model = with_ahead(model, self.ahead)
        model.save(
            self.folder.folder / name,
            notes={
                "Recordings": describe_recordings(self.data.sources, self.seconds, self.config.fps),
                "Unpaired speech": f"{roughly(spoken)} in {counted(files, 'file')}"
                if files
                else "none",
                **({"Not used": "; ".join(self.unused)} if self.unused else {}),
                "Use of the recordings": self._usage(),
                "Began with": self.config.began_with,
                **notes,
                **{str(key): str(value) for key, value in self.config.notes.items()},
            },
        )
        save_sources(self.folder.folder / name, self.data.sources)

    def _live_predictions(self, model: MultiresModel) -> tuple[AheadPrediction, ...]:
        """Return the predictions for live speech; none for a model that cannot stream."""
        corpus = self.config.corpus
        try:
            items = training_items(Manifest.load(corpus), corpus, with_audio=True)
            return with_live_predictions(model, items).ahead
        except (GestureKitError, af.AudioFeaturesError) as error:
            # A trained model is worth more than its use for live speech.
            log.warning("The model cannot stream, without predictions for live speech: %s", error)
            return ()

    def _model(self, network: MultiresGenerator) -> MultiresModel:
        """Return the model of a network, which is moved to the CPU."""
        root_xz = self.data.representation.layout.root_xz
        # With a state of movement, a recording is made of its state, which is not kept.
        reconstructed = self.data.sample if self.state is None else ()
        return MultiresModel(
            fps=self.config.fps,
            representation=self.data.representation,
            normaliser=self.data.normaliser,
            conditions=self.data.conditions(self.config),
            library=self.library,
            state_process=None if self.state is None else self.state.process,
            network_config=self.config.network,
            network=network.cpu().eval(),
            noise=TrainedNoise(
                sigma=torch.stack([sequence.sigma for sequence in self.data.sample]),
                z_star={sequence.name: sequence.z_star for sequence in reconstructed},
                sequences={
                    sequence.name: TrainedSequence(
                        sequence.n_frames,
                        self.data.styles[sequence.style] if self.data.styles else None,
                    )
                    for sequence in reconstructed
                },
                z_star_shuffle=self.config.z_star_shuffle,
                noise_levels=self.config.noise_levels,
            ),
            speakers=self.data.speakers,
            fastest=self.data.representation.scale
            * max(
                fastest_second(
                    self.data.normaliser.to_values(sequence.motion[:, :][None])[:, root_xz],
                    self.config.fps,
                )
                for sequence in self.data.sample
            ),
            smooth=self.config.smooth,
            recorded_fps=self.data.recorded_fps,
        )
