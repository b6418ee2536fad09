"""Likeness of a model to a speaker, and of the speaker, other speakers and a mean pose to compare.

A draw is two disjoint sets of the speaker's takes: A of those that the model has clips of, and B of
the rest. The model's clips for A and the recordings of A are both compared with the recordings of
B: the same takes, seconds and references, so that likeness is a ratio of two paired scores
(`statistics.likeness`). The ceiling has other takes of the speaker in the model's place, floors
have other speakers' takes and the speaker's mean pose. Where a speaker has fewer than three takes,
clips stand for takes, which flatters: they share the mood of their take.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from audio_features import AudioFeaturesError
from gesturekit.errors import GestureKitError, MotionError
from gesturekit.evaluation.definitions import MOVEMENT, POOLED
from gesturekit.evaluation.made_motion import chosen_frames, held, mean_pose
from gesturekit.evaluation.measuring.clip_metrics import ClipMetrics
from gesturekit.evaluation.measuring.clips import Clip, load_clip, load_recording, matched
from gesturekit.evaluation.measuring.samples import copied, evenly
from gesturekit.evaluation.metrics.diagonals import frame_distances
from gesturekit.evaluation.metrics.hands import upper_joints
from gesturekit.evaluation.metrics.two_sample import motion_windows
from gesturekit.evaluation.pairs import Pair, Window
from gesturekit.evaluation.results import (
    OTHER_SPEAKER,
    ClipResult,
    GroupLikeness,
    Level,
    MetricResult,
)
from gesturekit.evaluation.statistics.intervals import groups_of
from gesturekit.evaluation.statistics.likeness import (
    Credits,
    Relative,
    credits,
    likeness_result,
    relative,
)
from gesturekit.evaluation.statistics.model_metrics import CEILING, MEAN_POSE, level_of
from gesturekit.motion import Motion
from gesturekit.motion.parts import body_joints

MOST_TAKES, MOST_CLIPS, MOST_WINDOWS = 24, 6, 60
"""Takes of a speaker, clips and windows of each take that are compared, at most."""
MOST_OTHERS = 3
"""Other speakers, and takes of each, that give a floor, at most."""
LEAST_TAKES = 3
"""Takes of a speaker for disjoint sets and a ceiling; with fewer, clips stand for takes."""
PIECES = 4
"""Pieces of a clip where there are too few clips as well."""
DRAWS = 10
"""Draws of disjoint sets, at most; twice as many for the ceiling."""


@dataclass(frozen=True, eq=False)
class _Take:
    """Clips of one take: the means of their metrics, and their motion."""

    name: str
    values: Mapping[str, float]
    motions: Sequence[Motion]


_SCORES = ("value", "own")
Draw = tuple[tuple[int, ...], tuple[int, ...]]
"""Indices of the takes of A and of B."""


class _Speaker:
    """A speaker's takes, those with clips of the model first, and scores against them.

    Args:
        takes: the takes; n of them.
        held: number of takes that the model has clips of.
        joints: upper-body joints to compare.
        seed: seed of draws and subsamples.
    """

    def __init__(self, takes: Sequence[_Take], held: int, joints: Sequence[str], seed: int) -> None:
        self.takes, self.held, self.joints, self.seed = takes, held, joints, seed
        self._plain, self._owner = _rows(takes, joints)
        self._back = _rows(takes, joints, back=True)[0]
        self._turned = _rows(takes, joints, mirrored=True)[0]
        self._within = _distances_within(self._plain)
        self.own = lru_cache(maxsize=None)(self.scorer(takes))

    def scorer(self, takes: Sequence[_Take]) -> Callable[[Draw], Credits]:
        """Return a function of (indices of `takes`, indices of the speaker's takes) to credits."""
        rows, owner = _rows(takes, self.joints)
        within = _distances_within(rows)
        across, back, turned = (
            frame_distances(rows, others, squared=True) if len(rows) and len(others) else None
            for others in (self._plain, self._back, self._turned)
        )

        def scored(draw: Draw) -> Credits:
            ours, theirs = (
                _means([side[i].values for i in chosen])
                for side, chosen in zip((takes, self.takes), draw, strict=True)
            )
            a, b = (
                np.flatnonzero(np.isin(owners, chosen))
                for owners, chosen in zip((owner, self._owner), draw, strict=True)
            )
            if min(len(a), len(b)) > 1 and across is not None:
                nearest = across[np.ix_(a, b)].min(axis=1)
                for key, changed in (("forward", back), ("sided", turned)):
                    if changed is not None:
                        other = changed[np.ix_(a, b)].min(axis=1)
                        tie = np.abs(np.sqrt(nearest) - np.sqrt(other)) < 1e-9
                        ours[key] = 100.0 * float(np.where(tie, 0.5, nearest < other).mean())
                ours["one_nn"] = self._one_nn(within, across, a, b)
            return credits(ours, theirs)

        return scored

    def _one_nn(
        self, within: np.ndarray, across: np.ndarray, a: np.ndarray, b: np.ndarray
    ) -> float:
        """Return the 1-NN accuracy of windows a of a motion and b of the speaker, equal numbers."""
        rng, n = np.random.default_rng(self.seed), min(len(a), len(b))
        a, b = (np.sort(rng.choice(side, n, replace=False)) for side in (a, b))
        between = across[np.ix_(a, b)]
        right = (within[np.ix_(a, a)].min(axis=1) < between.min(axis=1)).mean()
        return float(right + (self._within[np.ix_(b, b)].min(1) < between.min(0)).mean()) / 2

    def draws(self) -> list[Draw]:
        """Return disjoint sets: takes with clips and the rest, or halves where these are few."""
        n = len(self.takes)
        size, every = min(self.held, n // 2), set(range(n))
        if size == self.held:
            return [(tuple(range(size)), tuple(range(size, n)))]
        rng = np.random.default_rng(self.seed)
        chosen = {tuple(sorted(rng.permutation(self.held)[:size].tolist())) for _ in range(DRAWS)}
        return [(ours, tuple(sorted(every - set(ours)))) for ours in sorted(chosen)]

    def ceiling(self) -> list[float]:
        """Return the likeness of other takes of the speaker, as many as are drawn of the model."""
        n, rng = len(self.takes), np.random.default_rng(self.seed)
        size = max(1, min(self.held, n // 3))
        sides = set()
        for _ in range(2 * DRAWS):
            parts = np.split(rng.permutation(n), (size, 2 * size))
            x, a, b = (tuple(sorted(part.tolist())) for part in parts)
            sides.add((x, a, b))
        found = (relative(self.own((x, b)), self.own((a, b))) for x, a, b in sorted(sides))
        return [score.value for score in found if score is not None]

    def model(self, takes: Sequence[_Take], name: str, pieces: bool) -> GroupLikeness | None:
        """Return the likeness of a model's takes, which are those of the first `held` takes."""
        scored = self.scorer(takes)

        def mean(left_out: int = -1) -> Relative | None:
            sides = [_without(draw, left_out) for draw in self.draws()]
            every = (relative(scored(d), self.own(d)) for d in sides if d[0] and d[1])
            found = [likeness for likeness in every if likeness is not None]
            if not found:
                return None
            value, own = (float(np.mean([getattr(one, k) for one in found])) for k in _SCORES)
            return Relative(value, own, _means([one.aspects for one in found]))

        whole = mean()
        if whole is None:
            return None
        left = [mean(i) for i in range(len(self.takes))]
        values = [whole.value if one is None else one.value for one in left]
        names = tuple(take.name for take in takes)
        return GroupLikeness(
            name,
            names,
            whole.value,
            whole.own,
            whole.aspects,
            without=dict(zip(names, values)) if self.held > 1 else {},
            without_reference=tuple(values[self.held :]),
            pieces=pieces,
        )

    def floor(self, takes: Sequence[_Take]) -> float | None:
        """Return the likeness of other motion, as many takes as are drawn of the model."""
        draws = self.draws()
        size, scored = len(draws[0][0]), self.scorer(takes)
        chosen = tuple(range(min(size, len(takes))))
        found = [relative(scored((chosen, theirs)), self.own((ours, theirs)))
                 for ours, theirs in draws]  # fmt: skip
        values = [score.value for score in found if score is not None]
        return float(np.mean(values)) if values else None


def _distances_within(rows: np.ndarray) -> np.ndarray:
    """Return squared distances (N, N) of windows to each other, infinite to themselves."""
    distances = frame_distances(rows, rows, squared=True) if len(rows) else np.empty((0, 0))
    np.fill_diagonal(distances, np.inf)
    return distances


def _without(draw: Draw, left_out: int) -> Draw:
    ours, theirs = (tuple(i for i in side if i != left_out) for side in draw)
    return ours, theirs


def _rows(
    takes: Sequence[_Take], joints: Sequence[str], *, back: bool = False, mirrored: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Return windows (N, D) of takes, evenly chosen, and the index (N,) of the take of each."""
    rows, owners = [np.empty((0, 1))], [np.empty(0, int)]
    for at, take in enumerate(takes):
        motions = list(take.motions)
        if back:
            motions = [chosen_frames(m, np.arange(m.n_frames)[::-1]) for m in motions]
        try:
            windows = motion_windows(motions, joints, mirrored=mirrored)
        except MotionError:
            continue
        kept = np.linspace(0, len(windows) - 1, min(len(windows), MOST_WINDOWS)).round().astype(int)
        rows.append(windows.rows(kept))
        owners.append(np.full(len(kept), at))
    return np.concatenate(rows[1:] or rows), np.concatenate(owners)


def _means(sides: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return the means of the values that all have."""
    keys = set.intersection(*(set(side) for side in sides))
    return {key: float(np.mean([side[key] for side in sides])) for key in sorted(keys)}


@dataclass(eq=False)
class LikenessMeasurer:
    """Measures the likeness of models to the speakers of their recordings.

    Attributes:
        measure: the metrics of clips.
        recordings: recordings of all splits, each with itself.
        fps: frame rate of the evaluation.
        without: bare names of joints that no model is measured with.
        seed: seed of draws and subsamples.
    """

    measure: ClipMetrics
    recordings: Sequence[Pair]
    fps: float
    without: frozenset[str]
    seed: int
    _known: dict[tuple, tuple[list[_Take], bool, bool]] = field(default_factory=dict, init=False)
    _speakers: dict[tuple, tuple[_Speaker, dict]] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        groups = [group for group in (MOVEMENT, POOLED) if group in self.measure.groups]
        self.measure = ClipMetrics(self.measure.statistics, groups, self.measure.variants)

    def __call__(self, clips: Sequence[ClipResult]) -> MetricResult | None:
        """Return the likeness of a model; None where no group has enough to compare."""
        first: dict[Window, ClipResult] = {}  # one sample of each recording
        for clip in clips:
            first.setdefault(clip.pair.of, clip)
        stems = {clip.pair.stem for clip in clips}
        others = [pair for pair in self.recordings if pair.stem not in stems]
        every = [*(clip.pair for clip in first.values()), *others]
        names = dict(zip(every, groups_of(every), strict=True))
        found, levels = [], []
        for name in sorted({names[clip.pair] for clip in first.values()}):
            own = [clip for clip in first.values() if names[clip.pair] == name]
            group = self._group(name, own, [pair for pair in others if names[pair] == name])
            if group is not None:
                found.append(group[0])
                levels.append(group[1])
        pooled = _pooled_levels(levels, all(group.pieces for group in found))
        return likeness_result(found, pooled, len(clips))

    def _group(
        self, name: str, clips: Sequence[ClipResult], others: Sequence[Pair]
    ) -> tuple[GroupLikeness, Mapping[str, list[float]]] | None:
        by_take: dict[str, list[ClipResult]] = {}
        for clip in clips:
            by_take.setdefault(clip.pair.take, []).append(clip)
        chosen = {t: evenly(c, MOST_CLIPS) for t, c in _some(by_take, MOST_TAKES).items()}
        loaded = [(clip, self._loaded(clip.pair)) for take in chosen.values() for clip in take]
        loaded = [(clip, motion) for clip, motion in loaded if motion is not None]
        if not loaded:
            return None
        try:
            upper = upper_joints(loaded[0][1].recording.skeleton)
            joints = tuple(n for n in upper if all(n in motion.joints for _, motion in loaded))
        except MotionError:
            return None
        key = (name, joints, *(c.pair.of for c, _ in loaded))
        if key not in self._known:
            self._known[key] = self._reference(others, chosen, loaded)
        reference, pieces, cut = self._known[key]
        sides = [(c, c.metrics, m.generated, c.recording, m.recording) for c, m in loaded]
        if cut:
            sides = [part for clip, motion in loaded for part in self._cut(clip, motion)]
        names = [f"{c.pair.stem} {n}" if pieces else c.pair.take for n, (c, *_) in enumerate(sides)]
        if key not in self._speakers:
            real = _takes(names, [side[3:] for side in sides]) + reference
            if len(real) < LEAST_TAKES:
                return None
            speaker = _Speaker(real, len(set(names)), joints, self.seed)
            self._speakers[key] = speaker, self._levels(speaker, loaded[0][0].pair)
        speaker, levels = self._speakers[key]
        model = _takes(names, [side[1:3] for side in sides])
        group = speaker.model(model, name, pieces)
        return None if group is None else (group, levels)

    def _loaded(self, pair: Pair) -> Clip | None:
        try:
            return load_clip(pair, self.fps, self.without)
        except (GestureKitError, AudioFeaturesError):
            return None  # reported with the clip

    def _reference(
        self,
        others: Sequence[Pair],
        chosen: Mapping[str, Sequence[ClipResult]],
        loaded: Sequence[tuple[ClipResult, Clip]],
    ) -> tuple[list[_Take], bool, bool]:
        """Return takes without clips of the model, in pieces as long and as many as its clips.

        Returns:
            the takes; whether clips stand for takes; whether these are cut into pieces as well.
        """
        length = round(float(np.median([motion.recording.n_frames for _, motion in loaded])))
        most, rig = max(1, round(len(loaded) / len(chosen))), loaded[0][1].recording.skeleton.names
        by_take: dict[str, list[Pair]] = {}
        for pair in others:
            if pair.take not in chosen:
                by_take.setdefault(pair.take, []).append(pair)
        by_take = _some(by_take, max(MOST_TAKES - len(chosen), LEAST_TAKES))
        moved = {take: self._pieces(pairs, length, most) for take, pairs in by_take.items()}
        parts = [(t, m) for t, motions in moved.items() for m in motions if m.skeleton.names == rig]
        pieces = len(set(chosen) | {take for take, _ in parts}) < LEAST_TAKES
        names = [f"{take} {n}" if pieces else take for n, (take, _) in enumerate(parts)]
        takes = _takes(names, [(self._values(motion), motion) for _, motion in parts])
        return takes, pieces, pieces and len(loaded) + len(parts) < LEAST_TAKES

    def _pieces(self, pairs: Sequence[Pair], length: int, most: int) -> list[Motion]:
        """Return the first pieces of recordings, `length` frames each."""
        pieces: list[Motion] = []
        for pair in pairs:
            try:
                motion = load_recording(pair.reference, self.fps)
            except GestureKitError:
                continue  # reported elsewhere
            starts = range(0, max(1, motion.n_frames - length // 2), length)
            pieces += [copied(motion, a, min(motion.n_frames, a + length)) for a in starts]
            if len(pieces) >= most:
                break
        return pieces[:most]

    def _cut(self, clip: ClipResult, motion: Clip) -> Iterator[tuple]:
        """Yield pieces of a clip and its recording, with their metrics, as `_group` takes them."""
        ends = np.linspace(0, motion.n_frames, PIECES + 1).astype(int)
        for a, b in zip(ends, ends[1:]):
            if b - a > 1:
                made, recorded = motion.generated[a:b], motion.recording[a:b]
                yield clip, self._values(made), made, self._values(recorded), recorded

    def _values(self, motion: Motion) -> dict[str, float]:
        clip = Clip(_NAMELESS, motion, motion, body_joints(motion.skeleton), None, ())
        return self.measure.recording(clip)[0]

    def _levels(self, speaker: _Speaker, pair: Pair) -> dict[str, list[float]]:
        """Return {name of a level: values} of a speaker."""
        every = [motion for take in speaker.takes for motion in take.motions]
        motions = [m for m in every if m.skeleton.names == every[0].skeleton.names]
        still = held(mean_pose(motions), max(motion.n_frames for motion in motions))
        found: dict[str, list[float | None]] = {
            CEILING: [*speaker.ceiling()],
            MEAN_POSE: [speaker.floor([_Take("", self._values(still), [still])])],
            OTHER_SPEAKER: [
                speaker.floor(takes) for takes in self._of_others(pair, motions[0], speaker.held)
            ],
        }
        known = {name: [v for v in values if v is not None] for name, values in found.items()}
        return {**known, _COUNT: [float(len(speaker.takes))]}

    def _of_others(self, pair: Pair, own: Motion, most: int) -> Iterator[list[_Take]]:
        """Yield takes of other speakers, on the rig of a recording."""
        speakers: dict[str | None, dict[str, list[Pair]]] = {}
        for other in self.recordings:
            if other.speaker != pair.speaker:
                speakers.setdefault(other.speaker, {}).setdefault(other.take, []).append(other)
        for takes in list(speakers.values())[:MOST_OTHERS]:
            moved = []
            for name, pairs in list(takes.items())[: min(most, MOST_OTHERS)]:
                motions = self._pieces(pairs, own.n_frames, 2)
                try:
                    motions = [matched(motion, own)[1] for motion in motions]
                    moved.append(_Take(name, _means(list(map(self._values, motions))), motions))
                except (MotionError, TypeError):
                    continue
            if moved:
                yield moved


_COUNT = "number of the speaker's takes"
_NAMELESS = Pair("recording", "recording", None, None, None)  # type: ignore[arg-type]


def _pooled_levels(
    of_groups: Sequence[Mapping[str, Sequence[float]]], pieces: bool
) -> dict[str, Level]:
    """Return ceiling and floors, pooled over groups."""
    pooled = {
        name: [value for group in of_groups for value in group.get(name, ())]
        for name in (CEILING, OTHER_SPEAKER, MEAN_POSE, _COUNT)
    }
    count = int(sum(pooled.pop(_COUNT)))
    found = {name: level_of(name, values) for name, values in pooled.items() if values}
    if CEILING in found:
        found[CEILING] = replace(found[CEILING], n=count, pieces=pieces)
    return found


def _takes(names: Sequence[str], clips: Sequence[tuple[Mapping, Motion]]) -> list[_Take]:
    """Return (metrics, motion) of clips by the names of their takes."""
    groups: dict[str, list[tuple[Mapping[str, float], Motion]]] = {}
    for name, clip in zip(names, clips, strict=True):
        groups.setdefault(name, []).append(clip)
    return [
        _Take(name, _means([values for values, _ in group]), [motion for _, motion in group])
        for name, group in groups.items()
    ]


def _some(takes: Mapping[str, list], most: int) -> dict[str, list]:
    return {name: takes[name] for name in evenly(list(takes), most)}
