"""Floors and ceiling of likeness, from recordings alone.

Ceiling: disjoint sets of a speaker's takes against each other, drawn many times, with as many takes
and seconds as the model's set, or half of the takes that there are. Floors: takes of other
speakers, and the speaker's mean pose, against the speaker's takes. Where no speaker has a second
take, pieces of one take are compared with each other, which flatters: they share its mood.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gesturekit.errors import GestureKitError, MotionError
from gesturekit.evaluation.definitions import MOVEMENT, POOLED
from gesturekit.evaluation.measuring.baselines import held, mean_pose
from gesturekit.evaluation.measuring.clip_metrics import ClipMetrics
from gesturekit.evaluation.measuring.clips import Clip, load_recording
from gesturekit.evaluation.measuring.rigs import RETARGETED, matched
from gesturekit.evaluation.measuring.samples import copied
from gesturekit.evaluation.measuring.speakers import changed_windows
from gesturekit.evaluation.metrics.hands import upper_joints
from gesturekit.evaluation.metrics.two_sample import (
    MotionWindows,
    joined,
    nearer_votes,
    two_sample_accuracy,
)
from gesturekit.evaluation.pairs import Pair
from gesturekit.evaluation.results import OTHER_SPEAKER, Level
from gesturekit.evaluation.statistics.groups import groups_of
from gesturekit.evaluation.statistics.levels import CEILING, MEAN_POSE, level_of
from gesturekit.evaluation.statistics.likeness import credits, likeness_of_credits
from gesturekit.motion import Motion
from gesturekit.motion.parts import body_joints

MOST_SPEAKERS, MOST_TAKES, MOST_PIECES = 6, 24, 6
"""Speakers, takes of each and recordings (or pieces) of each take that are compared, at most."""
LONGEST = 30.0
"""Seconds of each recording or piece that are compared, at most."""
PIECES = 4
"""Pieces of a speaker's only recording."""
DRAWS = 20
"""Pairs of disjoint sets of takes, at most, that the ceiling is the mean of."""


@dataclass(frozen=True, eq=False)
class _Recorded:
    """A recording, its metrics, and its windows as they are, played backwards and mirrored."""

    pair: Pair
    motion: Motion
    values: Mapping[str, float]
    windows: tuple[MotionWindows, MotionWindows, MotionWindows] | None


_Set = list[_Recorded]


