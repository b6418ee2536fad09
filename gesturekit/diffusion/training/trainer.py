"""Training of the denoiser."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import logging
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from gesturekit.diffusion.config import DiffusionConfig, TrainingConfig
from gesturekit.diffusion.losses import (
    FootVelocity,
    StateDistance,
    change_error,
    denoising_error,
    foot_sliding,
)
from gesturekit.diffusion.model import DiffusionModel
from gesturekit.diffusion.network.denoiser import Denoiser
from gesturekit.diffusion.noise_schedule import NoiseSchedule
from gesturekit.diffusion.training.batches import Batches, TrainingBatch
from gesturekit.diffusion.training.corpus import read_recordings
from gesturekit.diffusion.training.data import TrainingData
from gesturekit.diffusion.training.loading import load_training_data
from gesturekit.diffusion.training.quick import STEPS, quick_vectors
from gesturekit.diffusion.training.state import calibrated
from gesturekit.errors import MotionError
from gesturekit.evaluation.measuring.clip_metrics import quick_metrics
from gesturekit.motion.mirroring import can_be_mirrored
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import unidentified
from gesturekit.motion.torch_kinematics import foot_kinematics
from gesturekit.training.data.sources import describe_recordings, save_sources, unused_labels
from gesturekit.training.data.start_model import widened
from gesturekit.training.run.device import prepare_device
from gesturekit.training.run.folder import Run
from gesturekit.training.run.held_out import HeldOutMetrics
from gesturekit.training.run.loop import Loop, last_losses, read_once
from gesturekit.training.run.plan import Estimate, log_arrays, log_plan, quickest
from gesturekit.training.run.processes import Processes
from gesturekit.training.run.session import session
from gesturekit.training.run_config import UNIDENTIFIED
from gesturekit.training.seeds import rng_for, seeded
from gesturekit.wording import counted, drawn, roughly

log = logging.getLogger(__name__)

MOST_CLIPS = 4
MOST_SECONDS = 20.0
"""Number of training recordings whose conditions are used, and length of each."""


def train(config: DiffusionConfig, *, resume: bool = False) -> Path:
    """Train a diffusion model and save it.

    Args:
        config: settings of the run.
        resume: continue from the last checkpoint in `config.out`.

    Returns:
        The model folder, `config.out / "model"`.

    Raises:
        ConfigError: `config.out` holds a run already (or none to resume), or no such device.
        CorpusError: the corpus cannot be trained on.
        ModelError: the loss or the weights became NaN or infinite.
    """
    with session(config, resume=resume) as (run, device, processes):
        return Trainer(config, run, device, processes, resume=resume).run()


def plan_training(config: DiffusionConfig) -> None:
    """Log the plan of `train` and its estimated duration; see `training.run.plan`."""
    device = str(prepare_device(config.device, config.threads))
    log_plan(
        config,
        partial(load_training_data, config, device, trial=True),
        partial(read_recordings, config, speech=config.features is not None, trial=True),
        Trainer,
    )


def make_arrays(config: DiffusionConfig) -> None:
    """Make the arrays of a corpus that is not held in memory; see `gesturekit.systems`."""
    data = load_training_data(config, str(prepare_device(config.device, config.threads)))
    log_arrays(config, data.stored is not None)


def learning_rate(training: TrainingConfig, update: int) -> float:
    """Return the learning rate of an update, counted from 0 (appendix A.1).

    As in the released code, it reaches its peak at the last update of the warm-up, and is then
    multiplied by `decay` at every update whose number is a multiple of ten.
    """
    last_of_warm_up = max(training.warm_up, 1) - 1
    warm = min(1.0, (update + 1) / (last_of_warm_up + 1))
    decays = max(0, update // 10 - last_of_warm_up // 10)
    return training.learning_rate * warm * training.decay**decays


class Trainer:
    """A training run: its data, its network and its updates."""

    def __init__(
        self,
        config: DiffusionConfig,
        run: Run,
        device: torch.device,
        processes: Processes,
        *,
        resume: bool,
        trial: bool = False,
    ) -> None:
        self.config = config
        self.folder = run
        self.device = device
        self.processes = processes
        self.data = read_once(
            run,
            processes,
            resume=resume,
            read=lambda: load_training_data(config, str(device), trial=trial),
            load=lambda folder: TrainingData.load(folder, config, str(device)),
        )
        self.schedule = NoiseSchedule.of(config.noise)
        self.batches = Batches(self.data, config)
        self.changes = self.data.changes().to(device) if config.training.changes else None
        self.foot_velocity = self._foot_velocity()
        self.state_distance = self._state_distance()
        self.held_out = HeldOutMetrics(
            config,
            run,
            speech=self.data.conditions.conditioner is not None,
            styles=self.data.conditions.styles,
        )
        self.loop = Loop(config, run, processes, self.held_out)
        if processes.is_first:
            self._log_missing_parts()
        self.unused = unused_labels(self.data.sources, self.data.conditions.styles)
        kind = ["diffusion", self._mode()]
        self.loop.announce(kind, config.updates, self._contents(), self.unused)
        self.network = self._network().to(device)
        # The weights of the final model.
        self.average = copy.deepcopy(self.network).eval() if config.training.ema else self.network
        self.optimiser = torch.optim.Adam(self.network.parameters())
        watched = config.eval_every and processes.is_first
        self.monitor = Monitor(self.data, config) if watched else None

    def _foot_velocity(self) -> FootVelocity | None:
        """Return the input of the loss on foot sliding; None without that loss or without legs."""
        if not self.config.training.foot_sliding:
            return None
        representation = self.data.representation
        feet = foot_kinematics(representation)
        if feet is None:
            return None
        normaliser, fps = self.data.normaliser, self.config.fps
        return FootVelocity(representation, normaliser, feet, fps).to(self.device)

    def _state_distance(self) -> StateDistance | None:
        """Return the loss on the state of movement; None without it."""
        process = self.data.state_process
        if process is None or not self.config.training.state:
            return None
        representation, normaliser = self.data.representation, self.data.normaliser
        return StateDistance(representation, normaliser, process).to(self.device)

    def _log_missing_parts(self) -> None:
        """Log in one line the features that training lacks if body parts cannot be identified."""
        skeleton = self.data.representation.skeleton
        follows = []
        if self.config.augmentation.mirror and not can_be_mirrored(skeleton):
            follows.append("no mirrored recordings")
        if self.config.training.foot_sliding and self.foot_velocity is None:
            follows.append("no loss on foot sliding")
        if self.config.joints == "body":
            follows.append("all joints are modelled")
        missing = unidentified(skeleton)
        if missing and follows:
            log.info(UNIDENTIFIED, missing.capitalize(), ", ".join(follows))

    def _network(self) -> Denoiser:
        width = self.data.representation.n_features
        network = seeded(
            (self.config.seed, "denoiser"),
            lambda: Denoiser(width, self.data.conditions.width, self.config.network),
        )
        if self.data.start:
            weights = widened(
                self.data.start, network, lambda name: name.startswith("project_condition.")
            )
            network.load_state_dict(weights)
        return network

    def _contents(self) -> list[str]:
        """Return a description of the training data for the log."""
        data, conditions = self.data, self.data.conditions
        parts = [describe_recordings(data.sources, data.seconds[0], self.config.fps)]
        if data.seconds[1]:
            parts.append(f"{roughly(data.seconds[1])} of unpaired motion")
        variants = len(data.recordings)
        if variants > len(data.sources):
            parts.append(f"{counted(variants, 'sequence')} with their variants")
        if conditions.conditioner is not None:
            parts.append(counted(conditions.conditioner.dim, "speech feature"))
        for known, noun in ((conditions.events, "event"), (conditions.styles, "style")):
            if known:
                parts.append(counted(len(known), noun))
        representation = data.representation
        joints = counted(representation.skeleton.n_joints, "joint")
        return [*parts, f"{len(representation.joints)} of {joints} modelled"]

    def _mode(self) -> str:
        """Return the model's inputs in words."""
        conditions = self.data.conditions
        given = {
            "speech": conditions.conditioner,
            "path": conditions.path,
            "events": conditions.events,
            "styles": conditions.styles,
            "the state of movement": conditions.state,
        }
        names = [name for name, known in given.items() if known]
        return f"from {' and '.join(names)}" if names else "no condition"

    def _usage(self) -> str:
        """Return how often the training draws each second of the recordings, and how much of them
        at all."""
        training, (paired, _) = self.config.training, self.data.seconds
        share = self.config.unpaired.share if self.config.unpaired is not None else 0.0
        mean = self.config.updates * training.batch * training.window * (1 - share) / paired
        return f"a second is drawn about {drawn(mean)}"

    def estimate(self) -> Estimate:
        """Estimate the cost of the training from a few updates.

        They change the networks: for a run that is not kept.
        """
        data = self.data
        update = quickest(lambda: float(self._update(0)), 4)
        conditions, phases = data.conditions, max(1, round(data.recorded_fps / self.config.fps))
        number = 4 * self.config.fps * phases  # bytes a second, float32
        variants = 1 + self.config.augmentation.mirror
        speech = conditions.columns["speech"].stop
        own = number * variants * (data.representation.n_features + conditions.width - speech)
        raw = 0.0
        if conditions.conditioner is not None:
            raw = number * (conditions.conditioner.extractor.dim + 1)
        return Estimate(self.config.updates * update, self.held_out.seconds, (own + raw, own))

    def run(self) -> Path:
        """Train all updates, or those that are left, and write the model."""
        done, state = self.loop.resume()
        if state is not None:
            self._load_state(state)
        training, updates = self.config.training, self.config.updates
        with self.loop.progress([(updates, 1.0)], done):
            for step in self.loop.begin(range(done + 1, updates + 1)):
                rate = learning_rate(training, step - 1)
                loss = self._update(step - 1)
                due = self.loop.count(step, {"loss": loss}, learning_rate=rate)
                if due.evaluation:
                    self._evaluate(step)
                if due.measurement:
                    self._measure(step)
                if due.checkpoint:
                    self.loop.save(step, self.network.parameters(), self._state())
        if self.processes.is_first:
            self._finish()
        self.processes.wait()
        return self.folder.folder / "model"

    def _update(self, update: int) -> Tensor:
        """Do one update on this process's share of the batch, and return the loss."""
        training = self.config.training
        rows = self.processes.share(training.batch)
        share = (rows.stop - rows.start) / training.batch
        for group in self.optimiser.param_groups:
            group["lr"] = learning_rate(training, update)
        self.network.train()
        # Dropout uses torch's global generator of the device.
        torch.manual_seed(
            rng_for(self.config.seed, "dropout", update, self.processes.rank).initial_seed()
        )
        self.optimiser.zero_grad(set_to_none=True)
        loss = self._loss(self.batches.draw(update, rows).to(self.device))
        loss.backward()
        parameters = list(self.network.parameters())
        self.processes.average_gradients(parameters, share)
        if training.clip:
            nn.utils.clip_grad_norm_(parameters, training.clip)
        self.optimiser.step()
        if training.ema:
            self._average(update)
        return loss.detach()

    def _loss(self, batch: TrainingBatch) -> Tensor:
        """Return the squared error of the prediction (eq. 4), weighted by each clip's step."""
        noisy = self.schedule.add_noise(batch.clean, batch.noise, batch.step)
        target = self.schedule.target(batch.clean, batch.noise, batch.step)
        half = self.config.training.precision == "bfloat16"
        precise = torch.autocast(self.device.type, torch.bfloat16) if half else None
        with precise or contextlib.nullcontext():
            predicted = self.network(noisy, batch.condition, batch.step)
        predicted = predicted.float()
        errors = denoising_error(predicted, target)
        weight = self.config.training.changes
        if self.changes is not None:
            errors = errors + weight * change_error(predicted, target, self.changes)
        if self.foot_velocity is not None:
            velocities = self.foot_velocity(predicted), self.foot_velocity(target)
            errors = errors + self.config.training.foot_sliding * foot_sliding(*velocities)
        if self.state_distance is not None:
            share = self.schedule.alphas_bar.float().to(self.device)[batch.step]
            distance = self.state_distance(predicted, target)
            errors = errors + self.config.training.state * share * distance
        weights = self.schedule.loss_weight(batch.step, self.config.training.min_snr)
        return (weights * errors).mean()

    @torch.no_grad()
    def _average(self, update: int) -> None:
        # A lower decay at first, so that the initial weights are forgotten soon.
        kept = min(self.config.training.ema, (1 + update) / (10 + update))
        own = self.network.state_dict()
        for name, value in self.average.state_dict().items():
            value.lerp_(own[name], 1 - kept)

    def _state(self) -> dict[str, Any]:
        state = {
            "network": self.network.state_dict(),
            "optimiser": self.optimiser.state_dict(),
        }
        if self.config.training.ema:
            state["average"] = self.average.state_dict()
        return state

    def _load_state(self, state: dict[str, Any]) -> None:
        self.network.load_state_dict(state["network"])
        self.optimiser.load_state_dict(state["optimiser"])
        if self.config.training.ema:
            self.average.load_state_dict(state["average"])

    def _evaluate(self, step: int) -> None:
        """Log cheap metrics."""
        metrics = {} if self.monitor is None else self.monitor.metrics(self.average.eval())
        if metrics:
            self.folder.log(step, metrics, kind="evaluation")

    def _measure(self, step: int) -> str:
        """Log and return the verdict on held-out recordings, generated in a few steps."""
        steps = min(STEPS, self.schedule.steps)
        return self.held_out.measure(step, self._model(copy.deepcopy(self.average)), steps=steps)

    def _model(self, network: Denoiser) -> DiffusionModel:
        """Return the model with this network."""
        training = self.config.training
        # Unpaired motion has no conditions but the state, just like windows with condition dropout.
        unconditional = training.dropout_condition or self.data.seconds[1]
        droppable = {
            "all": unconditional,
            "styles": training.dropout_style,
            "state": training.dropout_state,
        }
        return DiffusionModel(
            fps=self.config.fps,
            representation=self.data.representation,
            conditions=self.data.conditions,
            normaliser=self.data.normaliser,
            noise_config=self.config.noise,
            network=network,
            speakers=self.data.speakers,
            state_process=self.data.state_process,
            droppable=tuple(name for name, share in droppable.items() if share),
            clip_denoised=self.config.clip_denoised,
            smooth=self.config.smooth,
            recorded_fps=self.data.recorded_fps,
        )

    def _finish(self) -> None:
        updates = self.config.updates
        model = self._model(self.average)
        process = calibrated(model, self.data, self.config.seed)
        model = dataclasses.replace(model, state_process=process)
        measured = self.held_out.measure(updates, model, keep=True)
        model.network.cpu()
        paired, unpaired = self.data.seconds
        model.save(
            self.folder.folder / "model",
            notes={
                "Recordings": describe_recordings(self.data.sources, paired, self.config.fps),
                "Unpaired motion": f"{unpaired:.0f} s" if unpaired else "none",
                **({"Not used": "; ".join(self.unused)} if self.unused else {}),
                "Use of the recordings": self._usage(),
                "Began with": self.config.began_with,
                "Training steps": str(updates),
                "Last losses": last_losses(self.folder),
                **({"Measured": measured} if measured else {}),
                **{str(key): str(value) for key, value in self.config.notes.items()},
            },
        )
        save_sources(self.folder.folder / "model", self.data.sources)


