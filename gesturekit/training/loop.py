"""Bookkeeping that the trainers share: progress, log, finite check, checkpoints."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gesturekit.errors import ModelError
from gesturekit.progress import Progress
from gesturekit.training.held_out import HeldOutMetrics
from gesturekit.training.run_config import RunConfig
from gesturekit.training.run_folder import Run
from gesturekit.training.session import Processes
from gesturekit.wording import roughly

log = logging.getLogger(__name__)

_SAID_AFTER = 3.0
"""Seconds of training after which its length is estimated and logged, once."""


@dataclass(frozen=True)
class Due:
    """Work of this process that is due after a step; only the first one evaluates and measures."""

    evaluation: bool
    measurement: bool
    checkpoint: bool


class Loop:
    """Count training steps; log their losses, and say what else is due after each of them.

    Every `log_every` steps the means of the losses are logged, and every `checkpoint_every` steps
    a checkpoint is due; both also at the end of a stage. Only the first process writes.

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
        self._cost_left, skipped = 0.0, done
        for steps, cost in stages:
            self._cost_left += max(steps - skipped, 0) * cost
            skipped = max(skipped - steps, 0)
        self._paid = 0.0
        self._since: float | None = None
        self._is_said = quiet
        super().__init__(
            total=sum(steps for steps, _ in stages),
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
