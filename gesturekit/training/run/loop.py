"""Bookkeeping that the trainers share: data, progress, log, finite check, checkpoints."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, TypeVar

import torch
from torch import Tensor

from gesturekit.errors import ModelError
from gesturekit.training.run.folder import Run
from gesturekit.training.run.held_out import HeldOutMetrics
from gesturekit.training.run.processes import Processes
from gesturekit.training.run.steps import Steps
from gesturekit.training.run_config import RunConfig
from gesturekit.wording import counted

log = logging.getLogger(__name__)


class _Data(Protocol):
    def save(self, folder: Path) -> None: ...


Data = TypeVar("Data", bound=_Data)


def read_once(
    run: Run,
    processes: Processes,
    *,
    resume: bool,
    read: Callable[[], Data],
    load: Callable[[Path], Data],
) -> Data:
    """Return the training data, which only the first process of a new run reads from the corpus.

    Args:
        run: folder in which the first process saves the data.
        processes: of the run.
        resume: all processes load what the run saved when it began.
        read: read the corpus.
        load: load what `Data.save` wrote into a folder.
    """
    folder = run.folder / "data"
    data = None
    if not resume and processes.is_first:
        data = read()
        data.save(folder)
        run.begin()
    processes.wait()
    return load(folder) if data is None else data


@dataclass(frozen=True)
class StageCallbacks:
    """Callbacks of a training stage: consecutive steps on the same networks.

    Attributes:
        train: run the step of this number, counted from 1 over the whole training, and return its
            losses on this process's share of the batch, numbers or () tensors.
        weights: return the parameters that it trains.
        state: return the content of a checkpoint.
        evaluate: log cheap metrics at a step, on the first process.
        measure: log metrics on held-out recordings at a step, on the first process.
        also: further values of a step's log line, as they are.
        labels: of each log line.
        name: shown beside the progress.
    """

    train: Callable[[int], Mapping[str, Tensor | float]]
    weights: Callable[[], Iterable[Tensor]]
    state: Callable[[], dict[str, Any]]
    evaluate: Callable[[int], object]
    measure: Callable[[int], object]
    also: Callable[[int], dict[str, float]] = lambda step: {}
    labels: Mapping[str, int | str] = field(default_factory=dict)
    name: str = ""


class Loop:
    """Run training steps; log, evaluate and save as often as the configuration says.

    Every `log_every` steps the means of the losses are logged, and every `checkpoint_every` steps
    a checkpoint is written; both also at the end of a stage. Only the first process writes.

    Args:
        config: of the run.
        run: its folder.
        processes: of the run.
        held_out: decides when held-out recordings are measured.
    """

    def __init__(
        self, config: RunConfig, run: Run, processes: Processes, held_out: HeldOutMetrics
    ) -> None:
        self.config = config
        self.run = run
        self.processes = processes
        self.held_out = held_out

    def announce(
        self, kind: Sequence[str], steps: int, contents: Sequence[str], unused: Sequence[str]
    ) -> None:
        """Log the run folder, kind of training, data and held-out recordings, on one process.

        Args:
            kind: system and mode of the training.
            steps: its length.
            contents: training data.
            unused: sentences about labels of the corpus, see `unused_labels`.
        """
        if self.processes.is_first:
            length = f"{counted(steps, self.config.noun)} (longer={self.config.longer:g})"
            log.info("Run folder %s: %s.", self.config.out, ", ".join([*kind, length]))
            log.info("Training on %s.", ", ".join(contents))
            for line in unused:
                log.warning("%s.", line)
            log.info("Measured at the end and every few minutes: %s.", self.held_out.what)

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

    def train(
        self, plan: Sequence[tuple[int, float]], done: int, make: Callable[[int], StageCallbacks]
    ) -> None:
        """Run the steps that are left.

        Args:
            plan: (number of steps, relative cost of a step) of each stage.
            done: steps before this run was resumed.
            make: return the callbacks of the stage of this index; called when its training begins.

        Raises:
            ModelError: the loss or a weight became NaN or infinite.
        """
        end = 0
        quiet = not self.processes.is_first
        with Steps(plan, done, quiet=quiet, noun=self.config.noun) as progress:
            for index, (count, cost) in enumerate(plan):
                begin, end = max(done, end), end + count
                if begin < end:
                    self._train(make(index), range(begin + 1, end + 1), progress, cost)

    def _train(self, stage: StageCallbacks, steps: range, progress: Steps, cost: float) -> None:
        config, is_first = self.config, self.processes.is_first
        losses: list[Mapping[str, Tensor | float]] = []
        clock = time.monotonic()
        for step in steps:
            losses.append(stage.train(step))
            progress.step(cost)
            last = step == steps[-1]
            fires = bool(config.eval_every) and step % config.eval_every == 0
            evaluates = fires or (bool(config.eval_every) and last)
            logs = last or step % config.log_every == 0
            saves = last or step % config.checkpoint_every == 0
            means = self._means(step, losses) if logs or saves or evaluates else {}
            if logs:
                pace = (time.monotonic() - clock) / len(losses)
                if is_first:
                    values = {**means, **stage.also(step), "seconds_per_iteration": pace}
                    self.run.log(step, values, **stage.labels)
                    shown = ", ".join(f"{name} {value:.3g}" for name, value in means.items())
                    progress.set_postfix_str(f"{stage.name}{shown}")
                losses, clock = [], time.monotonic()
            if evaluates and is_first:
                stage.evaluate(step)
            if is_first and not last and (fires or self.held_out.is_due()):
                stage.measure(step)
            if saves:
                norms = [weight.detach().norm() for weight in stage.weights()]
                self._check_finite(step, {"a weight": float(torch.stack(norms).sum())})
                if is_first:
                    self.run.checkpoints.save(step, stage.state())

    def _means(self, step: int, losses: Sequence[Mapping[str, Tensor | float]]) -> dict[str, float]:
        """Return the mean of each loss over processes and the steps up to this one."""
        names = list(dict.fromkeys(name for values in losses for name in values))
        # A loss that a step does not have counts as 0.
        table = torch.stack(
            [torch.as_tensor(values.get(name, 0.0)) for values in losses for name in names]
        )
        rows = self.processes.mean(table).reshape(len(losses), len(names)).tolist()
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


def last_losses(run: Run) -> str:
    """Return the losses logged last, for a model's README."""
    losses = {name: value for name, value in run.last_metrics().items() if name != "learning_rate"}
    return ", ".join(f"{name} {value:.3g}" for name, value in losses.items())
