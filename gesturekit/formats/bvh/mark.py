"""The mark in BVH files that we write: their unit, with Y up and +Z forward.

BVH has no field for these, and other readers stop at comments or blank lines. Our root's OFFSET is
always zero, and the mark is the number of decimals of its three zeros: every reader sees 0 0 0. It
survives other line ends, indentation and trimmed blanks. A program that writes the file anew
writes zeros of its own form; unit and axes are then detected as in any other file.
"""

from __future__ import annotations

# Three different numbers of decimals: no other writer formats three zeros like that.
_DECIMALS = {"m": (6, 7, 8), "cm": (6, 8, 7), "mm": (7, 6, 8), "inch": (7, 8, 6), "cmu": (8, 6, 7)}
_MARKS = {unit: " ".join(f"{0:.{n}f}" for n in places) for unit, places in _DECIMALS.items()}
_UNITS = {mark: unit for unit, mark in _MARKS.items()}

UP, FORWARD = "y", "z"
"""Axes of a file that is marked."""


def mark(unit: str) -> str:
    """Return the three zeros of the root's OFFSET in a file of that unit."""
    return _MARKS[unit]


def marked_unit(offset: str) -> str | None:
    """Return the unit that the root's OFFSET, as written in a file, is the mark of; or None."""
    return _UNITS.get(" ".join(offset.split()))
