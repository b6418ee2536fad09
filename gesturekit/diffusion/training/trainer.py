"""Training of the denoiser: data, updates, checkpoints, and motion on held-out recordings."""

from __future__ import annotations

import copy
import logging
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from gesturekit.diffusion.config import DiffusionConfig, TrainingConfig
from gesturekit.diffusion.experts import Expert
from gesturekit.diffusion.losses import (
    change_error,
    denoising_error,
    foot_sliding,
    foot_velocity,
    state_distance,
)
from gesturekit.diffusion.model import DiffusionModel
from gesturekit.diffusion.motion_vector import VectorPlaces, measured_state
from gesturekit.diffusion.network import Denoiser
from gesturekit.diffusion.noise_schedule import NoiseSchedule, sample
from gesturekit.diffusion.training.batches import Batches, TrainingBatch
from gesturekit.diffusion.training.data import TrainingData
from gesturekit.diffusion.training.loading import load_training_data, read_recordings
from gesturekit.errors import MotionError
from gesturekit.evaluation.measuring.clip_metrics import quick_metrics
from gesturekit.motion.motion import Motion, can_be_mirrored
from gesturekit.motion.parts import unidentified
from gesturekit.motion.torch_kinematics import foot_kinematics
from gesturekit.postprocess import smooth_motion
from gesturekit.state.process import StateProcess
from gesturekit.training.origin import widened
from gesturekit.training.run_config import UNIDENTIFIED
from gesturekit.training.seeds import rng_for, seeded
from gesturekit.training.trainer import BaseTrainer, Estimate, quickest, run_training
from gesturekit.wording import counted, drawn, roughly

log = logging.getLogger(__name__)

STEPS = 10
"""Number of denoising steps of measurements during training."""
MOST_CLIPS, MOST_SECONDS = 4, 20.0
"""Training recordings whose conditions evaluation uses, and the greatest length of each."""
CALIBRATING_CLIPS, CALIBRATING_SECONDS = 8, 60.0
"""Recordings and variants of them that calibrate the state, and their greatest length."""


def train(config: DiffusionConfig, *, resume: bool = False) -> Path:
    """Train a diffusion model and write it; see `run_training`."""
    return run_training(Trainer, config, resume=resume)


