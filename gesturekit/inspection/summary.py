"""Summaries as text and as JSON."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

_LABEL = 15  # columns that labels take at most
_PROBLEMS = 8


@dataclass(frozen=True)
class Summary:
    """A summary of a file or folder.

    Attributes:
        kind: motion, audio, features, model, corpus, run, or other.
        title: description in one line.
        facts: plain values for JSON.
        rows: (label, text) pairs for display.
        drawing: returns further lines for display, for a width in columns.
        problems: one line each.
    """

    kind: str
    title: str
    facts: dict[str, Any]
    rows: tuple[tuple[str, str], ...] = ()
    drawing: Callable[[int], Sequence[str]] | None = None
    problems: tuple[str, ...] = ()

    def lines(self, width: int) -> list[str]:
        """Return the summary as lines of at most `width` columns."""
        shown = [("problem", problem) for problem in self.problems[:_PROBLEMS]]
        if len(self.problems) > _PROBLEMS:
            shown.append(("problem", f"and {len(self.problems) - _PROBLEMS} more; --json has all"))
        rows = [*self.rows, *shown]
        column = 4 + min(_LABEL, max((len(label) for label, _ in rows), default=0))
        lines = textwrap.wrap(self.title, width)
        for label, text in rows:
            lines += textwrap.wrap(
                text,
                width,
                initial_indent=f"  {label} ".ljust(column),
                subsequent_indent=" " * column,
                break_on_hyphens=False,
            )
        return [*lines, "", *self.drawing(width)] if self.drawing else lines

    def to_json(self) -> dict[str, Any]:
        """Return plain values; NaN and infinity (the level of silence is -inf dB) become null."""
        return _plain({"kind": self.kind, **self.facts, "problems": list(self.problems)})


def size(n_bytes: float) -> str:
    """Format a size: "3.7 MB"."""
    for unit in ("bytes", "kB", "MB"):
        if n_bytes < 1000:
            return f"{n_bytes:.0f} {unit}" if unit == "bytes" else f"{n_bytes:.1f} {unit}"
        n_bytes /= 1000
    return f"{n_bytes:.1f} GB"


def span(seconds: float) -> str:
    """Format a duration: "68.83 s", "12.5 min", "3.2 h"."""
    if seconds < 120:
        return f"{seconds:.2f} s"
    return f"{seconds / 60:.1f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, float):
        return round(value, 6) if math.isfinite(value) else None
    return value if isinstance(value, bool | int | str | None) else str(value)
