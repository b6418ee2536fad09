"""Training: block by block, two levels at a time, reconstruction and random steps in turn."""

from __future__ import annotations

import copy
import logging
import math
import time
from dataclasses import replace
from pathlib import Path

import torch

from gesturekit.errors import ConfigError
from gesturekit.motion.parts import find_legs, unidentified
from gesturekit.multires.backend import choose_backend, requested_backend
from gesturekit.multires.config import MultiresConfig
from gesturekit.multires.constraints.constraint import fastest_second, plain_values
from gesturekit.multires.model import MultiresModel
from gesturekit.multires.network.generator import MultiresGenerator
from gesturekit.multires.sampling.conditions import Conditions
from gesturekit.multires.trained_model import TrainedNoise, TrainedSequence
from gesturekit.multires.training.data import TrainingData, load_training_data
from gesturekit.multires.training.kinematics import VectorKinematics
from gesturekit.multires.training.monitor import Monitor, distance_from_recordings
from gesturekit.multires.training.stage import Pair
from gesturekit.multires.training.window_cache import WindowCache
from gesturekit.training.data.sources import described, save_sources
from gesturekit.training.held_out import HeldOut
from gesturekit.training.run.folder import Run
from gesturekit.training.run.processes import Processes
from gesturekit.training.run.session import plan as session_plan
from gesturekit.training.run.session import session
from gesturekit.training.run.steps import Steps
from gesturekit.training.run_config import UNIDENTIFIED
from gesturekit.training.seeds import seeded
from gesturekit.wording import counted, roughly

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