def learning_rate(training: TrainingConfig, update: int) -> float:
    """Return the learning rate of an update, counted from 0 (appendix A.1).

    As in the released code, it reaches its peak at the last update of the warm-up, and is then
    multiplied by `decay` at every update whose number is a multiple of ten.
    """
    last_of_warm_up = max(training.warm_up, 1) - 1
    warm = min(1.0, (update + 1) / (last_of_warm_up + 1))
    decays = max(0, update // 10 - last_of_warm_up // 10)
    return training.learning_rate * warm * training.decay**decays


class Trainer(BaseTrainer):
    """A training run: its data, its network and its updates."""

    config: DiffusionConfig
    data: TrainingData
    read_data = staticmethod(load_training_data)
    load_data = staticmethod(TrainingData.load)
    read_recordings = staticmethod(partial(read_recordings, trial=True))

    def set_up(self) -> None:
        """Announce the training, and make its network."""
        config, device, data = self.config, self.device, self.data
        self.schedule = NoiseSchedule.of(config.noise)
        self.batches = Batches(data, config)
        self.normaliser = data.normaliser.to(device)
        self.changes = data.changes().to(device) if config.training.changes else None
        self.foot_places = self.state_places = None
        feet = foot_kinematics(data.representation) if config.training.foot_sliding else None
        if feet is not None:
            self.foot_places = VectorPlaces(data.representation, feet).to(device)
        if config.training.state:
            self.state_places = VectorPlaces(data.representation).to(device)
        self._log_missing_parts()
        inputs = [name for name, c in data.conditions.columns.items() if c.stop > c.start]
        mode = f"from {' and '.join(inputs)}" if inputs else "no condition"
        self.announce(["diffusion", mode], self._contents(), config.updates)
        self.network = self._network().to(device)
        # The weights of the final model.
        self.average = copy.deepcopy(self.network).eval() if config.training.ema else self.network
        self.optimiser = torch.optim.Adam(self.network.parameters())

    def _network(self) -> Denoiser:
        width, conditions = self.data.representation.n_features, self.data.conditions
        make = partial(Denoiser, width, conditions.width, self.config.network)
        network = seeded((self.config.seed, "denoiser"), make)
        if start := self.data.start:
            inputs = ("project_condition.weight", "project_condition.bias")
            network.load_state_dict(widened(start, network, inputs.__contains__))
        return network

    def run(self) -> None:
        """Train all updates, or those that are left, and write the model."""
        stored: dict[str, Any] = {"network": self.network, "optimiser": self.optimiser}
        if self.config.training.ema:
            stored["average"] = self.average
        done, state = self.loop.resume()
        if state is not None:
            for name, trained in stored.items():
                trained.load_state_dict(state[name])
        updates = self.config.updates
        with self.loop.progress([(updates, 1.0)], done):
            for step in self.loop.begin(range(done + 1, updates + 1)):
                loss = self._update(step - 1)
                rate = self.optimiser.param_groups[0]["lr"]
                due = self.loop.count(step, {"loss": loss}, learning_rate=rate)
                if due.evaluation:
                    self._evaluate(step)
                if due.measurement:
                    model = self._model(copy.deepcopy(self.average), self.data.state_process)
                    self.held_out.measure(step, model, steps=min(STEPS, self.schedule.steps))
                if due.checkpoint:
                    state = {name: trained.state_dict() for name, trained in stored.items()}
                    self.loop.save(step, self.network.parameters(), state)
        if self.processes.is_first:
            self.finish(updates, self._model(self.average, self._calibrated()))

    def _update(self, update: int) -> Tensor:
        """Do one update on this process's share of the batch, and return the loss."""
        training = self.config.training
        rows = self.processes.share(training.batch)
        for group in self.optimiser.param_groups:
            group["lr"] = learning_rate(training, update)
        self.network.train()
        # Dropout uses torch's global generator of the device.
        rng = rng_for(self.config.seed, "dropout", update, self.processes.rank)
        torch.manual_seed(rng.initial_seed())
        self.optimiser.zero_grad(set_to_none=True)
        loss = self._loss(self.batches.draw(update, rows).to(self.device))
        loss.backward()
        parameters = list(self.network.parameters())
        share = (rows.stop - rows.start) / training.batch
        self.processes.average_gradients(parameters, share)
        if training.clip:
            nn.utils.clip_grad_norm_(parameters, training.clip)
        self.optimiser.step()
        if training.ema:
            # A lower decay at first, so that the initial weights are forgotten soon.
            kept = min(training.ema, (1 + update) / (10 + update))
            weights = self.network.state_dict()
            for name, value in self.average.state_dict().items():
                value.lerp_(weights[name], 1 - kept)
        return loss.detach()

    def _loss(self, batch: TrainingBatch) -> Tensor:
        """Return the squared error of the prediction (eq. 4), weighted by each clip's step."""
        training, inverse = self.config.training, self.normaliser.inverse
        noisy = self.schedule.add_noise(batch.clean, batch.noise, batch.step)
        target = self.schedule.target(batch.clean, batch.noise, batch.step)
        half = training.precision == "bfloat16"
        with torch.autocast(self.device.type, torch.bfloat16, enabled=half):
            predicted = self.network(noisy, batch.condition, batch.step)
        predicted = predicted.float()
        errors = denoising_error(predicted, target)
        if self.changes is not None:
            errors = errors + training.changes * change_error(predicted, target, self.changes)
        fps = self.config.fps
        if (places := self.foot_places) is not None:
            speeds = (foot_velocity(places, inverse(each), fps) for each in (predicted, target))
            errors = errors + training.foot_sliding * foot_sliding(*speeds)
        if (process := self.data.state_process) is not None and self.state_places is not None:
            share = self.schedule.alphas_bar.float().to(self.device)[batch.step]
            motions = inverse(predicted), inverse(target)
            distance = state_distance(self.state_places, process, *motions)
            errors = errors + training.state * share * distance
        return (self.schedule.loss_weight(batch.step, training.min_snr) * errors).mean()

    @torch.no_grad()
    def _generated(self, condition: np.ndarray, rng: torch.Generator) -> Motion:
        """Generate motion for a condition (T, C) in a few steps.

        Its noise has a random generator of its own, so that training gives the same weights with
        and without it.

        Raises:
            MotionError: the network was trained too little to generate valid motion.
        """
        network, schedule = self.average.eval(), self.schedule
        given = torch.from_numpy(condition)[None].to(self.device)
        expert = Expert(network, schedule, given, np.ones(1))
        noise = torch.randn((1, len(condition), network.n_motion), generator=rng).to(self.device)
        steps = min(STEPS, schedule.steps)
        vectors = sample(expert.predict, lambda _: noise, schedule, solver="dpm", steps=steps)
        values = self.data.normaliser.inverse(vectors[0].cpu()).double().numpy()
        return self.data.decode(values, condition, self.config.fps)

    def _evaluate(self, step: int) -> None:
        """Log cheap metrics of motion for the conditions of training recordings.

        Nothing is logged while the network does not generate valid motion.
        """
        most, data, clips = round(MOST_SECONDS * self.config.fps), self.data, []
        try:
            for number, recording in enumerate(data.paired[:MOST_CLIPS]):
                condition = recording.condition[:most]
                rng = rng_for(self.config.seed, "monitor", number)
                recorded = data.decode(recording.motion[:most], condition, self.config.fps)
                clips.append((self._generated(condition, rng), recorded))
            metrics = quick_metrics(*zip(*clips, strict=True))
        except MotionError:
            return
        if metrics:
            self.folder.log(step, metrics, kind="evaluation")

    def _calibrated(self) -> StateProcess | None:
        """Return the process of the state, calibrated for the network; None without a state.

        The model moves, in a few steps, to the speech of recordings with a state that is drawn; see
        `StateProcess.calibrated`.
        """
        config, process = self.config, self.data.state_process
        if process is None:
            return None
        columns, pairs = self.data.conditions.columns, []
        for k, recording in enumerate(self.data.paired[:CALIBRATING_CLIPS]):
            rng = rng_for(config.seed, "calibration", k)
            condition = recording.condition[: round(CALIBRATING_SECONDS * process.fps)].copy()
            styles = condition[0, columns["styles"]]
            style = int(styles.argmax()) if len(styles) else None
            speech = condition[:, columns["speech"]].T
            wanted = process.draw(rng.initial_seed() >> 1, speech, (None, style))
            condition[:, columns["state"]] = process.given(wanted).T
            try:
                motion = self._generated(condition, rng)
            except MotionError:
                return process
            motion = smooth_motion(motion, config.smooth) if config.smooth else motion
            vectors = self.data.representation.encode(motion)
            about = self.data.representation, process.channels, config.fps
            pairs.append((wanted, measured_state(vectors, *about)))
        return process.calibrated(*(np.concatenate(rows, axis=1) for rows in zip(*pairs)))

    def _model(self, network: Denoiser, process: StateProcess | None) -> DiffusionModel:
        """Return the model with this network and process of the state of movement."""
        training = self.config.training
        # Unpaired motion has no conditions but the state, just like windows with condition dropout.
        droppable = {
            "all": training.dropout_condition or self.data.unpaired_seconds,
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
            state_process=process,
            droppable=tuple(name for name, share in droppable.items() if share),
            clip_denoised=self.config.clip_denoised,
            smooth=self.config.smooth,
            recorded_fps=self.data.recorded_fps,
        )

    def about_data(self) -> dict[str, str]:
        """Return what README.md says of the data beside the recordings, and of their use."""
        config, data = self.config, self.data
        share = config.unpaired.share if config.unpaired is not None else 0.0
        windows = config.updates * config.training.batch * (1 - share)
        count, unpaired = windows * config.training.window / data.seconds, data.unpaired_seconds
        return {
            "Unpaired motion": f"{unpaired:.0f} s" if unpaired else "none",
            "Not used": "; ".join(self.unused),
            "Use of the recordings": f"a second is drawn about {drawn(count)}",
        }

    def _log_missing_parts(self) -> None:
        """Log in one line the features that training lacks if body parts cannot be identified."""
        training, skeleton = self.config.training, self.data.representation.skeleton
        mirrors = self.config.augmentation.mirror
        lacking = {
            "no mirrored recordings": mirrors and not can_be_mirrored(skeleton),
            "no loss on foot sliding": training.foot_sliding and self.foot_places is None,
            "all joints are modelled": self.config.joints == "body",
        }
        follows = ", ".join(text for text, is_so in lacking.items() if is_so)
        missing = unidentified(skeleton)
        if missing and follows and self.processes.is_first:
            log.info(UNIDENTIFIED, missing.capitalize(), follows)

    def _contents(self) -> list[str]:
        """Return a description of the training data for the log."""
        data, conditions = self.data, self.data.conditions
        contents = []
        if data.unpaired_seconds:
            contents.append(f"{roughly(data.unpaired_seconds)} of unpaired motion")
        if len(data.recordings) > len(data.sources):
            contents.append(f"{counted(len(data.recordings), 'sequence')} with their variants")
        nouns = {"speech": "speech feature", "events": "event", "styles": "style"}
        widths = {nouns[k]: c.stop - c.start for k, c in conditions.columns.items() if k in nouns}
        return contents + [counted(count, noun) for noun, count in widths.items() if count]

    def estimate(self) -> Estimate:
        """Estimate the cost of the training from a few updates.

        They change the networks: for a run that is not kept.
        """
        data, conditioner = self.data, self.data.conditions.conditioner
        update = quickest(lambda: float(self._update(0)), 4)
        phases = 1 + max(sequence.phase for sequence in data.recordings)
        number = 4 * self.config.fps * phases  # bytes a second, float32
        beside_speech = data.conditions.width - data.conditions.columns["speech"].stop
        width = data.representation.n_features + beside_speech
        motion = number * (1 + data.recordings[-1].mirrored) * width
        raw = 0.0 if conditioner is None else number * (conditioner.extractor.dim + 1)
        return Estimate(self.config.updates * update, (motion + raw, motion))
