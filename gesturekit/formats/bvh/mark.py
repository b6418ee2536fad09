"""Mark of the unit in BVH files that we write, which have Y up and +Z forward.

BVH has no field for the unit, and some readers fail on comments or blank lines. Our root's OFFSET
is always zero, and the mark is the number of decimals of its three zeros, so every reader sees
0 0 0. It survives changed line ends, indentation and trailing spaces. A program that rewrites the
file formats the zeros in its own way; unit and axes are then detected as in any other file.
"""

from __future__ import annotations

# No other program writes three zeros with different numbers of decimals.
_DECIMALS = {"m": (6, 7, 8), "cm": (6, 8, 7), "mm": (7, 6, 8), "inch": (7, 8, 6), "cmu": (8, 6, 7)}
_MARKS = {unit: " ".join(f"{0:.{n}f}" for n in places) for unit, places in _DECIMALS.items()}
_UNITS = {mark: unit for unit, mark in _MARKS.items()}

UP, FORWARD = "y", "z"
"""Axes of a file that is marked."""


def unit_mark(unit: str) -> str:
    """Return the three zeros of the root's OFFSET in a file of that unit."""
    return _MARKS[unit]


def marked_unit(offset: str) -> str | None:
    """Return the unit marked by the root's OFFSET, as written in a file; None without a mark."""
    return _UNITS.get(" ".join(offset.split()))
