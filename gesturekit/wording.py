"""Numbers and names in messages: one way to write them for all verbs."""

from __future__ import annotations


def counted(number: int, noun: str) -> str:
    """ "1 joint", "2 joints"."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def span(seconds: float) -> str:
    """ "68.83 s", "12.5 min", "3.2 h"."""
    if seconds < 120:
        return f"{seconds:.2f} s"
    return f"{seconds / 60:.1f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def roughly(seconds: float) -> str:
    """ "40 s", "13 min", "3.2 h": an estimate, or a total whose fractions do not matter."""
    if seconds < 90:
        return f"{max(seconds, 1):.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
