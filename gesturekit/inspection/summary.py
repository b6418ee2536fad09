"""Summaries as text and as JSON."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

_LABEL = 15  # columns that labels take at most
_PROBLEMS = 8


@dataclass
class Summary:
    """A summary of a file or folder.

    Attributes:
        kind: motion, audio, features, model, corpus, run, or other.
        title: description in one line.
        facts: plain values for JSON.
        rows: {label: text} for display; those without a text are removed.
        problems: one line each.
        tree: lines of a drawing for display.
    """

    kind: str
    title: str
    facts: dict[str, Any]
    rows: Mapping[str, str]
    problems: Sequence[str] = ()
    tree: Sequence[str] = ()

    def __post_init__(self) -> None:
        self.rows = {label: text for label, text in self.rows.items() if text}

    def lines(self, width: int) -> list[str]:
        """Return the summary as lines of at most `width` columns."""
        rows = [*self.rows.items(), *(("problem", text) for text in self.problems[:_PROBLEMS])]
        if len(self.problems) > _PROBLEMS:
            rows.append(("problem", f"and {len(self.problems) - _PROBLEMS} more; --json has all"))
        column = 4 + min(_LABEL, max((len(label) for label, _ in rows), default=0))
        lines = _wrapped(self.title, width, "", "")
        for label, text in rows:
            lines += _wrapped(text, width, f"  {label} ".ljust(column), " " * column)
        lines += [""] if self.tree else []
        for branch in self.tree:
            below = " " * (len(branch) - len(branch.lstrip()) + 4)
            lines += _wrapped(branch, width, "", below)
        return lines

    def to_json(self) -> dict[str, Any]:
        """Return plain values; NaN and infinity become null."""
        return _plain({"kind": self.kind, **self.facts, "problems": list(self.problems)})


def _wrapped(text: str, width: int, first: str, rest: str) -> list[str]:
    wrapper = textwrap.TextWrapper(width, first, rest, break_long_words=False)
    wrapper.break_on_hyphens = False
    return wrapper.wrap(text)


def size(n_bytes: float) -> str:
    """Format a size: "3.7 MB"."""
    return f"{n_bytes / 1e6:.1f} MB" if n_bytes >= 1e6 else f"{n_bytes / 1e3:.1f} kB"


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
    is_number = not isinstance(value, float) or math.isfinite(value)
    return value if is_number else None
