"""Plan of a training: its data, and an estimate of its time from a few steps."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import numpy as np

from gesturekit.errors import ConfigError
from gesturekit.training.config import to_dict
from gesturekit.training.recordings import Recordings
from gesturekit.training.run.folder import Run
from gesturekit.training.run.session import session
from gesturekit.training.run_config import RunConfig
from gesturekit.wording import roughly

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
        held_out: seconds of held-out recordings that are measured at the end.
        rates: bytes of arrays for each second of recordings, and of speech or motion without the
            other.
    """

    training: float
    held_out: float
    rates: tuple[float, float]


def log_plan(
    config: RunConfig,
    read: Callable[[], object],
    recordings: Callable[[], Recordings],
    trainer: Callable[..., Any],
) -> None:
    """Log the plan and estimated duration of a run, without its run folder.

    An excerpt of the corpus is read, and a few steps are timed on it, in a temporary folder.

    Args:
        config: of the run.
        read: reads the excerpt with its features.
        recordings: reads its motion.
        trainer: called as `trainer(config, run, device, processes, resume=False, trial=True)`;
            announces itself, and has `estimate() -> Estimate`.

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
        excerpt = silently(recordings, logging.WARNING)
        motion = quickest(lambda: [item.load_motion(config.parts) for item in excerpt.items], 1)
        # A motion file is read whole, however short the excerpt is.
        reading = motion * len(excerpt.whole[0]) / len(excerpt.items)
        # The first reading loaded libraries too.
        features = max(0.0, quickest(partial(silently, read, logging.WARNING), 1) - motion)
        reading += features * excerpt.lengths[0] / sum(item.duration for item in excerpt.items)
        if excerpt.is_long(config):
            size = np.dot(estimate.rates, excerpt.lengths)
            log.info(
                "Arrays of %.1f GB in %s; making those that are missing takes about %s.",
                size / 1e9,
                config.arrays_folder,
                roughly(reading / config.workers),
            )
            reading *= min(1.0, 60 * config.in_memory / sum(excerpt.lengths))
        seconds = started + reading + estimate.training + _MEASURING * estimate.held_out
        log.info(
            "Time: about %s on this machine while it is idle, %s to %s beside other programs. "
            "Nothing was written.",
            *map(roughly, (seconds, _FASTER * seconds, _SLOWER * seconds)),
        )


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


def log_arrays(config: RunConfig, are_used: bool) -> None:
    """Log where the arrays of a corpus are, if it has any."""
    if are_used:
        log.info("The arrays of %s are ready in %s.", config.corpus, config.arrays_folder)
    else:
        log.info("%s is held in memory: it needs no arrays (see in_memory).", config.corpus)


def quickest(work: Callable[[], object], times: int) -> float:
    """Return the seconds of the quickest of several calls, as other programs only add to them."""
    clock = [time.monotonic()]
    for _ in range(times):
        work()
        clock.append(time.monotonic())
    return min(after - before for before, after in pairwise(clock))
