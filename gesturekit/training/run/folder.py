"""Run folder: files to inspect, resume or repeat a training."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import platform
import shlex
import shutil
import sys
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from audio_features.atomic import atomic_write
from gesturekit.errors import ConfigError
from gesturekit.jobs.records import claimed
from gesturekit.training.config import dump_yaml, read_yaml
from gesturekit.training.run.checkpoint import Checkpoints
from gesturekit.training.run.report import RunReport
from gesturekit.training.run.state import CLAIM, unfinished

_VERSIONS_OF = ("gesturekit", "torch", "numpy", "scipy", "librosa", "soxr", "transformers")

# These settings do not change what a run computes, so they may change when it is resumed.
_REPORTING = ("out", "checkpoint_every", "log_every", "eval_every", "measure", "arrays", "workers")
_BEFORE_CONFIG = ("data", "command.txt", "versions.json")  # written before config.yaml


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
        self.checkpoints = Checkpoints(folder / "checkpoints", _digest(config))
        self._metrics = folder / "metrics.jsonl"
        self._events: Any = None
        self._claim = ExitStack()
        self._report = RunReport(folder)
        self._check()

    def _check(self) -> None:
        """Compare the folder with what is to be done in it; see the class for the errors."""
        folder, config_file = self.folder, self.folder / "config.yaml"
        if folder.exists() and not folder.is_dir():
            raise ConfigError(f"{folder}: a file, not a run folder; name a folder by out=OTHER")
        if self._resume:
            if not config_file.is_file():
                raise ConfigError(f"{folder}: no run to resume here; start it without --resume")
            before, config = _dotted(read_yaml(config_file)), _dotted(self._config)
            for key in sorted(set(before) | set(config)):
                if key not in _REPORTING and before.get(key) != config.get(key):
                    raise ConfigError(
                        f"{config_file}: the run was started with {key}: {before.get(key)!r}, now "
                        f"it is {config.get(key)!r}; resume with the same settings or start anew"
                    )
            return
        if config_file.exists():
            state = unfinished(folder) or f"{folder}: holds a finished training already"
            raise ConfigError(f"{state}; a new one goes to another folder, out=OTHER")

    @property
    def has_begun(self) -> bool:
        """Return True if the folder holds a run that can be resumed."""
        return (self.folder / "config.yaml").is_file()

    def begin(self) -> None:
        """Write the files that mark the folder as a run, once the training data is read."""
        self._write("command.txt", shlex.join(sys.argv) + "\n")
        self._write("versions.json", json.dumps(_versions(), indent=1) + "\n")
        # Last: a folder with a config.yaml holds a run.
        self._write("config.yaml", dump_yaml(self._config))

    def hold(self) -> None:
        """Keep other processes out of the folder until `close`, before anything is written.

        Raises:
            ConfigError: another process trains in the folder, or has done so meanwhile.
        """
        self._claim.enter_context(claimed(self.folder / CLAIM))
        self._claim.callback(self._clear)
        self._check()

    def _write(self, name: str, text: str) -> None:
        with atomic_write(self.folder / name) as temporary:
            temporary.write_text(text, encoding="utf-8")

    def forget_metrics_after(self, step: int) -> None:
        """Drop lines that a killed run wrote after its last checkpoint."""
        if not self._metrics.exists():
            return
        kept = []
        for line in self._metrics.read_text(encoding="utf-8").splitlines():
            try:
                if json.loads(line)["step"] <= step:
                    kept.append(line + "\n")
            except (ValueError, KeyError):
                continue  # the line that was being written when the run was killed
        with atomic_write(self._metrics) as temporary:
            temporary.write_text("".join(kept), encoding="utf-8")

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
        self._report.update()

    def last_metrics(self) -> dict[str, float]:
        """Return the last logged losses, without step, labels and timing."""
        lines = map(json.loads, self._metrics.read_text(encoding="utf-8").splitlines())
        losses = [logged for logged in lines if "kind" not in logged]
        logged = losses[-1] if losses else {}
        return {
            name: value
            for name, value in logged.items()
            if isinstance(value, float) and name != "seconds_per_iteration"
        }

    def evaluations(self, level: int) -> list[dict[str, Any]]:
        """Return the log lines with `kind: evaluation` of a level, oldest first."""
        if not self._metrics.exists():
            return []
        lines = map(json.loads, self._metrics.read_text(encoding="utf-8").splitlines())
        return [
            line
            for line in lines
            if line.get("kind") == "evaluation" and line.get("level") == level
        ]

    def has(self, step: int, kind: str) -> bool:
        """Return True if a line of this kind was logged for a step."""
        if not self._metrics.exists():
            return False
        lines = map(json.loads, self._metrics.read_text(encoding="utf-8").splitlines())
        return any(line.get("kind") == kind and line["step"] == step for line in lines)

    def close(self) -> None:
        """Finish writing TensorBoard events and the report, and give the folder back."""
        self._report.close()
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
    if not folder.exists():
        return True
    if not folder.is_dir():
        return False
    names = [path.name for path in folder.iterdir()]
    return all(name in _BEFORE_CONFIG or name.startswith(".") for name in names)


def _digest(config: dict[str, Any]) -> str:
    """Return a digest of the settings on which the results of a run depend."""
    values = {key: value for key, value in _dotted(config).items() if key not in _REPORTING}
    return hashlib.sha256(json.dumps(values, sort_keys=True, default=str).encode()).hexdigest()


def _dotted(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested keys as section.key, for error messages."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        name = f"{prefix}{key}"
        is_section = isinstance(value, dict) and value
        flat |= _dotted(value, f"{name}.") if is_section else {name: value}
    return flat


def _versions() -> dict[str, str]:
    import torch

    versions = {"python": platform.python_version(), "platform": platform.platform()}
    versions["cpu threads"] = str(torch.get_num_threads())
    for name in _VERSIONS_OF:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = "not installed as a package"
    return versions