def plan(config: MultiresConfig) -> None:
    """Log what `train` would do and how long it would take; see `training.run.session`."""
    session_plan(config, Trainer)


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
                f"training.batch: {self.batch} window(s) a step cannot be shared by "
                f"{processes.count} processes (whole sequences go one at a time)"
            )
        self.data = self._read(resume)
        self.config = config = self._adapted(config)
        if self.data.unpaired_is_paired and processes.is_first:
            log.warning(
                "The corpus has no unpaired speech: random steps draw windows of the paired speech."
            )
        self.held_out = HeldOut(
            config, run, speech=self.data.conditioner is not None, styles=self.data.styles
        )
        self.seconds = sum(sequence.n_frames for sequence in self.data.paired) / config.fps
        self.heard = sum(clip.shape[-1] for clip in self.data.unpaired) / config.fps
        if processes.is_first:
            steps = sum(iterations for _, iterations in self.pairs())
            log.info(
                "Run folder %s: multires, %s, %d levels, %s.",
                config.out,
                self._mode(),
                config.network.levels,
                counted(steps, "iteration"),
            )
            log.info("Training on %s.", ", ".join(self._what()))
            log.info("Measured at the end and every few minutes: %s.", self.held_out.what)
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
        convolve = choose_backend(requested_backend(config.backend), self.network).convolve
        self.bank = WindowCache(self.data, config, self.network, convolve)
        self.monitor = Monitor(self.data, config, convolve) if config.eval_every else None
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

    def _adapted(self, config: MultiresConfig) -> MultiresConfig:
        """The configuration without losses on parts that the rig does not have, said once."""
        skeleton = self.data.representation.skeleton
        missing = unidentified(skeleton)
        if not missing:
            return config
        off, follows = {"arm_speed": 0.0, "arm_acceleration": 0.0}, []
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

    @property
    def batch(self) -> int:
        """Windows of a step, over all processes."""
        # Whole sequences differ in length, so they go one at a time, as in the paper.
        return self.config.training.batch if self.config.training.window is not None else 1

    def _what(self) -> list[str]:
        """What there is to train on, for people."""
        data = self.data
        parts = [described(data.sources, self.seconds, self.config.fps)]
        if data.conditioner is not None:
            kind = "the same" if data.unpaired_is_paired else "unpaired"
            parts.append(f"{roughly(self.heard)} of {kind} speech")
            parts.append(counted(data.conditioner.dim, "feature"))
        if data.styles:
            parts.append(counted(len(data.styles), "style"))
        representation = data.representation
        joints = counted(representation.skeleton.n_joints, "joint")
        return [*parts, f"{len(representation.joints)} of {joints} modelled"]

    def _mode(self) -> str:
        """Return the model's inputs in words."""
        given = ["speech"] * bool(self.data.conditioner) + ["labels"] * bool(self.data.styles)
        return f"{' and '.join(given)} mode" if given else "no condition"

    def seconds_needed(self) -> float:
        """Estimate how long the training takes, from a few iterations of each pair of levels.

        They change the networks: for a run that is not kept.
        """
        needed = 0.0
        for first, iterations in self.pairs():
            pair = Pair(self, first, iterations)
            pair.iterate(0)  # compiles
            clock = [time.monotonic()]
            for iteration in (0, 1, 2):  # number 0 fills the window cache
                pair.iterate(iteration)
                clock.append(time.monotonic())
            pace = (clock[3] - clock[1]) / 2
            refill = max(0.0, clock[1] - clock[0] - pace)
            needed += iterations * pace
            needed += refill * math.ceil(iterations / self.config.training.renew_every)
        return needed

    def pairs(self) -> list[tuple[int, int]]:
        """(first level, iterations) of each pair."""
        training, levels = self.config.training, self.config.network.levels
        return [
            (first, training.first_stage if first == 0 else training.further_stages)
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
        # An iteration costs what its frames cost, and a share that does not depend on them.
        levels = self.config.network.levels
        cost = {first: 20 + 100 * 0.75 ** (levels - 2 - first) for first, _ in pairs}
        stages = [(iterations, cost[first]) for first, iterations in pairs]
        with Steps(stages, done, quiet=not self.processes.is_first) as progress:
            start, chosen = 0, None
            for first, iterations in pairs:
                here = min(max(done - start, 0), iterations)
                if here < iterations:
                    own = state if state is not None and state["first"] == first else None
                    pair = Pair(self, first, iterations)
                    if self.processes.is_first and pair.backend.reason != chosen:
                        chosen = pair.backend.reason
                        log.info("Backend: %s (%s).", pair.backend.name, chosen)
                    if own is not None:
                        pair.load_state(own)
                    pair.train(here, start, progress, cost[first])
                start += iterations
        return self._finish(start)

    def measure(self, step: int, levels: int) -> str:
        """Log and return figures on held-out recordings, at the rate of the finest level so far."""
        whole = levels == self.config.network.levels
        network = copy.deepcopy(self.network)
        return self.held_out.measure(
            step,
            self._model(network).generate,
            "" if whole else f", levels 1-{levels} of {self.config.network.levels}",
            **({} if whole else {"levels": levels}),
        )

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
            figures = self.measure(steps, self.config.network.levels)
            last = self.folder.last_metrics()
            self._save(
                "model",
                self.network,
                {
                    "Training steps": str(steps),
                    "Last losses": ", ".join(f"{name} {value:.3g}" for name, value in last.items()),
                    **({"Measured": figures} if figures else {}),
                },
            )
        self.processes.wait()
        return self.folder.folder / "model"

    def _save(self, name: str, network: MultiresGenerator, notes: dict[str, str]) -> None:
        """Write a model of the run."""
        files = 0 if self.data.unpaired_is_paired else len(self.data.unpaired)
        self._model(network).save(
            self.folder.folder / name,
            notes={
                "Recordings": described(self.data.sources, self.seconds, self.config.fps),
                "Unpaired speech": f"{roughly(self.heard)} in {counted(files, 'file')}"
                if files and self.data.n_speech
                else "none",
                **notes,
                **{str(key): str(value) for key, value in self.config.notes.items()},
            },
        )
        save_sources(self.folder.folder / name, self.data.sources)

    def _model(self, network: MultiresGenerator) -> MultiresModel:
        """The model of a network, which is moved to the CPU."""
        return MultiresModel(
            fps=self.config.fps,
            representation=self.data.representation,
            normaliser=self.data.normaliser,
            conditions=Conditions(self.data.conditioner, self.data.styles, self.config.residual),
            network_config=self.config.network,
            network=network.cpu().eval(),
            noise=TrainedNoise(
                sigma=torch.stack([sequence.sigma for sequence in self.data.paired]),
                z_star={sequence.name: sequence.z_star for sequence in self.data.paired},
                sequences={
                    sequence.name: TrainedSequence(
                        sequence.n_frames,
                        self.data.styles[sequence.style] if self.data.styles else None,
                    )
                    for sequence in self.data.paired
                },
                z_star_shuffle=self.config.z_star_shuffle,
                noise_levels=self.config.noise_levels,
            ),
            speakers=self.data.speakers,
            fastest=self.data.representation.scale
            * max(
                fastest_second(
                    plain_values(self.data.normaliser, sequence.motion[None])[
                        :, self.data.representation.layout.root_xz
                    ],
                    self.config.fps,
                )
                for sequence in self.data.paired
            ),
            smooth=self.config.smooth,
            recorded_fps=self.data.recorded_fps,
        )
