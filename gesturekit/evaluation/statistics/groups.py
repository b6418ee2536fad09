"""Groups of clips that are compared with recordings of their own: speakers, and styles of each."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from gesturekit.evaluation.pairs import Pair
from gesturekit.evaluation.statistics.intervals import Takes
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


def by_group(pairs: Sequence[Pair]) -> dict[str, np.ndarray]:
    """Return {group: (R, n) weights of n clips in R takes}, 0 for clips of other groups.

    They are those of `Takes.of`: with the weight of its takes, each clip counts in its group only.
    """
    takes, groups = Takes.of(pairs), np.array(groups_of(pairs))
    return {name: takes.weights * (groups == name) for name in sorted(set(groups.tolist()))}
