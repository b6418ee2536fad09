"""Groups of clips that are compared with recordings of their own: speakers, and styles of each."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

from gesturekit.evaluation.pairs import Pair
from gesturekit.evaluation.statistics.thresholds import LEAST_IN_STYLE


def groups_of(pairs: Sequence[Pair]) -> list[str]:
    """Return the group of each clip, such as "maya" or "maya, angry"; "" without a speaker.

    The styles of a speaker are groups of their own if each has recordings of `LEAST_IN_STYLE` or
    more.
    """
    styles: dict[str, dict[str, set[str]]] = defaultdict(lambda: defaultdict(set))
    for pair in pairs:
        styles[pair.speaker or ""][pair.style or ""].add(pair.stem)
    split = {
        speaker
        for speaker, stems in styles.items()
        if len(stems) > 1 and min(map(len, stems.values())) >= LEAST_IN_STYLE
    }
    return [
        ", ".join(filter(None, (pair.speaker, pair.style)))
        if (pair.speaker or "") in split
        else pair.speaker or ""
        for pair in pairs
    ]
