"""Training run of either system: its data, its report, its model, and a plan of its duration."""

from __future__ import annotations

import logging
import math
import time
import timeit
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from gesturekit.errors import ConfigError, ModelError
from gesturekit.progress import Progress
from gesturekit.training.config import to_dict
from gesturekit.training.held_out import HeldOutMetrics
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
_SAID_AFTER = 3.0
"""Seconds of training after which its length is estimated and logged, once."""


@dataclass(frozen=True)
class Due:
    """Work of this process that is due after a step; only the first one evaluates and measures."""

    evaluation: bool
    measurement: bool
    checkpoint: bool


@dataclass
class Loop:
    """Count training steps; log their losses, and say what else is due after each of them.

    Every `log_every` steps the means of the losses are logged, and every `checkpoint_every` steps
    a checkpoint is due; both also at the end of a stage. Only the first process writes.

    Attributes:
        config: of the run.
        run: its folder.
        processes: of the run.
        held_out: decides when held-out recordings are measured.
    """

    config: RunConfig
    run: Run
    processes: Processes
    held_out: HeldOutMetrics

    def resume(self) -> tuple[int, dict[str, Any] | None]:
        """Return the last checkpoint's step and state, or (0, None); drop later log lines."""
        done, state = self.run.checkpoints.latest() or (0, None)
        if self.processes.is_first:
            if state is not None:
                log.info("Resuming after step %d.", done)
            self.run.forget_metrics_after(done)
        # No process writes a checkpoint before all have read the latest one.
        self.processes.wait()
        return done, state

    def progress(self, stages: Sequence[tuple[int, float]], done: int) -> Steps:
        """Return the progress bar of a training, to be used in a `with` block around its steps.

        Args:
            stages: (number of steps, relative cost of a step) of each.
            done: steps before this run was resumed.
        """
        quiet = not self.processes.is_first
        self._progress = Steps(stages, done, quiet=quiet, noun=self.config.noun)
        return self._progress

    def begin(self, steps: range, cost: float = 1.0, name: str = "", **labels: int | str) -> range:
        """Begin a stage, consecutive steps on the same networks, and return its steps.

        Args:
            steps: their numbers, counted from 1 over the whole training.
            cost: relative cost of a step.
            name: shown beside the progress.
            labels: of each log line.
        """
        self._last, self._cost, self._name, self._labels = steps.stop - 1, cost, name, labels
        self._losses: list[Mapping[str, Tensor | float]] = []
        self._clock = time.monotonic()
        return steps

    def count(self, step: int, losses: Mapping[str, Tensor | float], **values: float) -> Due:
        """Count a step; log the means of the losses if it is time to.

        Args:
            step: its number.
            losses: on this process's share of the batch, numbers or () tensors.
            values: further values of the log line, as they are.

        Raises:
            ModelError: a loss became NaN or infinite.
        """
        config, is_first, last = self.config, self.processes.is_first, step == self._last
        self._losses.append(losses)
        self._progress.step(self._cost)
        fires = bool(config.eval_every) and step % config.eval_every == 0
        evaluates = fires or (bool(config.eval_every) and last)
        logs = last or step % config.log_every == 0
        saves = last or step % config.checkpoint_every == 0
        means = self._means(step) if logs or saves or evaluates else {}
        if logs:
            pace = (time.monotonic() - self._clock) / len(self._losses)
            if is_first:
                line = {**means, **values, "seconds_per_iteration": pace}
                self.run.log(step, line, **self._labels)
                shown = ", ".join(f"{name} {value:.3g}" for name, value in means.items())
                self._progress.set_postfix_str(f"{self._name}{shown}")
            self._losses, self._clock = [], time.monotonic()
        measures = is_first and not last and (fires or self.held_out.is_due())
        return Due(evaluates and is_first, measures, saves)

    def save(self, step: int, weights: Iterable[Tensor], state: dict[str, Any]) -> None:
        """Write a checkpoint.

        Raises:
            ModelError: a weight became NaN or infinite.
        """
        norms = [weight.detach().norm() for weight in weights]
        self._check_finite(step, {"a weight": float(torch.stack(norms).sum())})
        if self.processes.is_first:
            self.run.checkpoints.save(step, state)

    def _means(self, step: int) -> dict[str, float]:
        """Return the mean of each loss over processes and the steps up to this one."""
        names = list(dict.fromkeys(name for losses in self._losses for name in losses))
        # A loss that a step does not have counts as 0.
        table = torch.stack(
            [torch.as_tensor(losses.get(name, 0.0)) for losses in self._losses for name in names]
        )
        rows = self.processes.mean(table).reshape(len(self._losses), len(names)).tolist()
        for number, row in enumerate(rows, start=step + 1 - len(rows)):
            self._check_finite(number, dict(zip(names, row, strict=True)))
        return {name: sum(column) / len(rows) for name, *column in zip(names, *rows, strict=True)}

    def _check_finite(self, step: int, values: Mapping[str, float]) -> None:
        """Raise ModelError before a checkpoint with values that are not finite is written."""
        wrong = [name for name, value in values.items() if not math.isfinite(value)]
        if not wrong:
            return
        kept = self.run.checkpoints.steps()
        after = f"the last checkpoint is of step {kept[-1]}" if kept else "there is no checkpoint"
        raise ModelError(
            f"step {step}: the loss became NaN or infinite ({', '.join(wrong)}); {after}. Try a "
            "smaller training.learning_rate"
        )


class Steps(Progress):
    """Progress bar over training steps of different cost.

    The time left is the cost of the remaining steps at the pace since the first step, which is not
    counted because it compiles.

    Args:
        stages: (number of steps, relative cost of a step) in order.
        done: steps before the training was resumed.
        quiet: print nothing.
        noun: name of a step.
    """

    def __init__(
        self, stages: Sequence[tuple[int, float]], done: int, *, quiet: bool, noun: str = "step"
    ) -> None:
        costs = [cost for steps, cost in stages for _ in range(steps)]
        self._cost_left = sum(costs[done:])
        self._paid = 0.0
        self._since: float | None = None
        self._is_said = quiet
        super().__init__(
            total=len(costs),
            initial=done,
            unit=noun,
            disable=quiet,
            bar_format=f"{{l_bar}}{{bar}}| {{n_fmt}} of {{total_fmt}} {noun}s, {{elapsed}} passed, "
            "{remaining} left{postfix}",
        )

    def step(self, cost: float) -> None:
        """Count a finished step."""
        self._cost_left -= cost
        if self._since is None:
            self._since = time.monotonic()
        else:
            self._paid += cost
        self.update()
        passed = time.monotonic() - self._since
        if not self._is_said and passed >= _SAID_AFTER and self._paid:
            self._is_said = True
            left, time_left = self.total - self.n, roughly(self.seconds_left)
            log.info(
                "Time left: about %s for %d of %d %ss.", time_left, left, self.total, self.unit
            )

    @property
    def seconds_left(self) -> float:
        """Return the estimated seconds of the remaining steps; 0 before they are known."""
        if self._since is None or not self._paid:
            return 0.0
        return self._cost_left * (time.monotonic() - self._since) / self._paid

    @property
    def format_dict(self) -> dict[str, Any]:
        """Return tqdm's values, with the rate that gives this estimate of the time left."""
        values = super().format_dict
        if left := self.seconds_left:
            values["rate"] = (self.total - self.n) / left
        return values


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
    return min(timeit.repeat(work, timer=time.monotonic, repeat=times, number=1))
