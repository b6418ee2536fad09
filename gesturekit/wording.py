"""Counts, lists and nearest names in messages, tables and warnings."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Sequence


def counted(number: int, noun: str, plural: str | None = None) -> str:
    """Return "1 joint", "2 joints"; `plural` for an irregular plural."""
    return f"{number} {noun if number == 1 else plural or noun + 's'}"


def listed(names: Sequence[str], most: int = 6) -> str:
    """Return names separated by commas; after the first `most`, only the number of others."""
    shown = ", ".join(names[:most])
    return shown if len(names) <= most else f"{shown} and {len(names) - most} more"


def printable(text: str) -> str:
    """Return a text with `?` for control characters and for bytes of names that are not text."""
    return "".join(sign if sign.isprintable() else "?" for sign in text)


def did_you_mean(
    name: str,
    known: Iterable[str],
    text: str = "did you mean {}?",
    *,
    most: int = 1,
    cutoff: float = 0.6,
) -> str:
    """Return `text` with the known names nearest to `name`; "" if none is near."""
    near = difflib.get_close_matches(name, list(known), most, cutoff)
    return text.format(", ".join(near)) if near else ""


def roughly(seconds: float) -> str:
    """Return a rounded duration: "40 s", "13 min" or "3.2 h"."""
    if seconds < 90:
        return f"{max(seconds, 1):.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def drawn(mean: float) -> str:
    """Return how often a second is drawn at random: "0.5 times (39% at least once)".

    What is drawn m times on average is drawn at least once with probability 1 - exp(-m), the
    Poisson distribution's.
    """
    count = f"{mean:.0f}" if mean >= 10 else f"{mean:.2g}"
    return f"{count} times ({1 - math.exp(-mean):.0%} at least once)"
