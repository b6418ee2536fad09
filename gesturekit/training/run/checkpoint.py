"""Checkpoints: training state on disk, written atomically."""

from __future__ import annotations

import io
import logging
import re
from pathlib import Path
from typing import Any

import torch

from audio_features.atomic import atomic_write, remove_unfinished
from gesturekit.errors import ModelError

log = logging.getLogger(__name__)
_NAME = re.compile(r"step_(\d+)\.pt")


class Checkpoints:
    """The `checkpoints/` folder of a run: the last few files such as `step_00000150.pt`.

    The state consists of tensors, numbers, strings, lists and dicts only, so that it can be
    read back with `torch.load(weights_only=True)`.

    Args:
        folder: where they lie.
        settings: digest of the run's settings, which each of them holds; None reads those of any
            run.
        keep: number of checkpoints that are kept.
    """

    def __init__(self, folder: Path, settings: str | None = None, keep: int = 2) -> None:
        self.folder = folder
        self.settings = settings
        self.keep = keep

    def steps(self) -> list[int]:
        """Return the steps that have a checkpoint, oldest first."""
        if not self.folder.is_dir():
            return []
        found = (_NAME.fullmatch(path.name) for path in self.folder.iterdir())
        return sorted(int(match[1]) for match in found if match)

    def path(self, step: int) -> Path:
        """Return the path of a step's checkpoint."""
        return self.folder / f"step_{step:08d}.pt"

    def save(self, step: int, state: dict[str, Any]) -> None:
        """Write the state of `step`, then delete all but the last `keep` checkpoints."""
        remove_unfinished(self.path(step))  # of a run that was killed while it wrote it
        with atomic_write(self.path(step)) as temporary:
            # In memory first: torch raises a RuntimeError without a reason on a full disk.
            content = io.BytesIO()
            torch.save({**state, "settings": self.settings}, content)
            temporary.write_bytes(content.getbuffer())
        for old in self.steps()[: -self.keep]:
            self.path(old).unlink()

    def latest(self) -> tuple[int, dict[str, Any]] | None:
        """Return step and state of the newest readable checkpoint; None without checkpoints.

        A damaged one is logged, and the one before it is tried.

        Raises:
            ModelError: there are checkpoints, and none can be read, or one is of another run.
        """
        steps = self.steps()
        for step in reversed(steps):
            try:
                state = torch.load(self.path(step), weights_only=True, map_location="cpu")
                settings = state.pop("settings", None)
                if self.settings in (settings, None):
                    return step, state
            except Exception as error:  # torch raises half a dozen kinds for a damaged file
                log.warning("%s cannot be read (%s); trying the one before", self.path(step), error)
                continue
            raise ModelError(
                f"{self.path(step)}: a checkpoint of another run (its settings have the digest "
                f"{str(settings)[:12]}, not {self.settings[:12]}); move it away, and resume again"
            )
        if steps:
            raise ModelError(f"{self.folder}: none of its {len(steps)} checkpoints can be read")
        return None
