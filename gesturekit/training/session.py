"""A training under way: its processes, its device and its run folder, for as long as it lasts."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from gesturekit.training.config import to_dict
from gesturekit.training.device import prepare_device
from gesturekit.training.processes import Processes
from gesturekit.training.run import Run
from gesturekit.training.run_config import RunConfig


@contextmanager
def session(config: RunConfig, *, resume: bool) -> Iterator[tuple[Run, torch.device, Processes]]:
    """Join torchrun's processes if there are any, and open the run folder.

    Raises:
        ConfigError: `config.out` holds a run already (or none to resume), or no such device.
    """
    with Processes.from_environment(config.device) as processes:
        device = prepare_device(processes.device(config.device), config.threads)
        run = Run(config.out, to_dict(config), resume=resume)
        # All have looked at the folder before the first one makes it that of this run.
        processes.wait()
        try:
            yield run, device, processes
        finally:
            run.close()
