"""Output of `gesturekit render`: files, failures and counts."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from gesturekit.jobs.work import Outcome


class Summary:
    """Count and print the outcomes of a run with `samples` motions for each input."""

    def __init__(self, out: Path, samples: int) -> None:
        self.counts = {"rendered": 0, "kept": 0, "failed": 0}
        self._out, self._samples, self._begin = out, samples, time.monotonic()
        self._has_named_rate = False
        self._sound = 0.0

    def _speed(self) -> str:
        """Return the rendered sound and how many times faster than real time that was."""
        factor = self._sound / max(time.monotonic() - self._begin, 1e-3)
        return f"{self._sound / 3600:.2f} h of sound, {factor:.1f}x real time"

    def add(self, outcome: Outcome, rate: float | None) -> str:
        """Print the files or the failure of an outcome, and once that its frame rate differs.

        Args:
            outcome: one input's.
            rate: frames per second of the model; None if they do not matter.

        Returns:
            the speed so far, for a progress bar.
        """
        for file in outcome.files:
            click.echo(click.format_filename(file))
        fps = outcome.facts.get("fps")
        differs = None not in (rate, fps) and abs(fps - rate) > 0.01 * rate
        if differs and not self._has_named_rate:
            click.echo(
                f"Written at {fps:g} fps; the model's own rate is {rate:g} fps "
                "(change it with --fps).",
                err=True,
            )
            self._has_named_rate = True
        if outcome.error is not None:
            click.echo(f"Failed: {outcome.error}", err=True)
        self._sound += outcome.sound
        done = "rendered" if outcome.files else "kept"
        self.counts["failed" if outcome.error is not None else done] += 1
        return self._speed()

    def __str__(self) -> str:
        from gesturekit.progress import time_in_words

        parts = [f"{n} {what}" for what, n in self.counts.items() if n or what == "rendered"]
        if self._samples > 1:
            parts[0] += f" ({self._samples * self.counts['rendered']} motions)"
        return f"{', '.join(parts)} in {time_in_words(time.monotonic() - self._begin)}: {self._out}"
