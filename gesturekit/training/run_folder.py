"""Run folder: files to inspect, resume or repeat a training; its checkpoints and state."""

from __future__ import annotations

import importlib.metadata
import io
import json
import logging
import platform
import re
import shlex
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from audio_features.archive import parse_json, read_bytes
from audio_features.atomic import atomic_write, remove_unfinished, write_text
from gesturekit.errors import ConfigError, ModelError
from gesturekit.jobs.records import claimed, running
from gesturekit.training.config import dotted, dump_yaml, read_yaml
from gesturekit.training.report import write_report

log = logging.getLogger(__name__)

CLAIM = ".claim"
"""Folder within a run of the claim of the process that trains it."""

_CHECKPOINT = re.compile(r"step_(\d+)\.pt")
_KEPT = 2
"""Number of checkpoints that are kept."""

_MOST_RIG = 64 << 20  # bytes of skeleton.json

_MOST_SHARE = 0.005
"""Largest share of the training time spent on the report."""
_LEAST_SECONDS = 2.0  # between two reports

_VERSIONS_OF = ("gesturekit", "torch", "numpy", "scipy", "librosa", "soxr", "transformers")

# These settings do not change what a run computes, so they may change when it is resumed.
_REPORTING = ("out", "checkpoint_every", "log_every", "eval_every", "measure", "arrays", "workers")
_BEFORE_CONFIG = ("data", "command.txt", "versions.json")  # written before config.yaml


def is_running(folder: Path) -> bool:
    """Return whether a living process trains a run."""
    return bool(running(folder / CLAIM))


def read_rig(folder: Path) -> Any:
    """Return the content of the skeleton.json of a model folder.

    Raises:
        ModelError: it is missing, damaged or over 64 MiB.
    """
    file = folder / "skeleton.json"
    return parse_json(read_bytes(file, _MOST_RIG, ModelError), str(file), ModelError)


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


class Checkpoints:
    """The `checkpoints/` folder of a run: the last few files such as `step_00000150.pt`.

    The state consists of tensors, numbers, strings, lists and dicts only, so that it can be
    read back with `torch.load(weights_only=True)`.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def steps(self) -> list[int]:
        """Return the steps that have a checkpoint, oldest first."""
        matches = (_CHECKPOINT.fullmatch(path.name) for path in self.folder.glob("*"))
        return sorted(int(match[1]) for match in matches if match)

    def path(self, step: int) -> Path:
        """Return the path of a step's checkpoint."""
        return self.folder / f"step_{step:08d}.pt"

    def save(self, step: int, state: dict[str, Any]) -> None:
        """Write the state of `step`, then delete all but the last checkpoints."""
        import torch

        remove_unfinished(self.path(step))  # of a run that was killed while it wrote it
        with atomic_write(self.path(step)) as temporary:
            # In memory first: torch raises a RuntimeError without a reason on a full disk.
            content = io.BytesIO()
            torch.save(state, content)
            temporary.write_bytes(content.getbuffer())
        for old in self.steps()[:-_KEPT]:
            self.path(old).unlink()

    def latest(self) -> tuple[int, dict[str, Any]] | None:
        """Return step and state of the newest readable checkpoint; None without checkpoints.

        A damaged one is logged, and the one before it is tried.

        Raises:
            ModelError: there are checkpoints, and none can be read.
        """
        import torch

        steps = self.steps()
        for step in reversed(steps):
            try:
                return step, torch.load(self.path(step), weights_only=True, map_location="cpu")
            except Exception as error:  # torch raises half a dozen kinds for a damaged file
                log.warning("%s cannot be read (%s); trying the one before", self.path(step), error)
        if steps:
            raise ModelError(f"{self.folder}: none of its {len(steps)} checkpoints can be read")
        return None


