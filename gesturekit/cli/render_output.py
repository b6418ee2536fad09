"""Output of `gesturekit render`: progress, files, failures and counts."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from gesturekit.rendering.execution import Batch
    from gesturekit.rendering.render import Outcome


class Summary:
    """Count and print the outcomes of a run with `samples` motions for each input."""

    def __init__(self, out: Path, samples: int) -> None:
        self.counts = {"rendered": 0, "kept": 0, "failed": 0}
        self._out, self._samples, self._begin = out, samples, time.monotonic()
        self._has_named_rate = False
        self._sound = 0.0

    def speed(self) -> str:
        """Return the rendered sound and how many times faster than real time that was."""
        factor = self._sound / max(time.monotonic() - self._begin, 1e-3)
        return f"{self._sound / 3600:.2f} h of sound, {factor:.1f}x real time"

    def add(self, outcome: Outcome, rate: float | None) -> None:
        """Print the files or the failure of an outcome, and once that its frame rate differs.

        Args:
            outcome: one input's.
            rate: frames per second of the model; None if they do not matter.
        """
        for file in outcome.files:
            click.echo(click.format_filename(file))
        differs = None not in (rate, outcome.fps) and abs(outcome.fps - rate) > 0.01 * rate
        if differs and not self._has_named_rate:
            click.echo(
                f"Written at {outcome.fps:g} fps; the model's own rate is {rate:g} fps "
                "(change it with --fps).",
                err=True,
            )
            self._has_named_rate = True
        if outcome.error is not None:
            click.echo(f"Failed: {outcome.error}", err=True)
        self._sound += outcome.sound
        done = "rendered" if outcome.files else "kept"
        self.counts["failed" if outcome.error is not None else done] += 1

    def __str__(self) -> str:
        from gesturekit.progress import time_in_words

        parts = [f"{n} {what}" for what, n in self.counts.items() if n or what == "rendered"]
        if self._samples > 1:
            parts[0] += f" ({self._samples * self.counts['rendered']} motions)"
        return f"{', '.join(parts)} in {time_in_words(time.monotonic() - self._begin)}: {self._out}"


def print_preview(batch: Batch) -> None:
    """Print what would be done about each task, and the sums."""
    from gesturekit.progress import time_in_words
    from gesturekit.rendering.preview import measured_cost, preview

    counts, sound = {"make": 0, "keep": 0, "fail": 0}, 0.0
    for found in preview(batch):
        length = found.task.duration
        where = ", ".join(map(str, found.targets)) or found.reason or ""
        shown = "      ? s" if length is None else f"{length:7.1f} s"
        source = click.format_filename(found.task.source)
        click.echo(f"{found.action}  {shown}  {source} -> {where}")
        counts[found.action] += 1
        sound += (length or 0.0) if found.action == "make" else 0.0
    seconds, size = measured_cost(batch).of(counts["make"], sound)
    took = time_in_words(seconds / batch.execution.workers)
    parts = ", ".join(f"{count} to {action}" for action, count in counts.items())
    click.echo(
        f"{parts}; {time_in_words(sound)} of sound, about {size / 1e6:.1f} MB and "
        f"{took} with {batch.execution.workers} of --workers, besides loading: {batch.out} "
        "(dry run: nothing was written)",
        err=True,
    )
