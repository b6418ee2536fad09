"""Processes, device and run folder of a training."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import torch
from tqdm.contrib.logging import logging_redirect_tqdm

from gesturekit.errors import ModelError, OutputError, is_full
from gesturekit.progress import Progress
from gesturekit.training.config import to_dict
from gesturekit.training.run.device import memory_ran_out, prepare_device
from gesturekit.training.run.folder import Run
from gesturekit.training.run.processes import Processes
from gesturekit.training.run.state import resume_command
from gesturekit.training.run_config import RunConfig


@contextmanager
def session(
    config: RunConfig, *, resume: bool, folder: Path | None = None
) -> Iterator[tuple[Run, torch.device, Processes]]:
    """Join torchrun's processes, if any, and open the run folder.

    On Ctrl-C and on a full disk the error names the command that resumes the run.

    Args:
        config: of the run.
        resume: continue the run in the folder.
        folder: replaces `config.out` for a temporary run.

    Raises:
        ConfigError: `config.out` holds a run already (or none to resume), is being trained by
            another process, or no such device.
        ModelError: a GPU's memory ran out.
        OutputError: the disk of the run folder is full.
    """
    with (
        Processes.from_environment(config.device) as processes,
        logging_redirect_tqdm(tqdm_class=Progress),
        _quiet_threads(),
    ):
        device = prepare_device(processes.device(config.device), config.threads)
        run = Run(folder or config.out, to_dict(config), resume=resume)
        # All processes check the folder before the first one writes into it.
        processes.wait()
        try:
            with closing(run):
                if processes.is_first and folder is None:
                    run.hold()
                yield run, device, processes
        except KeyboardInterrupt:
            if processes.is_first and folder is None and run.has_begun:
                hint = f"Continue with: {resume_command(run.folder, processes.count)}"
                raise KeyboardInterrupt(hint) from None
            raise
        except torch.cuda.OutOfMemoryError as error:
            raise ModelError(
                f"device {device}: {memory_ran_out(error)}; set a smaller training.batch or "
                "training.window, or device=cpu"
            ) from error
        except OSError as error:
            if not is_full(error):
                raise
            again = "start again"
            if run.has_begun:
                command = resume_command(run.folder, processes.count)
                again = f"continue from the last checkpoint: {command}"
            raise OutputError(f"{run.folder}: {error.strerror}; make room, then {again}") from error


@contextmanager
def _quiet_threads() -> Iterator[None]:
    """Print no traceback of a thread that found the disk full.

    TensorBoard's thread of writing raises its error in the main thread too.
    """
    usual = threading.excepthook
    threading.excepthook = lambda failed: None if is_full(failed.exc_value) else usual(failed)
    try:
        yield
    finally:
        threading.excepthook = usual
