"""Preview of a rendering: its plan, time and size."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import soundfile

from gesturekit.rendering.execution import Batch
from gesturekit.rendering.render import Outcome, Work
from gesturekit.rendering.tasks import Task

_SAMPLE_SECONDS = 5.0


@dataclass(frozen=True)
class Preview:
    """Plan for one task.

    Attributes:
        task: the task.
        action: "make"; "keep" for a result that is up to date; "fail" if it cannot be done, or was
            put aside.
        targets: files to write, or those that are kept.
        reason: reason of "fail".
    """

    task: Task
    action: Literal["make", "keep", "fail"]
    targets: tuple[Path, ...]
    reason: str | None = None


@dataclass(frozen=True)
class Cost:
    """Cost of one second of sound, measured on this machine.

    Attributes:
        seconds: time in one process.
        bytes: size of its files.
    """

    seconds: float
    bytes: float


def preview(batch: Batch) -> Iterator[Preview]:
    """Yield what would be done about each task; nothing is written."""
    for task in batch.tasks:
        work = batch.work_on(task)
        if isinstance(work, Outcome):
            action = "keep" if work.error is None else "fail"
            yield Preview(task, action, work.kept, work.error)
        else:
            targets = batch.renderer.targets(task)
            left = tuple(file for file in targets if file not in work.kept)
            yield Preview(task, "make", left)


def measured_cost(batch: Batch) -> Cost:
    """Render a few seconds of noise into a temporary folder, twice, and measure the second time.

    Both costs are 0 if the model cannot render noise with these settings.
    """
    with tempfile.TemporaryDirectory(prefix="gesturekit-") as folder:
        renderer = replace(batch.renderer, out=Path(folder))
        wav = Path(folder) / "sample.wav"
        noise = np.random.default_rng(0).standard_normal(int(_SAMPLE_SECONDS * 16_000))
        soundfile.write(wav, 0.1 * noise, 16_000)
        if renderer.seconds is not None:
            task = Task("sample", "sample", duration=renderer.seconds)
        else:
            task = Task(str(wav), "sample", wav)
        renderer(Work(task))  # the first time includes compilation
        done = renderer(Work(task)).entry
        size = sum(about["size"] for about in done.files.values())
        sound = max(done.sound, 1e-3)
        return Cost(done.seconds / sound, size / sound)
