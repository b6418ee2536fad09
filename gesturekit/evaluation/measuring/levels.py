"""Floors and ceiling of likeness, from recordings alone.

Ceiling: each take of a speaker against the speaker's other takes. Floors: takes of other speakers,
and the speaker's mean pose, against the speaker's takes. Where no speaker has a second take,
pieces of one take are compared with each other, which flatters: they share its mood.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gesturekit.errors import GestureKitError, MotionError
from gesturekit.evaluation.definitions import MOVEMENT, POOLED
from gesturekit.evaluation.measuring.baselines import held, mean_pose
from gesturekit.evaluation.measuring.clip_metrics import ClipMetrics
from gesturekit.evaluation.measuring.clips import Clip, load_recording
from gesturekit.evaluation.measuring.rigs import RETARGETED, matched
from gesturekit.evaluation.measuring.samples import copied
from gesturekit.evaluation.measuring.speakers import own_windows
from gesturekit.evaluation.metrics.hands import upper_joints
from gesturekit.evaluation.pairs import Pair
from gesturekit.evaluation.results import Level
from gesturekit.evaluation.statistics.groups import groups_of
from gesturekit.evaluation.statistics.levels import (
    CEILING,
    MEAN_POSE,
    OTHER_SPEAKER,
    level_of,
)
from gesturekit.evaluation.statistics.likeness import likeness
from gesturekit.evaluation.statistics.thresholds import USUAL_ONE_NN
from gesturekit.motion import Motion
from gesturekit.motion.parts import body_joints

MOST_SPEAKERS, MOST_TAKES, MOST_PIECES = 6, 5, 2
"""Speakers, takes of each and recordings of each take that are compared, at most."""
LONGEST = 30.0
"""Seconds of each recording that are compared, at most."""
PIECES = 4
"""Pieces of a speaker's only recording."""


@dataclass(frozen=True, eq=False)
class _Recorded:
    """A recording and its metrics."""

    pair: Pair
    motion: Motion
    values: Mapping[str, float]


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
    every = judge.read(_chosen(pairs))
    judged = sorted({names[pair] for pair in pairs[:held_out]})
    own = {name: [one for one in every if names[one.pair] == name] for name in judged}
    own = {name: recorded for name, recorded in own.items() if recorded}
    several = {name for name, recorded in own.items() if len(_by_take(recorded)) > 1}
    found: dict[str, list[float]] = {CEILING: [], OTHER_SPEAKER: [], MEAN_POSE: []}
    for name, recorded in own.items():
        takes = _by_take(recorded) if name in several else judge.pieces(recorded)
        others, still = judge.of_others(recorded[0], every), judge.still(recorded)
        within = takes if name in several or not several else []
        usual = judge.one_nn(takes)
        for level, sides in (
            (CEILING, [(take, _without(takes, i)) for i, take in enumerate(within)]),
            (OTHER_SPEAKER, [(take, recorded) for take in others]),
            (MEAN_POSE, [([still], take) for take in takes]),
        ):
            scores = (judge.score(ours, theirs, usual) for ours, theirs in sides)
            found[level] += [score for score in scores if score is not None]
    return {
        name: level_of(name, values, pieces=name != OTHER_SPEAKER and not several)
        for name, values in found.items()
        if values
    }


def _chosen(pairs: Sequence[Pair]) -> list[Pair]:
    """Return recordings of some takes of some speakers, the held-out ones first, evenly chosen."""
    speakers: dict[str | None, dict[str, list[Pair]]] = {}
    for pair in pairs:
        speakers.setdefault(pair.speaker, {}).setdefault(pair.take, []).append(pair)
    chosen = []
    for takes in list(speakers.values())[:MOST_SPEAKERS]:
        kept = _evenly(list(takes.values()), MOST_TAKES)
        # A single take is compared piece by piece.
        most = MOST_PIECES if len(kept) > 1 else PIECES
        chosen += [pair for take in kept for pair in _evenly(take, most)]
    return chosen


def _evenly(items: list, most: int) -> list:
    return items[:: -(-len(items) // most)]


def _by_take(recorded: Sequence[_Recorded]) -> list[list[_Recorded]]:
    takes: dict[tuple[str | None, str], list[_Recorded]] = {}
    for one in recorded:
        takes.setdefault((one.pair.speaker, one.pair.take), []).append(one)
    return list(takes.values())


def _without(takes: Sequence[list[_Recorded]], at: int) -> list[_Recorded]:
    return [one for i, take in enumerate(takes) if i != at for one in take]


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

    def read(self, pairs: Sequence[Pair]) -> list[_Recorded]:
        """Read and measure recordings; those that cannot be read are reported elsewhere."""
        found = []
        for pair in pairs:
            try:
                motion = load_recording(pair.reference, self.fps)
                motion = copied(motion, 0, min(motion.n_frames, round(LONGEST * motion.fps)))
                found.append(self._measured(pair, motion))
            except GestureKitError:
                continue
        return found

    def _measured(self, pair: Pair, motion: Motion) -> _Recorded:
        clip = Clip(pair, motion, motion, body_joints(motion.skeleton), None, ())
        return _Recorded(pair, motion, self.measure.recording(clip)[0])

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

    def one_nn(self, takes: Sequence[list[_Recorded]]) -> float:
        """Return the mean 1-NN accuracy of each take against the others."""
        found = [self._windows(take, _without(takes, i)) for i, take in enumerate(takes)]
        known = [values["one_nn"] for values in found if "one_nn" in values]
        return float(np.mean(known)) if known else USUAL_ONE_NN

    def score(
        self, ours: Sequence[_Recorded], theirs: Sequence[_Recorded], one_nn: float
    ) -> float | None:
        """Return the likeness of recordings to others; None if they cannot be compared."""
        if not ours or not theirs:
            return None
        one, other = ({k: np.array(v) for k, v in _means(side)} for side in (ours, theirs))
        for key, value in self._windows(ours, theirs).items():
            one[key] = np.array(value)
        found = likeness(one, other, one_nn)
        return None if found is None else float(found)

    def _windows(self, ours: Sequence[_Recorded], theirs: Sequence[_Recorded]) -> dict[str, float]:
        try:
            joints = upper_joints(theirs[0].motion.skeleton)
            held, others = ([one.motion for one in side] for side in (ours, theirs))
            return own_windows(held, others, joints, self.seed, reach=False)
        except GestureKitError:
            return {}


def _means(recorded: Sequence[_Recorded]) -> Iterator[tuple[str, float]]:
    """Yield the means of the metrics that all recordings have."""
    for key in set.intersection(*(set(one.values) for one in recorded)):
        yield key, float(np.mean([one.values[key] for one in recorded]))
