"""Training run of either system: its data, its report, its model, and a plan of its duration."""

from __future__ import annotations

import logging
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import numpy as np
import torch

from gesturekit.errors import ConfigError
from gesturekit.training.config import to_dict
from gesturekit.training.held_out import HeldOutMetrics
from gesturekit.training.loop import Loop
from gesturekit.training.model_folder import TrainedModel
from gesturekit.training.origin import describe_recordings, save_sources, unused_labels
from gesturekit.training.recordings import Recordings
from gesturekit.training.run_config import RunConfig
from gesturekit.training.run_folder import Run
from gesturekit.training.session import Processes, prepare_device, session
from gesturekit.wording import counted, roughly

log = logging.getLogger(__name__)
_T = TypeVar("_T")

_FASTER, _SLOWER = 0.8, 2.0
"""Limits of the interval, relative to the estimate: other programs on the machine slow a training
down, and a machine that is busy now may not be later."""
_MEASURING = 0.1
"""Seconds for each second of held-out recordings that is generated and measured at the end."""


@dataclass(frozen=True)
class Estimate:
    """Estimated cost of a training.

    Attributes:
        training: seconds of all steps, with what precedes them after the data was read.
        rates: bytes of arrays for each second of recordings, and of speech or motion without the
            other.
    """

    training: float
    rates: tuple[float, float]


class BaseTrainer(ABC):
    """A training run; each system adds its networks, its steps and its model.

    Args:
        config: of the run.
        run: its folder. In it the first process of a new run saves the data.
        device: on which the networks are trained.
        processes: that share each batch.
        resume: load the data that the run saved when it began.
        trial: read an excerpt of the corpus only, to time a few steps on it.
    """

    config: Any
    data: Any
    read_data: Callable[..., Any]
    """Reads the corpus: `read_data(config, device, trial=trial)`."""
    load_data: Callable[..., Any]
    """Loads what `save` of the data wrote: `load_data(folder, config, device)`."""
    read_recordings: Callable[..., Recordings]
    """Reads the motion of an excerpt of the corpus: `read_recordings(config)`."""

    def __init__(
        self,
        config: RunConfig,
        run: Run,
        device: torch.device,
        processes: Processes,
        *,
        resume: bool,
        trial: bool = False,
    ) -> None:
        self.config, self.folder, self.device, self.processes = config, run, device, processes
        if (windows := self.config.windows_per_step) < processes.count:
            raise ConfigError(
                f"training.batch: {windows} window(s) a step cannot be shared by "
                f"{processes.count} processes (whole sequences go one at a time)"
            )
        folder, data, trainer = run.folder / "data", None, type(self)
        if not resume and processes.is_first:
            data = trainer.read_data(config, str(device), trial=trial)
            data.save(folder)
            run.begin()
        processes.wait()
        self.data = trainer.load_data(folder, config, str(device)) if data is None else data
        conditions = self.data.conditions
        has_speech, styles = conditions.conditioner is not None, conditions.styles
        self.held_out = HeldOutMetrics(config, run, speech=has_speech, styles=styles)
        self.loop = Loop(config, run, processes, self.held_out)
        self.unused = unused_labels(self.data.sources, styles, state=self.config.state)
        self.set_up()

    @abstractmethod
    def set_up(self) -> None:
        """Announce the training, and make its networks."""

    def announce(self, kind: Sequence[str], contents: Sequence[str], steps: int) -> None:
        """Log the run folder, kind of training, data and held-out recordings, on one process.

        Args:
            kind: system and mode of the training.
            contents: training data beside the recordings and joints.
            steps: length of the training.
        """
        if not self.processes.is_first:
            return
        config, representation = self.config, self.data.representation
        length = f"{counted(steps, config.noun)} (longer={config.longer:g})"
        joints = counted(representation.skeleton.n_joints, "joint")
        log.info("Run folder %s: %s.", config.out, ", ".join([*kind, length]))
        log.info(
            "Training on %s.",
            ", ".join(
                [
                    describe_recordings(self.data.sources, self.data.seconds, config.fps),
                    *contents,
                    f"{len(representation.joints)} of {joints} modelled",
                ]
            ),
        )
        for line in self.unused:
            log.warning("%s.", line)
        if self.held_out.items:
            log.info("Measured at the end and every few minutes: %s.", self.held_out.what)

    @abstractmethod
    def run(self) -> None:
        """Train all steps, or those that are left, and write the model."""

    @abstractmethod
    def estimate(self) -> Estimate:
        """Estimate the cost of the training from a few steps.

        They change the networks: for a run that is not kept.
        """

    @abstractmethod
    def about_data(self) -> dict[str, str]:
        """Return what README.md says of the data beside the recordings, and of their use."""

    def finish(self, steps: int, model: TrainedModel) -> None:
        """Measure the model of all steps on held-out recordings, and write it."""
        measured = self.held_out.measure(steps, model, keep=True)
        losses = self.folder.last_metrics()
        shown = [f"{name} {loss:.3g}" for name, loss in losses.items() if name != "learning_rate"]
        model.network.cpu()
        self.write(
            "model",
            model,
            {"Training steps": str(steps), "Last losses": ", ".join(shown), "Measured": measured},
        )

    def write(self, name: str, model: TrainedModel, rows: Mapping[str, str]) -> None:
        """Write a model into a folder of the run; `rows` are further facts for its README.md."""
        config, data = self.config, self.data
        facts = {
            "Recordings": describe_recordings(data.sources, data.seconds, config.fps),
            **self.about_data(),
            "Began with": str(config.start_from or "random weights"),
            **rows,
        }
        facts = {key: text for key, text in facts.items() if text}
        notes = {str(key): str(value) for key, value in config.notes.items()}
        model.save(self.folder.folder / name, notes=facts | notes)
        save_sources(self.folder.folder / name, data.sources)