def likeness_levels(
    pairs: Sequence[Pair], held_out: int, fps: float, measure: ClipMetrics, seed: int
) -> dict[str, Level]:
    """Return {name of a level: level} of likeness, of those that the recordings give.

    Args:
        pairs: recordings, each with itself; the held-out ones first.
        held_out: number of held-out recordings: their speakers are judged.
        fps: frame rate of the evaluation.
        measure: the metrics of clips.
        seed: seed of subsamples.
    """
    groups = [group for group in (MOVEMENT, POOLED) if group in measure.groups]
    judge = _Judge(ClipMetrics(measure.statistics, groups, measure.variants), fps, seed)
    names = dict(zip(pairs, groups_of(pairs)))
    every = judge.read(_chosen(pairs), pairs[:held_out])
    judged = sorted({names[pair] for pair in pairs[:held_out]})
    own = {name: [one for one in every if names[one.pair] == name] for name in judged}
    own = {name: recorded for name, recorded in own.items() if recorded}
    several = {name for name, recorded in own.items() if len(_by_take(recorded)) > 1}
    scores: dict[str, list[float]] = {CEILING: [], OTHER_SPEAKER: [], MEAN_POSE: []}
    aspects: list[Mapping[str, float]] = []
    sizes, count = [], 0
    for name, recorded in own.items():
        takes = _by_take(recorded) if name in several else judge.pieces(recorded)
        within = takes if name in several or not several else []
        models = len({pair.take for pair in pairs[:held_out] if names[pair] == name})
        size = min(models if name in several else len(within), len(within) // 2)
        for ours, theirs in _disjoint(within, size, np.random.default_rng(seed)):
            score, credit = judge.score(ours, theirs)
            scores[CEILING] += [] if score is None else [score]
            aspects.append(credit)
        sizes.append(size)
        count += len(within)
        others, still = judge.of_others(recorded[0], every), judge.still(recorded)
        for level, sides in (
            (OTHER_SPEAKER, [(take, recorded) for take in others]),
            (MEAN_POSE, [([still], take) for take in takes]),
        ):
            known = (judge.score(ours, theirs)[0] for ours, theirs in sides)
            scores[level] += [score for score in known if score is not None]
    levels = {
        name: level_of(name, values, pieces=name != OTHER_SPEAKER and not several)
        for name, values in scores.items()
        if values
    }
    if CEILING in levels:
        keys = {key for credit in aspects for key in credit}
        means = {k: float(np.mean([c[k] for c in aspects if k in c])) for k in sorted(keys)}
        size = max(1, round(float(np.mean(sizes))))
        levels[CEILING] = replace(levels[CEILING], n=count, takes_compared=size, aspects=means)
    return levels


def _disjoint(
    takes: Sequence[_Set], size: int, rng: np.random.Generator
) -> Iterator[tuple[_Set, _Set]]:
    """Yield pairs of disjoint sets of `size` takes, each pair once, at most `DRAWS`."""
    seen: set[tuple[frozenset[int], frozenset[int]]] = set()
    for _ in range(3 * DRAWS if size else 0):
        order = rng.permutation(len(takes))
        sides = frozenset(order[:size].tolist()), frozenset(order[size : 2 * size].tolist())
        if len(seen) < DRAWS and sides not in seen:
            seen.add(sides)
            ours, theirs = ([one for at in sorted(side) for one in takes[at]] for side in sides)
            yield ours, theirs


def _chosen(pairs: Sequence[Pair]) -> list[Pair]:
    """Return recordings of some takes of some speakers, the held-out ones first, evenly chosen."""
    speakers: dict[str | None, dict[str, list[Pair]]] = {}
    for pair in pairs:
        speakers.setdefault(pair.speaker, {}).setdefault(pair.take, []).append(pair)
    chosen = []
    for takes in list(speakers.values())[:MOST_SPEAKERS]:
        kept = _evenly(list(takes.values()), MOST_TAKES)
        chosen += [pair for take in kept for pair in _evenly(take, MOST_PIECES)]
    return chosen


def _evenly(items: list, most: int) -> list:
    return items[:: -(-len(items) // most)]


def _by_take(recorded: Sequence[_Recorded]) -> list[list[_Recorded]]:
    takes: dict[tuple[str | None, str], list[_Recorded]] = {}
    for one in recorded:
        takes.setdefault((one.pair.speaker, one.pair.take), []).append(one)
    return list(takes.values())


@dataclass(frozen=True)
class _Judge:
    """Scores recordings against other recordings.

    Attributes:
        measure: metrics of movement.
        fps: frame rate of the evaluation.
        seed: seed of subsamples.
    """

    measure: ClipMetrics
    fps: float
    seed: int

    def read(self, pairs: Sequence[Pair], held_out: Sequence[Pair]) -> _Set:
        """Read and measure recordings; those that cannot be read are reported elsewhere.

        They are cut into pieces as long as the held-out recordings, as many of each take.
        """
        takes = {(pair.speaker, pair.take) for pair in held_out}
        most = min(MOST_PIECES, max(1, round(len(held_out) / len(takes))))
        found: list[tuple[Pair, Motion]] = []
        for pair in pairs:
            try:
                found.append((pair, load_recording(pair.reference, self.fps)))
            except GestureKitError:
                continue
        own = [motion.duration for pair, motion in found if pair in set(held_out)]
        length = round(min(LONGEST, float(np.median(own)) if own else LONGEST) * self.fps)
        counts: dict[tuple[str | None, str], int] = {}
        pieces = []
        for pair, motion in found:
            for start in range(0, max(1, motion.n_frames - length // 2), length):
                take = pair.speaker, pair.take
                if counts.get(take, 0) < most:
                    counts[take] = counts.get(take, 0) + 1
                    part = copied(motion, start, min(motion.n_frames, start + length))
                    pieces.append(self._measured(pair, part))
        return pieces

    def _measured(self, pair: Pair, motion: Motion) -> _Recorded:
        clip = Clip(pair, motion, motion, body_joints(motion.skeleton), None, ())
        try:
            windows = changed_windows([motion], upper_joints(motion.skeleton))
        except GestureKitError:
            windows = None
        return _Recorded(pair, motion, self.measure.recording(clip)[0], windows)

    def pieces(self, own: Sequence[_Recorded]) -> list[list[_Recorded]]:
        """Return the recordings of one take one by one, a single one in pieces."""
        if len(own) > 1:
            return [[one] for one in own]
        (whole,) = own
        cuts = np.linspace(0, whole.motion.n_frames, PIECES + 1).astype(int)
        parts = [whole.motion[a:b] for a, b in zip(cuts, cuts[1:]) if b - a > 1]
        return [[self._measured(whole.pair, part)] for part in parts]

    def of_others(self, own: _Recorded, every: Sequence[_Recorded]) -> list[list[_Recorded]]:
        """Return the takes of other speakers, brought to the rig of a recording."""
        moved = []
        for one in every:
            if one.pair.speaker == own.pair.speaker:
                continue
            try:
                _, motion, notes = matched(one.motion, own.motion)
            except MotionError:
                continue
            same = RETARGETED not in notes and motion.skeleton.names == one.motion.skeleton.names
            moved.append(one if same else self._measured(one.pair, motion))
        return _by_take(moved)

    def still(self, own: Sequence[_Recorded]) -> _Recorded:
        """Return the mean pose of recordings, of those on the rig of the first, held still."""
        rig = own[0].motion.skeleton.names
        alike = [one.motion for one in own if one.motion.skeleton.names == rig]
        longest = max(motion.n_frames for motion in alike)
        return self._measured(own[0].pair, held(mean_pose(alike), longest))

    def score(self, ours: _Set, theirs: _Set) -> tuple[float | None, dict[str, float]]:
        """Return the likeness of recordings to others, and its {aspect: credit}.

        None if they cannot be compared.
        """
        if not ours or not theirs:
            return None, {}
        one, other = ({k: np.array(v) for k, v in _means(side)} for side in (ours, theirs))
        for key, value in self._windows(ours, theirs).items():
            one[key] = np.array(value)
        found = credits(one, other)
        score = likeness_of_credits(found)
        return None if score is None else float(score), {k: float(v) for k, v in found.items()}

    def _windows(self, ours: _Set, theirs: _Set) -> dict[str, float]:
        """Return the metrics of windows that both sets have; {} where they cannot be compared."""
        mine = [one.windows[0] for one in ours if one.windows is not None]
        known = [one.windows for one in theirs if one.windows is not None]
        try:
            if not mine or not known:
                return {}
            own = joined(mine)
            plain, back, turned = (joined(side) for side in zip(*known))
            return {
                "one_nn": two_sample_accuracy(plain, own, seed=self.seed),
                "forward": 100.0 * float(nearer_votes(own, plain, back).mean()),
                "sided": 100.0 * float(nearer_votes(own, plain, turned).mean()),
            }
        except GestureKitError:
            return {}


def _means(recorded: Sequence[_Recorded]) -> Iterator[tuple[str, float]]:
    """Yield the means of the metrics that all recordings have."""
    for key in set.intersection(*(set(one.values) for one in recorded)):
        yield key, float(np.mean([one.values[key] for one in recorded]))