class Monitor:
    """Metrics of motion generated from the training recordings' conditions.

    It draws from its own random generator, so that training gives the same weights with and without
    it.
    """

    def __init__(self, data: TrainingData, config: DiffusionConfig) -> None:
        self.data = data
        self.config = config
        self.schedule = NoiseSchedule.of(config.noise)
        most = round(MOST_SECONDS * config.fps)
        paired = [recording for recording in data.recordings if recording.is_paired]
        self.clips = [recording.condition[:most] for recording in paired[:MOST_CLIPS]]
        self.recordings = [
            data.decode(recording.motion[:most], condition, config.fps)
            for recording, condition in zip(paired, self.clips, strict=False)
        ]

    def metrics(self, network: Denoiser) -> dict[str, float]:
        """Return cheap metrics (`quick_metrics`) of motion generated from the same noise each time.

        Return nothing while the network does not generate valid motion.
        """
        try:
            return quick_metrics(list(self._generated(network)), self.recordings)
        except MotionError:
            return {}

    @torch.no_grad()
    def _generated(self, network: Denoiser) -> Iterator[Motion]:
        for number, condition in enumerate(self.clips):
            rng = rng_for(self.config.seed, "monitor", number)
            made = quick_vectors(network, self.schedule, condition, rng)
            values = self.data.normaliser.inverse(made.cpu()).double().numpy()
            yield self.data.decode(values, condition, self.config.fps)
