"""Balanced lists of comparisons: which pair a rater sees of which segment, and on which side.

Within a list all ordered pairs of systems occur equally often (the diffusion paper's design: with
four systems and 36 segments, each of the 12 ordered pairs three times), and a segment at most once.
Over the lists, segments, and pairs of each segment, are used equally often.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np
from scipy.optimize import linear_sum_assignment

from gesturekit.evaluation.statistics.answers import MISMATCHED
from gesturekit.study.clips import Segment
from gesturekit.study.config import StudyConfig


@dataclass(frozen=True)
class Comparison:
    """Two clips to compare; `left` and `right` are systems, as in the answers."""

    segment: Segment
    left: str
    right: str


def ordered_pairs(config: StudyConfig) -> list[tuple[str, str]]:
    """Return all pairs of systems to compare, either way round."""
    if config.design == "mismatch":
        return [
            pair
            for name in config.systems
            for pair in ((name, name + MISMATCHED), (name + MISMATCHED, name))
        ]
    return list(permutations(config.systems, 2))


def make_lists(config: StudyConfig, segments: Sequence[Segment]) -> list[list[Comparison]]:
    """Return the lists of a study, `config.lists` of them.

    Each style has its share of `config.pairs`; styles follow the order of `config.styles`, as in
    section 4.3.2 of the diffusion paper.
    """
    groups: dict[str, list[Segment]] = {style: [] for style in config.styles or [""]}
    for segment in segments:
        groups[segment.style].append(segment)
    groups = {style: group for style, group in groups.items() if group}
    made: list[list[Comparison]] = [[] for _ in range(config.lists)]
    wanted = config.pairs if config.pairs is not None else len(segments)
    for number, style in enumerate(groups):
        share = (wanted + number) // len(groups)
        rng = np.random.default_rng([config.seed, number])
        found = _balanced(ordered_pairs(config), groups[style], config.lists, share, rng)
        for whole, part in zip(made, found, strict=True):
            whole += part
    return made


def _balanced(
    pairs: list[tuple[str, str]],
    segments: list[Segment],
    n_lists: int,
    share: int,
    rng: np.random.Generator,
) -> list[list[Comparison]]:
    used = np.zeros((len(segments), len(pairs)))
    lists = []
    for _ in range(n_lists):
        n = min(share, len(segments))
        # Ties are broken at random: the fraction is below 1.
        chosen = np.argsort(used.sum(axis=1) + rng.random(len(segments)))[:n]
        order = np.argsort(used.sum(axis=0) + rng.random(len(pairs)))
        slots = np.resize(order, n)
        cost = used[np.ix_(chosen, slots)] + 0.5 * rng.random((n, n))
        rows, columns = linear_sum_assignment(cost)
        places = [(int(chosen[r]), int(slots[c])) for r, c in zip(rows, columns, strict=True)]
        for place in places:
            used[place] += 1
        lists.append([Comparison(segments[s], *pairs[p]) for s, p in places])
    return lists


def mismatches(segments: Sequence[Segment], seed: int) -> dict[str, Segment]:
    """Return {segment: another segment of the same folder} for mismatched motion.

    Every segment is the other one of one segment. A folder with a single segment takes part in the
    exchange of all such folders.
    """
    rng = np.random.default_rng([seed, len(segments)])
    groups: dict[str, list[Segment]] = defaultdict(list)
    for segment in segments:
        groups[segment.speaker].append(segment)
    alone = [name for name, group in groups.items() if len(group) == 1]
    if alone:
        rest = [segment for name in alone for segment in groups.pop(name)]
        if len(rest) == 1 and groups:
            groups[next(iter(groups))].append(rest[0])
        else:
            groups["/"] = rest
    found = {}
    for group in groups.values():
        order = [group[i] for i in rng.permutation(len(group))]
        found |= {a.name: b for a, b in zip(order, [*order[1:], order[0]], strict=True)}
    return found
