"""Training: block by block, two levels at a time, reconstruction and random steps in turn."""

from __future__ import annotations

import copy
import logging
import sys
from pathlib import Path

import torch
from tqdm import tqdm

from gesturekit.errors import ConfigError
from gesturekit.multires.bank import Bank
from gesturekit.multires.config import MultiresConfig
from gesturekit.multires.data import TrainingData, load_training_data
from gesturekit.multires.holding import fastest_second, plain_values
from gesturekit.multires.kinematics import VectorKinematics
from gesturekit.multires.model import MultiresModel
from gesturekit.multires.model_format import TrainedSequence
from gesturekit.multires.monitor import Monitor, distance_from_recordings
from gesturekit.multires.networks import MultiresGenerator
from gesturekit.multires.pair import Pair
from gesturekit.training.processes import Processes
from gesturekit.training.run import Run
from gesturekit.training.seeds import seeded
from gesturekit.training.session import session

log = logging.getLogger(__name__)


def train(config: MultiresConfig, *, resume: bool = False) -> Path:
    """Train a multires model and write it.

    Under torchrun each process takes its share of every batch, and the first one writes.

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
        return Trainer(config, run, device, processes, resume=resume).run()


class Trainer:
    """A run: its data, its networks and its folder; pairs of levels are trained one by one."""

    def __init__(
        self,
        config: MultiresConfig,
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
        if self.batch < processes.count:
            raise ConfigError(
                f"schedule.batch: {self.batch} window(s) a step cannot be shared by "
                f"{processes.count} processes (whole sequences go one at a time)"
            )
        self.data = self._read(resume)
        if self.data.unpaired_is_paired and processes.is_first:
            log.warning(
                "The corpus has no unpaired speech: random steps draw windows of the paired speech."
            )
        self.seconds = sum(sequence.n_frames for sequence in self.data.paired) / config.fps
        self.heard = sum(clip.shape[-1] for clip in self.data.unpaired) / config.fps
        if processes.is_first:
            log.info("Training on %s.", ", ".join(self._what()))
        self.network = seeded(
            (config.seed, "generator"),
            lambda: MultiresGenerator(
                self.data.representation,
                self.data.n_speech + len(self.data.styles),
                config.network,
            ),
        ).to(self.device)
        self.kinematics = VectorKinematics(
            self.data.representation, config.fps, arms=config.uses_arm_speed
        ).to(self.device)
        self.normaliser = self.data.normaliser.to(self.device)
        self.bank = Bank(self.data, config, self.network)
        self.monitor = Monitor(self.data, config) if config.eval_every else None
        self.groups = self.data.window_lengths()
        # How often a step takes windows of each length: as often as there are frames of it.
        self.group_frames = torch.tensor(
            [
                float(sum(self.data.paired[i].n_frames for i in members))
                for members in self.groups.values()
            ]
        )

    def _read(self, resume: bool) -> TrainingData:
        """What to train on; a new run's is read by the first process, and the others have it."""
        folder = self.folder.folder / "data"
        data = None
        if not resume and self.processes.is_first:
            data = load_training_data(self.config)
            data.save(folder)
            self.folder.begin()
        self.processes.wait()
        return TrainingData.load(folder, self.config) if data is None else data

    @property
    def batch(self) -> int:
        """Windows of a step, over all processes."""
        # Whole sequences differ in length, so they go one at a time, as in the paper.
        return self.config.schedule.batch if self.config.schedule.window is not None else 1

    def _what(self) -> list[str]:
        """What there is to train on, for people."""
        data = self.data
        parts = [f"{len(data.paired)} recordings ({self.seconds:.0f} s)"]
        if data.conditioner is not None:
            kind = "the same" if data.unpaired_is_paired else "unpaired"
            parts.append(f"{self.heard:.0f} s of {kind} speech")
            parts.append(f"{data.conditioner.dim} features")
        if data.styles:
            parts.append(f"{len(data.styles)} styles")
        return [*parts, f"{len(data.representation.joints)} joints"]

    def pairs(self) -> list[tuple[int, int]]:
        """(first level, iterations) of each pair."""
        schedule, levels = self.config.schedule, self.config.network.levels
        return [
            (first, schedule.first_pair if first == 0 else schedule.further_pairs)
            for first in range(0, levels, 2)
        ]

    def run(self) -> Path:
        """Train all pairs, or those that are left, and write the model."""
        done, state = self.folder.checkpoints.latest() or (0, None)
        if state is not None:
            self.network.load_state_dict(state["generator"])
        if self.processes.is_first:
            if state is not None:
                log.info("Resuming after step %d.", done)
            self.folder.forget_metrics_after(done)
        # Nobody writes a checkpoint before all have read the one to go on from.
        self.processes.wait()
        pairs = self.pairs()
        # Time left is told by frames to go, plus a share that does not depend on frames; whole
        # numbers, so that the bar ends exactly where it should.
        levels = self.config.network.levels
        cost = {first: 20 + round(100 * 0.75 ** (levels - 2 - first)) for first, _ in pairs}
        with tqdm(
            total=sum(iterations * cost[first] for first, iterations in pairs),
            bar_format="{l_bar}{bar}| {elapsed} gone, {remaining} left {postfix}",
            # A log file wants a line now and then, a terminal a living bar.
            mininterval=1.0 if sys.stderr.isatty() else 60.0,
            disable=not self.processes.is_first,
        ) as progress:
            start = 0
            for first, iterations in pairs:
                here = min(max(done - start, 0), iterations)
                progress.update(cost[first] * here)
                if here < iterations:
                    own = state if state is not None and state["first"] == first else None
                    pair = Pair(self, first, iterations)
                    if own is not None:
                        pair.load_state(own)
                    pair.train(here, start, progress, cost[first])
                start += iterations
        return self._finish(start)

    def evaluate(self, step: int, first: int, levels: int) -> None:
        """Log cheap measures, write a sample, and keep the best model of the last pair."""
        monitor = self.monitor
        if monitor is None:
            return
        figures = monitor.figures(self.network, levels)
        monitor.warn_of_collapse(figures, step)
        monitor.write_sample(self.folder.folder / "samples", step)
        if levels == self.config.network.levels:
            # Of this pair alone: before it, what is measured lacks the finest levels.
            before = self.folder.evaluations(level=first + 1)
            distance = distance_from_recordings(figures)
            if all(distance < distance_from_recordings(other) for other in before):
                self._save(
                    "best",
                    copy.deepcopy(self.network),
                    {"Training steps": f"{step}, the best by the cheap evaluations"},
                )
        self.folder.log(step, figures, level=first + 1, kind="evaluation")

    def _finish(self, steps: int) -> Path:
        if self.processes.is_first:
            last = self.folder.last_metrics()
            self._save(
                "model",
                self.network,
                {
                    "Training steps": str(steps),
                    "Last losses": ", ".join(f"{name} {value:.3g}" for name, value in last.items()),
                },
            )
        self.processes.wait()
        return self.folder.folder / "model"

    def _save(self, name: str, network: MultiresGenerator, notes: dict[str, str]) -> None:
        """Write a model of the run and say where it lies."""
        model = MultiresModel(
            fps=self.config.fps,
            representation=self.data.representation,
            conditioner=self.data.conditioner,
            normaliser=self.data.normaliser,
            network_config=self.config.network,
            residual=self.config.residual,
            recall=self.config.recall,
            noise_levels=self.config.noise_levels,
            styles=self.data.styles,
            network=network.cpu().eval(),
            sigma=torch.stack([sequence.sigma for sequence in self.data.paired]),
            z_star={sequence.name: sequence.z_star for sequence in self.data.paired},
            sequences={
                sequence.name: TrainedSequence(
                    sequence.n_frames,
                    self.data.styles[sequence.style] if self.data.styles else None,
                )
                for sequence in self.data.paired
            },
            speakers=self.data.speakers,
            fastest=max(
                fastest_second(
                    plain_values(self.data.normaliser, sequence.motion[None])[:, [-3, -1]],
                    self.config.fps,
                )
                for sequence in self.data.paired
            ),
            smooth=self.config.smooth,
            recorded_fps=self.data.recorded_fps,
        )
        model.save(
            self.folder.folder / name,
            notes={
                "Recordings": f"{len(self.data.paired)}, {self.seconds:.0f} s",
                "Unpaired speech": f"{len(self.data.unpaired)} files, {self.heard:.0f} s"
                if self.data.n_speech and not self.data.unpaired_is_paired
                else "none",
                **notes,
                **{str(key): str(value) for key, value in self.config.notes.items()},
            },
        )