def run_training(trainer: type[BaseTrainer], config: RunConfig, *, resume: bool) -> Path:
    """Train a model and write it.

    Under torchrun each process takes its share of every batch, and the first one writes.

    Args:
        trainer: of the system.
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
        trainer(config, run, device, processes, resume=resume).run()
        processes.wait()
        return run.folder / "model"


def plan_training(trainer: type[BaseTrainer], config: RunConfig) -> None:
    """Log the plan and estimated duration of a run, without its run folder.

    An excerpt of the corpus is read, and a few steps are timed on it, in a temporary folder.

    Raises:
        ConfigError: `config.out` is a file, or no such device.
    """
    started = time.process_time()
    try:
        Run(config.out, to_dict(config), resume=False)
    except ConfigError as error:
        if not (config.out / "config.yaml").is_file():
            raise
        log.warning("This cannot be trained yet: %s.", error)
    with (
        TemporaryDirectory() as folder,
        session(config, resume=False, folder=Path(folder)) as (run, device, processes),
    ):
        trial = trainer(config, run, device, processes, resume=False, trial=True)
        estimate = silently(trial.estimate)
        if not processes.is_first:
            return
        excerpt = silently(partial(trainer.read_recordings, config), logging.WARNING)
        motion = quickest(lambda: [item.load_motion(config.parts) for item in excerpt.items], 1)
        # A motion file is read whole, however short the excerpt is.
        reading = motion * len(excerpt.whole[0]) / len(excerpt.items)
        # The first reading loaded libraries too.
        read = partial(trainer.read_data, config, str(device), trial=True)
        features = max(0.0, quickest(partial(silently, read, logging.WARNING), 1) - motion)
        reading += features * excerpt.lengths[0] / sum(item.duration for item in excerpt.items)
        if excerpt.is_long(config):
            size = np.dot(estimate.rates, excerpt.lengths)
            log.info(
                "Arrays of %.1f MB in %s; making those that are missing takes about %s.",
                size / 1e6,
                config.arrays_folder,
                roughly(reading / config.workers),
            )
            reading *= min(1.0, 60 * config.in_memory / sum(excerpt.lengths))
        seconds = started + reading + estimate.training + _MEASURING * trial.held_out.seconds
        log.info(
            "Time: about %s on this machine while it is idle, %s to %s beside other programs. "
            "Nothing was written.",
            *map(roughly, (seconds, _FASTER * seconds, _SLOWER * seconds)),
        )


def make_arrays(trainer: type[BaseTrainer], config: RunConfig) -> None:
    """Make the arrays of a corpus that is not held in memory; log where they are."""
    device = prepare_device(config.device, config.threads)
    if trainer.read_data(config, str(device)).is_stored:
        log.info("The arrays of %s are ready in %s.", config.corpus, config.arrays_folder)
    else:
        log.info("%s is held in memory: it needs no arrays (see in_memory).", config.corpus)


def silently(work: Callable[[], _T], level: int = logging.INFO) -> _T:
    """Return what a function returns, without its messages of up to a level.

    Information on an excerpt is not true of the whole corpus; warnings of a second reading are
    those of the first.
    """
    logging.disable(level)
    try:
        return work()
    finally:
        logging.disable(logging.NOTSET)


def quickest(work: Callable[[], object], times: int) -> float:
    """Return the seconds of the quickest of several calls, as other programs only add to them."""
    clock = [time.monotonic()]
    for _ in range(times):
        work()
        clock.append(time.monotonic())
    return min(after - before for before, after in pairwise(clock))
