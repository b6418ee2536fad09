"""Table of the layouts by name."""

from __future__ import annotations

from pathlib import Path

from gesturekit.corpus.layouts.beat2 import read_beat2
from gesturekit.corpus.layouts.genea2023 import read_genea2023
from gesturekit.corpus.layouts.listing import Layout, Listing
from gesturekit.corpus.layouts.motion_corpora import read_100style, read_motorica, read_trinity
from gesturekit.corpus.layouts.seamless import read_seamless
from gesturekit.corpus.layouts.zeggs import read_zeggs
from gesturekit.errors import CorpusError
from gesturekit.wording import did_you_mean

LAYOUTS: dict[str, Layout] = {
    "beat2": read_beat2,
    "zeggs": read_zeggs,
    "genea2023": read_genea2023,
    "motorica": read_motorica,
    "100style": read_100style,
    "trinity": read_trinity,
    "seamless": read_seamless,
}
"""Readers of public corpora by name."""


def read_layout(name: str, folder: Path) -> Listing:
    """Read a public corpus by the name of its layout.

    Raises:
        CorpusError: an unknown layout, or the folder is not in its form.
    """
    if name not in LAYOUTS:
        hint = did_you_mean(name, LAYOUTS, "did you mean {}? ")
        raise CorpusError(f"layout {name!r}: {hint}there are {', '.join(LAYOUTS)}")
    return LAYOUTS[name](folder)
