"""Progress of a training: steps done, time passed, time left."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from typing import Any

from gesturekit.progress import Progress
from gesturekit.wording import roughly

log = logging.getLogger(__name__)

_SAID_AFTER = 3.0
"""Seconds of training after which its length is estimated and logged, once."""


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
