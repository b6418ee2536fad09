"""State of a run folder: which process trains it, and whether its model is written."""

from __future__ import annotations

import shlex
from pathlib import Path

from gesturekit.jobs.records import running

CLAIM = ".claim"
"""Folder within a run of the claim of the process that trains it."""


def is_running(folder: Path) -> bool:
    """Return whether a living process trains a run."""
    return bool(running(folder / CLAIM))


def unfinished(folder: Path) -> str:
    """Return why a folder is no model yet: an unfinished run, or the model of one; else ""."""
    run = folder.parent if folder.name == "model" else folder
    is_run = all((run / name).is_file() for name in ("config.yaml", "versions.json"))
    if not is_run or (run / "model" / "config.yaml").is_file():
        return ""
    if is_running(run):
        return f"{run}: this training is still running; its model is written at the end"
    return f"{run}: this training is not finished; {resume_command(run)}"


def resume_command(run: Path, processes: int = 1) -> str:
    """Return the command line that resumes a run of so many processes."""
    several = ["torchrun", "--nproc_per_node", str(processes), "-m", "gesturekit"]
    program = ["gesturekit"] if processes == 1 else several
    return shlex.join([*program, "train", "--resume", str(run)])
