"""The speaker's own values: ceilings of metrics, and likeness with its ceiling and floors.

Ceilings of metrics that compare with recordings are the values of the speaker's other takes: each
recording is compared with one of another take of the same speaker, as if it had been generated for
it. A single take is compared with itself, piece by piece or half by half, which flatters. A model
that moves like the speaker comes to about these values: it cannot know what was recorded. Fréchet
distances have none: they depend on the size of the sets, and disjoint sets of recordings as large
as the model's are not to be had.

A draw of likeness is two disjoint sets of the speaker's takes: A of those that the model has clips
of, and B of the rest. The model's clips for A and the recordings of A are both compared with the
recordings of B: the same takes, seconds and references, so that likeness is a ratio of two paired
scores (`statistics.likeness`). The ceiling has other takes of the speaker in the model's place,
floors have other speakers' takes and the speaker's mean pose. Where a speaker has fewer than three
takes, clips stand for takes, which flatters: they share the mood of their take.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np

from audio_features import AudioFeaturesError
from gesturekit.errors import GestureKitError, MotionError
from gesturekit.evaluation.definitions import DEFINITIONS, MOVEMENT, PATCHES, POOLED, SIMILARITY
from gesturekit.evaluation.measuring.clip_metrics import ClipMetrics, nameless_clip
from gesturekit.evaluation.measuring.clips import (
    Clip,
    chosen_frames,
    copied,
    evenly,
    halves,
    load_clip,
    load_recording,
    matched,
)
from gesturekit.evaluation.measuring.made_motion import held, mean_pose
from gesturekit.evaluation.metrics import similarity
from gesturekit.evaluation.metrics.diagonals import frame_distances
from gesturekit.evaluation.metrics.hands import upper_joints
from gesturekit.evaluation.metrics.patches import inter_diversity, patch_features
from gesturekit.evaluation.metrics.physical import SpeedHistogram, hellinger, relative_speed
from gesturekit.evaluation.metrics.two_sample import motion_windows
from gesturekit.evaluation.pairs import Pair, Window, grouped
from gesturekit.evaluation.results import (
    OTHER_SPEAKER,
    ClipResult,
    GroupLikeness,
    Interval,
    MetricResult,
)
from gesturekit.evaluation.statistics.intervals import Takes, groups_of, interval_of, whole_set
from gesturekit.evaluation.statistics.likeness import (
    Credits,
    credits,
    likeness_result,
    relative,
)
from gesturekit.evaluation.statistics.model_metrics import CEILING, MEAN_POSE, level_of
from gesturekit.motion import Motion
from gesturekit.motion.parts import body_joints

MOST, LONGEST = 30, 60.0
"""Recordings that are compared with each other for ceilings, at most, and seconds of each."""
INTER = 20
"""Recordings that inter-diversity is taken of, at most."""
OTHERS, ONE_TAKE, HALVES = (
    "recording: against another take of the speaker",
    "recording: against another piece of the same take",
    "recording: one half against the other",
)
_NO_GOAL = ("mouth", "mouth_lag", "mouth_chance", "mouth_z", "hellinger")
"""Metrics for which another take is no goal: a mouth follows words, speeds are taken of halves."""
SECOND = ", second half"
"""Ending of the name of the second half of a single recording."""

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


def ceilings(
    sources: Mapping[str, Pair], fps: float, measure: ClipMetrics
) -> dict[str, tuple[Interval, str]]:
    """Return {key of `definitions`: (the recordings' own value, how it was taken)}.

    Args:
        sources: pairs of each recording with itself, which give takes and speakers; of one rig.
        fps: frame rate of the evaluation.
        measure: the metrics of clips, with their groups.
    """
    if not sources:  # all are too short to be compared
        return {}
    chosen: dict[str, Motion] = {}
    for name in evenly(list(sources), MOST):
        motion = load_recording(sources[name].reference, fps)
        chosen[name] = copied(motion, 0, round(LONGEST * motion.fps))
    if len(chosen) < 2:
        ((name, motion),) = chosen.items()
        chosen = {n: m for n, (m,) in zip((name, name + SECOND), halves([motion]))}
    own = {name: sources[name.removesuffix(SECOND)] for name in chosen}
    others, note = _others(own)
    note = note if len(sources) > 1 else HALVES
    joints = body_joints(next(iter(chosen.values())).skeleton)
    clips = [
        Clip(own[name], chosen[other], chosen[name], joints, None, ())
        for name, other in others.items()
    ]
    measured = [(key, (v, c.pair)) for c in clips for key, v in measure.against(c).items()]
    found: dict[str, tuple[Interval, str]] = {}
    for key, several in grouped(measured).items():
        values, pairs = zip(*several, strict=True)
        if key not in _NO_GOAL:
            found[key] = interval_of(values, Takes.of(pairs), DEFINITIONS[key].within), note
    sides = halves(list(chosen.values()))
    speeds = ([relative_speed(motion, joints) for motion in side] for side in sides)
    sets = {"hellinger": hellinger(*map(SpeedHistogram.of, speeds))}
    with suppress(GestureKitError):  # the model's own result says why it cannot be taken
        if SIMILARITY in measure.groups:
            both = [similarity.pose_pair(c.generated, c.recording, joints) for c in clips]
            poses = (np.concatenate(side) for side in zip(*both, strict=True))
            sets["cca_global"] = similarity.cca(*poses)
        if PATCHES in measure.groups:
            variant, some = measure.variants.patches, list(chosen.values())[:INTER]
            features = [patch_features(motion, variant, joints=joints) for motion in some]
            sets["inter_diversity"] = inter_diversity(features)
    return found | {key: (whole_set(v, len(chosen)), HALVES) for key, v in sets.items()}


def _others(recordings: Mapping[str, Pair]) -> tuple[dict[str, str], str]:
    """Return {recording: the one that is compared with it}, and how they were chosen.

    The next recording of another take of the same speaker, cyclically; for speakers with one take,
    the next recording of it, unless others have several takes.
    """
    names = list(recordings)
    takes, pieces = {}, {}
    for at, name in enumerate(names):
        after = names[at + 1 :] + names[:at]
        same = [o for o in after if recordings[o].speaker == recordings[name].speaker]
        other_takes = [o for o in same if recordings[o].take != recordings[name].take]
        if other_takes:
            takes[name] = other_takes[0]
        pieces[name] = (same or after)[0]
    return (takes, OTHERS) if takes else (pieces, ONE_TAKE)


@dataclass(frozen=True, eq=False)
class _Take:
    """Clips of one take: the means of their metrics, and their motion."""

    name: str
    values: Mapping[str, float]
    motions: Sequence[Motion]


_Chosen = tuple[int, ...]
"""Indices of takes."""
Scorer = Callable[[_Chosen, _Chosen], Credits]
"""Credits of some takes of a motion that are compared with some of the speaker's takes."""


class _Speaker:
    """A speaker's takes, those with clips of the model first, and scores against them.

    Args:
        takes: the takes; n of them.
        held: number of takes that the model has clips of.
        joints: upper-body joints to compare.
        pieces: True where clips, or pieces of these, stand for takes.
        seed: seed of draws and subsamples.
    """

    def __init__(
        self, takes: Sequence[_Take], held: int, joints: Sequence[str], pieces: bool, seed: int
    ) -> None:
        self.takes, self.held, self.joints, self.pieces = takes, held, joints, pieces
        self.seed = seed
        self._plain, self._owner = _rows(takes, joints)
        self._back = _rows(takes, joints, back=True)[0]
        self._turned = _rows(takes, joints, mirrored=True)[0]
        self._within = _distances_within(self._plain)
        self.own = cache(self.scorer(takes))

    def scorer(self, takes: Sequence[_Take]) -> Scorer:
        """Return a function of (indices of `takes`, indices of the speaker's takes) to credits."""
        rows, owner = _rows(takes, self.joints)
        within = _distances_within(rows)
        across, back, turned = (
            frame_distances(rows, others, squared=True) if len(rows) and len(others) else None
            for others in (self._plain, self._back, self._turned)
        )

        def scored(ours: _Chosen, theirs: _Chosen) -> Credits:
            values = _means([takes[i].values for i in ours])
            a = np.flatnonzero(np.isin(owner, ours))
            b = np.flatnonzero(np.isin(self._owner, theirs))
            if across is not None and min(len(a), len(b)) > 1:
                nearest = across[np.ix_(a, b)].min(axis=1)
                for key, changed in (("forward", back), ("sided", turned)):
                    if changed is not None:
                        other = changed[np.ix_(a, b)].min(axis=1)
                        tie = np.abs(np.sqrt(nearest) - np.sqrt(other)) < 1e-9
                        values[key] = 100.0 * float(np.where(tie, 0.5, nearest < other).mean())
                values["one_nn"] = self._one_nn(within, across, a, b)
            return credits(values, _means([self.takes[i].values for i in theirs]))

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

    def _relative(
        self, scored: Scorer, sides: Iterable[tuple[_Chosen, _Chosen, _Chosen]]
    ) -> list[GroupLikeness]:
        """Return the likeness of takes x beside the speaker's a, both compared with b."""
        found = (relative(scored(x, b), self.own(a, b)) for x, a, b in sides)
        return [likeness for likeness in found if likeness is not None]

    def draws(self) -> list[tuple[_Chosen, _Chosen]]:
        """Return disjoint sets: takes with clips and the rest, or halves where these are few."""
        n = len(self.takes)
        size = min(self.held, n // 2)
        rng = np.random.default_rng(self.seed)
        chosen = {tuple(sorted(rng.permutation(self.held)[:size].tolist())) for _ in range(DRAWS)}
        return [(a, tuple(i for i in range(n) if i not in a)) for a in sorted(chosen)]

    def ceiling(self) -> list[float]:
        """Return the likeness of other takes of the speaker, as many as are drawn of the model."""
        n, rng = len(self.takes), np.random.default_rng(self.seed)
        size = max(1, min(self.held, n // 3))
        sides = set()
        for _ in range(2 * DRAWS):
            parts = np.split(rng.permutation(n), (size, 2 * size))
            x, a, b = (tuple(sorted(part.tolist())) for part in parts)
            sides.add((x, a, b))
        return [likeness.value for likeness in self._relative(self.own, sorted(sides))]

    def floor(self, takes: Sequence[_Take]) -> list[float]:
        """Return the likeness of other motion, as many takes as are drawn of the model, if any."""
        draws = self.draws()
        x = tuple(range(min(len(draws[0][0]), len(takes))))
        found = self._relative(self.scorer(takes), ((x, a, b) for a, b in draws))
        return [float(np.mean([likeness.value for likeness in found]))] if found else []

    def model(self, takes: Sequence[_Take], name: str) -> GroupLikeness | None:
        """Return the likeness of a model's takes, which are those of the first `held` takes."""
        scored, draws = self.scorer(takes), self.draws()
        names = tuple(take.name for take in takes)

        def mean(left_out: int = -1) -> GroupLikeness | None:
            sides = [[tuple(i for i in side if i != left_out) for side in draw] for draw in draws]
            found = self._relative(scored, ((a, a, b) for a, b in sides if a and b))
            if not found:
                return None
            value, own = (float(np.mean([getattr(f, k) for f in found])) for k in ("value", "own"))
            aspects = _means([likeness.aspects for likeness in found])
            return GroupLikeness(name, names, value, own, aspects, pieces=self.pieces)

        whole = mean()
        if whole is None:
            return None
        left = [mean(i) or whole for i in range(len(self.takes))]
        values = [likeness.value for likeness in left]
        without = dict(zip(names, values)) if self.held > 1 else {}
        return replace(whole, without=without, without_reference=tuple(values[self.held :]))


def _distances_within(rows: np.ndarray) -> np.ndarray:
    """Return squared distances (N, N) of windows to each other, infinite to themselves."""
    distances = frame_distances(rows, rows, squared=True) if len(rows) else np.empty((0, 0))
    np.fill_diagonal(distances, np.inf)
    return distances


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


def _takes(clips: Iterable[tuple[str, Mapping[str, float], Motion]]) -> list[_Take]:
    """Return the takes of clips, each given by the name of its take, its metrics and its motion."""
    groups = grouped((name, (values, motion)) for name, values, motion in clips)
    return [
        _Take(name, _means([values for values, _ in group]), [motion for _, motion in group])
        for name, group in groups.items()
    ]


def _some(takes: Mapping[str, list], most: int) -> dict[str, list]:
    return {name: takes[name] for name in evenly(list(takes), most)}


_Side = tuple[Mapping[str, float], Motion]
"""Metrics and motion of a clip, or of its recording."""


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
        self.measure = replace(self.measure, groups=groups, cheap=True)  # all aspects are

    def __call__(self, clips: Sequence[ClipResult]) -> MetricResult | None:
        """Return the likeness of a model; None where no group has enough to compare."""
        first: dict[Window, ClipResult] = {}  # one sample of each recording
        for clip in clips:
            first.setdefault(clip.pair.of, clip)
        stems = {clip.pair.stem for clip in clips}
        others = [pair for pair in self.recordings if pair.stem not in stems]
        every = [*(clip.pair for clip in first.values()), *others]
        names = dict(zip(every, groups_of(every), strict=True))
        found, values, count = [], dict[str, list[float]](), 0
        for name in sorted({names[clip.pair] for clip in first.values()}):
            own = [clip for clip in first.values() if names[clip.pair] == name]
            group = self._group(name, own, [pair for pair in others if names[pair] == name])
            if group is not None:
                likeness, speaker, levels = group
                found.append(likeness)
                count += len(speaker.takes)
                for level, some in levels.items():
                    values.setdefault(level, []).extend(some)
        pooled = {level: level_of(level, some) for level, some in values.items() if some}
        if CEILING in pooled:
            pieces = all(group.pieces for group in found)
            pooled[CEILING] = replace(pooled[CEILING], n=count, pieces=pieces)
        return likeness_result(found, pooled, len(clips))

    def _group(
        self, name: str, clips: Sequence[ClipResult], others: Sequence[Pair]
    ) -> tuple[GroupLikeness, _Speaker, dict[str, list[float]]] | None:
        """Return the likeness to one speaker (and style), the speaker, and its levels."""
        by_take = _some(grouped((clip.pair.take, clip) for clip in clips), MOST_TAKES)
        chosen = [clip for take in by_take.values() for clip in evenly(take, MOST_CLIPS)]
        loaded: list[tuple[ClipResult, Clip]] = []
        for clip in chosen:
            with suppress(GestureKitError, AudioFeaturesError):  # reported with the clip
                loaded.append((clip, load_clip(clip.pair, self.fps, self.without)))
        if not loaded:
            return None
        if all("hand_q50" in c.recording and "hand_q50" not in c.metrics for c, _ in loaded):
            return None  # a rig without hands, or whose arms are not known
        try:
            upper = upper_joints(loaded[0][1].recording.skeleton)
        except MotionError:
            return None
        joints = tuple(n for n in upper if all(n in motion.joints for _, motion in loaded))
        key = (name, joints, *(c.pair.of for c, _ in loaded))
        if key not in self._known:
            self._known[key] = self._reference(others, set(by_take), [m for _, m in loaded])
        reference, pieces, cut = self._known[key]
        sides: list[tuple[str, _Side, _Side]] = []  # name of the take, a clip, its recording
        for clip, motion in loaded:
            of = clip.pair.stem if pieces else clip.pair.take
            made, real = (clip.metrics, motion.generated), (clip.recording, motion.recording)
            for pair in self._cut(motion) if cut else [(made, real)]:
                sides.append((f"{of} {len(sides)}" if pieces else of, *pair))
        if key not in self._speakers:
            takes = _takes((take, *own) for take, _, own in sides) + reference
            if len(takes) < LEAST_TAKES:
                return None
            speaker = _Speaker(takes, len({take for take, *_ in sides}), joints, pieces, self.seed)
            self._speakers[key] = speaker, self._levels(speaker, loaded[0][0].pair)
        speaker, levels = self._speakers[key]
        group = speaker.model(_takes((take, *made) for take, made, _ in sides), name)
        return None if group is None else (group, speaker, levels)

    def _reference(
        self, others: Sequence[Pair], held: set[str], loaded: Sequence[Clip]
    ) -> tuple[list[_Take], bool, bool]:
        """Return takes without clips of the model, in pieces as long and as many as its clips.

        Returns:
            the takes; whether clips stand for takes; whether these are cut into pieces as well.
        """
        length = round(float(np.median([clip.recording.n_frames for clip in loaded])))
        most, rig = max(1, round(len(loaded) / len(held))), loaded[0].recording.skeleton.names
        by_take = grouped((pair.take, pair) for pair in others if pair.take not in held)
        parts = [
            (take, motion)
            for take, pairs in _some(by_take, max(MOST_TAKES - len(held), LEAST_TAKES)).items()
            for motion in self._pieces(pairs, length, most)
            if motion.skeleton.names == rig
        ]
        pieces = len(held | {take for take, _ in parts}) < LEAST_TAKES
        names = [f"{take} {n}" if pieces else take for n, (take, _) in enumerate(parts)]
        takes = _takes((name, self._values(m), m) for name, (_, m) in zip(names, parts))
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

    def _cut(self, clip: Clip) -> Iterator[tuple[_Side, _Side]]:
        """Yield pieces of a clip and its recording, with their metrics."""
        n_frames = min(clip.generated.n_frames, clip.recording.n_frames)
        ends = np.linspace(0, n_frames, PIECES + 1).astype(int)
        for a, b in zip(ends, ends[1:]):
            if b - a > 1:
                made, real = clip.generated[a:b], clip.recording[a:b]
                yield (self._values(made), made), (self._values(real), real)

    def _values(self, motion: Motion) -> dict[str, float]:
        return self.measure.recording(nameless_clip(motion, motion))

    def _levels(self, speaker: _Speaker, pair: Pair) -> dict[str, list[float]]:
        """Return {name of a level: values} of a speaker."""
        every = [motion for take in speaker.takes for motion in take.motions]
        motions = [m for m in every if m.skeleton.names == every[0].skeleton.names]
        still = held(mean_pose(motions), max(motion.n_frames for motion in motions))
        others = self._of_others(pair, motions[0], speaker.held)
        return {
            CEILING: speaker.ceiling(),
            OTHER_SPEAKER: [value for takes in others for value in speaker.floor(takes)],
            MEAN_POSE: speaker.floor([_Take("", self._values(still), [still])]),
        }

    def _of_others(self, pair: Pair, own: Motion, most: int) -> Iterator[list[_Take]]:
        """Yield takes of other speakers, on the rig of a recording."""
        others = [other for other in self.recordings if other.speaker != pair.speaker]
        speakers = grouped((other.speaker or "", other) for other in others)
        for pairs in list(speakers.values())[:MOST_OTHERS]:
            takes = grouped((other.take, other) for other in pairs)
            moved = []
            for name, some in list(takes.items())[: min(most, MOST_OTHERS)]:
                pieces = self._pieces(some, own.n_frames, 2)
                with suppress(MotionError):
                    motions = [matched(motion, own)[1] for motion in pieces]
                    moved += _takes((name, self._values(motion), motion) for motion in motions)
            if moved:
                yield moved