class Run:
    """A run folder: `config.yaml`, `command.txt`, `versions.json`, `metrics.jsonl`,
    `report.html`, TensorBoard events under `events/`, `checkpoints/`, and at the end `model/`.

    Args:
        folder: where the run lives.
        config: the resolved configuration as plain values.
        resume: continue the run in the folder. Without it the folder must not hold a run.

    Raises:
        ConfigError: the folder holds a run already, holds none to resume, or holds one of
            another configuration.
    """

    def __init__(self, folder: Path, config: dict[str, Any], *, resume: bool) -> None:
        self.folder = folder
        self._config = config
        self._resume = resume
        self.checkpoints = Checkpoints(folder / "checkpoints")
        self._metrics = folder / "metrics.jsonl"
        self._events: Any = None
        self._claim = ExitStack()
        self._report_due = 0.0
        self._check()

    def _check(self) -> None:
        """Compare the folder with what is to be done in it; see the class for the errors."""
        folder, file, problem = self.folder, self.folder / "config.yaml", ""
        if folder.exists() and not folder.is_dir():
            problem = f"{folder}: a file, not a run folder; name a folder by out=OTHER"
        elif not self._resume and file.exists():
            state = unfinished(folder) or f"{folder}: holds a finished training already"
            problem = f"{state}; a new one goes to another folder, out=OTHER"
        elif self._resume and not file.is_file():
            problem = f"{folder}: no run to resume here; start it without --resume"
        elif self._resume:
            before, config = dotted(read_yaml(file)), dotted(self._config)
            for key in sorted({*before, *config} - {*_REPORTING}):
                if (was := before.get(key)) != (now := config.get(key)):
                    problem = f"{file}: the run was started with {key}: {was!r}, now it is {now!r}"
                    problem += "; resume with the same settings or start anew"
                    break
        if problem:
            raise ConfigError(problem)

    @property
    def has_begun(self) -> bool:
        """Return True if the folder holds a run that can be resumed."""
        return (self.folder / "config.yaml").is_file()

    def begin(self) -> None:
        """Write the files that mark the folder as a run, once the training data is read."""
        write_text(self.folder / "command.txt", shlex.join(sys.argv) + "\n")
        write_text(self.folder / "versions.json", json.dumps(_versions(), indent=1) + "\n")
        # Last: a folder with a config.yaml holds a run.
        write_text(self.folder / "config.yaml", dump_yaml(self._config))

    def hold(self) -> None:
        """Keep other processes out of the folder until `close`, before anything is written.

        Raises:
            ConfigError: another process trains in the folder, or has done so meanwhile.
        """
        self._claim.enter_context(claimed(self.folder / CLAIM))
        self._claim.callback(self._clear)
        self._check()

    def forget_metrics_after(self, step: int) -> None:
        """Drop lines that a killed run wrote after its last checkpoint."""
        if self._metrics.exists():
            kept = [f"{json.dumps(line)}\n" for line in self._logged() if line["step"] <= step]
            write_text(self._metrics, "".join(kept))

    def _logged(self) -> Iterator[dict[str, Any]]:
        """Yield the lines of `metrics.jsonl`, without one that was being written at a kill."""
        if self._metrics.exists():
            for line in self._metrics.read_text(encoding="utf-8").splitlines():
                with suppress(ValueError):
                    yield json.loads(line)

    def log(self, step: int, values: dict[str, float], **labels: int | str) -> None:
        """Add a line to `metrics.jsonl`, and renew the report.

        TensorBoard gets the same numbers if the extra `tensorboard` is installed.
        """
        if self._events is None:
            with suppress(ImportError):
                from torch.utils.tensorboard import SummaryWriter

                self._events = SummaryWriter(str(self.folder / "events"), purge_step=step)
        self.folder.mkdir(parents=True, exist_ok=True)
        with self._metrics.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"step": step, **labels, **values}) + "\n")
        if self._events is not None:
            for name, value in values.items():
                self._events.add_scalar(name, value, step)
        began = time.monotonic()
        if began >= self._report_due:
            write_report(self.folder, [*self._logged()], is_running=True)
            end = time.monotonic()
            self._report_due = end + max(_LEAST_SECONDS, (end - began) / _MOST_SHARE)

    def last_metrics(self) -> dict[str, float]:
        """Return the last logged losses, without step, labels and timing."""
        last = ([line for line in self._logged() if "kind" not in line] or [{}])[-1]
        last.pop("seconds_per_iteration", None)
        return {name: value for name, value in last.items() if isinstance(value, float)}

    def evaluations(self, level: int) -> list[dict[str, Any]]:
        """Return the log lines with `kind: evaluation` of a level, oldest first."""
        lines = (line for line in self._logged() if line.get("kind") == "evaluation")
        return [line for line in lines if line.get("level") == level]

    def has(self, step: int, kind: str) -> bool:
        """Return True if a line of this kind was logged for a step."""
        return any(line.get("kind") == kind and line["step"] == step for line in self._logged())

    def close(self) -> None:
        """Finish writing TensorBoard events and the report, and give the folder back."""
        if self._report_due:
            write_report(self.folder, [*self._logged()], is_running=False)
        if self._events is not None:
            self._events.close()
        self._claim.close()

    def _clear(self) -> None:
        shutil.rmtree(self.folder / CLAIM, ignore_errors=True)
        with suppress(OSError):
            self.folder.rmdir()  # of a training that did not begin


def has_no_run(folder: Path) -> bool:
    """Return whether a folder is missing, empty, or has only what a run killed at its start left.

    A folder with anything else may have been named by mistake.
    """
    if folder.exists() and not folder.is_dir():
        return False
    names = [path.name for path in folder.glob("*")]
    return all(name in _BEFORE_CONFIG or name.startswith(".") for name in names)


def _versions() -> dict[str, str]:
    import torch

    versions = {"python": platform.python_version(), "platform": platform.platform()}
    versions["cpu threads"] = str(torch.get_num_threads())
    for name in _VERSIONS_OF:
        versions[name] = "not installed as a package"
        with suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    return versions
