"""Balanced lists of comparisons: which pair a rater sees of which segment, and on which side.

Within a list all ordered pairs of systems occur equally often (the diffusion paper's design: with
four systems and 36 segments, each of the 12 ordered pairs three times), and a segment at most once.
That holds over all styles together, and within each style up to one. Over the lists, segments, and
pairs of each segment, are used equally often, or nearly so.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations

import numpy as np
from scipy.optimize import linear_sum_assignment

from gesturekit.evaluation.pairs import grouped
from gesturekit.evaluation.statistics.answers import MISMATCHED
from gesturekit.study.clips import Segment
from gesturekit.study.config import StudyConfig

Comparison = tuple[Segment, tuple[str, ...]]
"""Segment of a page, and its systems as in the answers, from left to right."""


def ordered_pairs(config: StudyConfig) -> list[tuple[str, ...]]:
    """Return all pairs of systems to compare, either way round; of ratings, all systems at once."""
    if config.design == "rating":
        return [tuple(config.systems)]
    sides = [[name, name + MISMATCHED] for name in config.systems]
    compared = sides if config.design == "mismatch" else [list(config.systems)]
    return [pair for systems in compared for pair in permutations(systems, 2)]


def make_lists(config: StudyConfig, segments: Sequence[Segment]) -> list[list[Comparison]]:
    """Return the lists of a study, `config.lists` of them.

    Each style has its share of `config.pairs`; styles follow the order of `config.styles`, as in
    section 4.3.2 of the diffusion paper.
    """
    by_style = [[s for s in segments if s.style == style] for style in config.styles or [""]]
    groups = [group for group in by_style if group]
    wanted = len(segments) if config.pairs is None else config.pairs
    pairs = ordered_pairs(config)
    lists: list[list[Comparison]] = [[] for _ in range(config.lists)]
    uses = np.zeros((config.lists, len(pairs)), int)  # of each pair in each list
    for number, group in enumerate(groups):
        n = min((wanted + number) // len(groups), len(group))
        rng = np.random.default_rng([config.seed, number])
        used = np.zeros((len(group), len(pairs)))
        for comparisons, in_list in zip(lists, uses, strict=True):
            for place, pair in _places(used, n, in_list, rng):
                used[place, pair] += 1
                in_list[pair] += 1
                comparisons.append((group[place], pairs[pair]))
    return lists


def _places(
    used: np.ndarray, n: int, in_list: np.ndarray, rng: np.random.Generator
) -> list[tuple[int, int]]:
    """Choose the segments and pairs of one style in one list, n (segment, pair).

    Args:
        used: (segments, pairs) number of uses in earlier lists.
        n: number of places, at most that of the segments.
        in_list: (pairs,) number of uses in this list, by its other styles.
        rng: breaks ties.
    """
    # Ties are broken at random: the fraction is below 1.
    chosen = np.argsort(used.sum(axis=1) + rng.random(len(used)))[:n]
    preference = used.sum(axis=0) + rng.random(len(in_list))
    # The first, second, ... use of each pair: those that even out the list come first.
    nth, pair = np.divmod(np.arange(n * len(in_list)), len(in_list))
    slots = pair[np.lexsort((preference[pair], nth, in_list[pair] + nth))[:n]]
    cost = used[np.ix_(chosen, slots)] + 0.5 * rng.random((n, n))
    rows, columns = linear_sum_assignment(cost)
    return [(int(chosen[r]), int(slots[c])) for r, c in zip(rows, columns, strict=True)]


def mismatches(segments: Sequence[Segment], seed: int) -> dict[str, Segment]:
    """Return {segment: another segment of the same folder} for mismatched motion.

    Every segment is the other one of one segment. A folder with a single segment takes part in the
    exchange of all such folders.
    """
    rng = np.random.default_rng([seed, len(segments)])
    groups = grouped((segment.speaker, segment) for segment in segments)
    alone = [name for name, group in groups.items() if len(group) == 1]
    if alone:
        rest = [segment for name in alone for segment in groups.pop(name)]
        if len(rest) == 1 and groups:
            groups[next(iter(groups))].append(rest[0])
        else:
            groups["/"] = rest
    found = dict[str, Segment]()
    for group in groups.values():
        order = [group[i] for i in rng.permutation(len(group))]
        found |= {a.name: b for a, b in zip(order, [*order[1:], order[0]], strict=True)}
    return found
