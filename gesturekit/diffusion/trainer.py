"""Training: a denoiser learns to tell the noise from the motion."""

from __future__ import annotations

import contextlib
import copy
import logging
import math
import sys
import time
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from tqdm import tqdm

from gesturekit.diffusion.batches import Batch, Batches
from gesturekit.diffusion.config import DiffusionConfig, TrainingConfig
from gesturekit.diffusion.data import TrainingData
from gesturekit.diffusion.loading import load_training_data
from gesturekit.diffusion.model import DiffusionModel
from gesturekit.diffusion.monitor import Monitor
from gesturekit.diffusion.networks import Denoiser
from gesturekit.diffusion.schedule import NoiseSchedule
from gesturekit.errors import ModelError
from gesturekit.training.processes import Processes
from gesturekit.training.run import Run
from gesturekit.training.seeds import generator, seeded
from gesturekit.training.session import session

log = logging.getLogger(__name__)


def train(config: DiffusionConfig, *, resume: bool = False) -> Path:
    """Train a diffusion model and write it.

    Args:
        config: what to train on, and how.
        resume: go on from the last checkpoint in `config.out`.

    Returns:
        the model folder, `config.out / "model"`.

    Raises:
        ConfigError: `config.out` holds a run already (or none to resume), or no such device.
        CorpusError: the corpus cannot be trained on.
        ModelError: training left the realm of numbers.
    """
    with session(config, resume=resume) as (run, device, processes):
        return _Trainer(config, run, device, processes, resume=resume).run()


