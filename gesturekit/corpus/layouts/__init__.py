"""Readers of public corpora in the form in which they are published."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from gesturekit.errors import CorpusError
from gesturekit.wording import did_you_mean

if TYPE_CHECKING:
    from gesturekit.corpus.layouts.listing import Listing

LAYOUTS = {
    "beat2": "speech_corpora:read_beat2",
    "zeggs": "motion_corpora:read_zeggs",
    "genea2023": "speech_corpora:read_genea2023",
    "motorica": "motion_corpora:read_motorica",
    "100style": "motion_corpora:read_100style",
    "trinity": "motion_corpora:read_trinity",
    "seamless": "speech_corpora:read_seamless",
}
"""Module and function that read a corpus, by the name of its layout; imported on first use.

The function takes the folder and returns a `listing.Listing`. It raises CorpusError if the folder
is not in the corpus's form.
"""

HANDED = {
    "100style": (
        "BouncyLeft", "BouncyRight", "DragLeftLeg", "DragRightLeg", "LeanLeft", "LeanRight",
        "LeftHop", "LimpLeft", "LimpRight", "OnPhoneLeft", "OnPhoneRight", "RaisedLeftArm",
        "RaisedRightArm", "RightHop", "ShieldedLeft", "ShieldedRight", "SpinAntiClock",
        "SpinClock", "WalkingStickLeft", "WalkingStickRight",
    )
}  # fmt: skip
"""Styles of a corpus that distinguish left from right, by the name of its layout."""


def read_layout(name: str, folder: Path) -> Listing:
    """Read a public corpus by the name of its layout.

    Raises:
        CorpusError: an unknown layout, or the folder is not in its form.
    """
    if name not in LAYOUTS:
        hint = did_you_mean(name, LAYOUTS, "did you mean {}? ")
        raise CorpusError(f"layout {name!r}: {hint}there are {', '.join(LAYOUTS)}")
    module, _, function = LAYOUTS[name].partition(":")
    return getattr(import_module(f"{__name__}.{module}"), function)(folder)