def learning_rate(training: TrainingConfig, update: int) -> float:
    """The learning rate of an update, counted from 0 (appendix A.1)."""
    warm = min(1.0, (update + 1) / max(training.warm_up, 1))
    return training.learning_rate * warm * training.decay ** (update // 10)


class _Trainer:
    def __init__(
        self,
        config: DiffusionConfig,
        run: Run,
        device: torch.device,
        processes: Processes,
        *,
        resume: bool,
    ) -> None:
        self.config = config
        self.folder = run
        self.device = device
        self.processes = processes
        self.data = self._data(resume=resume)
        self.schedule = NoiseSchedule.of(config.noise)
        self.batches = Batches(self.data, config)
        self.changes = self.data.changes().to(device) if config.training.changes else None
        if processes.is_first:
            log.info("Training on %s.", ", ".join(self._what()))
        self.network = self._network(resume=resume).to(device)
        # The weights that the model will have.
        self.average = copy.deepcopy(self.network).eval() if config.training.ema else self.network
        self.optimiser = torch.optim.Adam(self.network.parameters())
        watched = config.eval_every and processes.is_first
        self.monitor = Monitor(self.data, config) if watched else None

    def _data(self, *, resume: bool) -> TrainingData:
        """What the first process reads of the corpus, and all read of the first."""
        folder = self.folder.folder / "data"
        if not resume:
            if self.processes.is_first:
                data = load_training_data(self.config)
                data.save(folder)
                self.folder.begin()
            self.processes.wait()
            if self.processes.is_first:
                return data
        return TrainingData.load(folder, self.config)

    def _network(self, *, resume: bool) -> Denoiser:
        width = self.data.representation.n_features
        network = seeded(
            (self.config.seed, "denoiser"),
            lambda: Denoiser(width, self.data.conditions.width, self.config.network),
        )
        if self.config.start_from is not None and not resume:
            features = self.config.features
            weights = None if features is None else features.weights
            start = DiffusionModel.load(self.config.start_from, weights=weights)
            network.load_state_dict(start.network.state_dict())
        return network

    def _what(self) -> list[str]:
        """What there is to train on, for people."""
        data, conditions = self.data, self.data.conditions
        parts = [f"{data.seconds[0]:.0f} s of motion"]
        if data.seconds[1]:
            parts.append(f"{data.seconds[1]:.0f} s of unpaired motion")
        if len(data.recordings) > 1:
            parts.append(f"{len(data.recordings)} recordings with their variants")
        if conditions.conditioner is not None:
            parts.append(f"{conditions.conditioner.dim} features")
        for name, known in (("events", conditions.events), ("styles", conditions.styles)):
            if known:
                parts.append(f"{len(known)} {name}")
        return [*parts, f"{len(data.representation.joints)} joints"]

    def run(self) -> Path:
        done, state = self.folder.checkpoints.latest() or (0, None)
        if state is not None:
            self._load_state(state)
            log.info("Resuming after step %d.", done)
        first, training = self.processes.is_first, self.config.training
        if first:
            self.folder.forget_metrics_after(done)
        losses: list[Tensor] = []
        clock = time.monotonic()
        with tqdm(
            total=training.updates,
            initial=done,
            disable=not first,
            # A log file wants a line now and then, a terminal a living bar.
            mininterval=1.0 if sys.stderr.isatty() else 60.0,
        ) as progress:
            for update in range(done, training.updates):
                losses.append(self._update(update))
                step = update + 1
                progress.update()
                last = step == training.updates
                if step % self.config.log_every == 0 or last:
                    loss = float(self.processes.mean(torch.stack(losses).mean()))
                    self._check_finite(step, "loss", loss)
                    if first:
                        pace = (time.monotonic() - clock) / len(losses)
                        rate = learning_rate(training, update)
                        values = {"loss": loss, "learning_rate": rate}
                        self.folder.log(step, {**values, "seconds_per_iteration": pace})
                        progress.set_postfix_str(f"loss {loss:.3g}")
                    losses, clock = [], time.monotonic()
                if self.monitor is not None and (step % self.config.eval_every == 0 or last):
                    self.average.eval()
                    figures = self.monitor.figures(self.average)
                    if figures:
                        self.folder.log(step, figures, kind="evaluation")
                if step % self.config.checkpoint_every == 0 or last:
                    weights = [weight.detach().norm() for weight in self.network.parameters()]
                    self._check_finite(step, "weights", float(torch.stack(weights).sum()))
                    if first:
                        self.folder.checkpoints.save(step, self._state())
        if first:
            self._finish()
        self.processes.wait()
        return self.folder.folder / "model"

    def _update(self, update: int) -> Tensor:
        """One step of Adam on this process's share of the batch; its loss."""
        training = self.config.training
        rows = self.processes.share(training.batch)
        share = (rows.stop - rows.start) / training.batch
        for group in self.optimiser.param_groups:
            group["lr"] = learning_rate(training, update)
        self.network.train()
        # Dropout draws from torch's own state, on whatever device.
        torch.manual_seed(
            generator(self.config.seed, "dropout", update, self.processes.rank).initial_seed()
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

    def _loss(self, batch: Batch) -> Tensor:
        """Squared error of the prediction (eq. 4), each clip weighed by its step."""
        noisy = self.schedule.add_noise(batch.clean, batch.noise, batch.step)
        target = self.schedule.target(batch.clean, batch.noise, batch.step)
        half = self.config.training.precision == "bfloat16"
        precise = torch.autocast(self.device.type, torch.bfloat16) if half else None
        with precise or contextlib.nullcontext():
            predicted = self.network(noisy, batch.condition, batch.step)
        apart = predicted.float() - target
        errors = apart.square().mean(dim=(1, 2))
        if self.config.training.changes:
            trembling = (apart.diff(dim=1) / self.changes).square().mean(dim=(1, 2))
            errors = errors + self.config.training.changes * trembling
        weights = self.schedule.loss_weight(batch.step, self.config.training.min_snr)
        return (weights * errors).mean()

    @torch.no_grad()
    def _average(self, update: int) -> None:
        # The first updates would weigh for ever in an average that began with them.
        kept = min(self.config.training.ema, (1 + update) / (10 + update))
        own = self.network.state_dict()
        for name, value in self.average.state_dict().items():
            value.lerp_(own[name], 1 - kept)

    def _check_finite(self, step: int, name: str, value: float) -> None:
        if math.isfinite(value):
            return
        kept = self.folder.checkpoints.steps()
        after = f"the last checkpoint is of step {kept[-1]}" if kept else "there is no checkpoint"
        raise ModelError(
            f"step {step}: {name} is {value}; training has come apart, and {after}. Try a smaller "
            "training.learning_rate"
        )

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

    def _finish(self) -> None:
        training = self.config.training
        # Motion without speech is told nothing either.
        told_nothing = training.dropout_condition or self.data.seconds[1]
        droppable = {"all": told_nothing, "styles": training.dropout_style}
        model = DiffusionModel(
            fps=self.config.fps,
            representation=self.data.representation,
            conditions=self.data.conditions,
            standardiser=self.data.standardiser,
            network_config=self.config.network,
            noise_config=self.config.noise,
            network=self.average.cpu().eval(),
            speakers=self.data.speakers,
            droppable=[name for name, share in droppable.items() if share],
            smooth=self.config.smooth,
            recorded_fps=self.data.recorded_fps,
        )
        paired, unpaired = self.data.seconds
        last = self.folder.last_metrics()
        last.pop("learning_rate", None)
        model.save(
            self.folder.folder / "model",
            notes={
                "Recordings": f"{paired:.0f} s",
                "Unpaired motion": f"{unpaired:.0f} s" if unpaired else "none",
                "Began with": str(self.config.start_from or "random weights"),
                "Training steps": str(training.updates),
                "Last losses": ", ".join(f"{name} {value:.3g}" for name, value in last.items()),
                **{str(key): str(value) for key, value in self.config.notes.items()},
            },
        )
