"""Metrics of all clips pooled (hands, windows, copying), each beside the recordings' own value."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from gesturekit.errors import GestureKitError, MotionError
from gesturekit.evaluation.measuring.clips import Clip, MotionSample, TrainingMotion, evenly, halves
from gesturekit.evaluation.metrics.arms import ARM_KEYS, arm_windows, nearest_arm
from gesturekit.evaluation.metrics.frame_rate import at_rate
from gesturekit.evaluation.metrics.hands import (
    FPS,
    HAND_KEYS,
    LEAST_SEEDS,
    NOMINAL,
    Hands,
    calibration,
    calm_and_lively,
    hand_level,
    hand_values,
    upper_joints,
)
from gesturekit.evaluation.metrics.two_sample import (
    LOW_QUANTILE,
    motion_windows,
    nearest_training,
    subsample,
    two_sample_accuracy,
    two_sample_votes,
    within_reach,
)
from gesturekit.evaluation.pairs import Pair, Window
from gesturekit.evaluation.results import MetricResult
from gesturekit.evaluation.statistics.intervals import groups_of, whole_set
from gesturekit.evaluation.statistics.levels import CEILING, level_of
from gesturekit.motion import Motion, Skeleton

ENOUGH_CALM = 16
"""Windows from which the correlation of calm and lively stretches is informative. Where the true
one is 0.8, that of 4 windows is below 0.4 in 14 of 100 cases, that of 16 windows in 2."""
MOST_TAKES = 12
"""Takes of a speaker that are compared with that speaker's other takes, at most."""


@dataclass
class _Recording:
    """A recording and the hands of the clips for it.

    Attributes:
        number: number of the recording, from 0.
        pair: its first clip.
        skeleton: its rig.
        joints: names of the joints that all its clips have.
        hands: its hands; empty for a rig without.
        samples: hands of its clips.
    """

    number: int
    pair: Pair
    skeleton: Skeleton
    joints: tuple[str, ...]
    hands: list[Hands]
    samples: list[Hands] = field(default_factory=list)


@dataclass(frozen=True)
class _Group:
    """Clips of one speaker (and style) with their recordings, or pieces of them; see `groups_of`.

    Attributes:
        joints: upper-body joints that all clips have.
        recorded: (R) recordings.
        recordings: (R) number of each among the recordings of all groups; pieces share it.
        takes: (R) take of each.
        generated: (C) clips, in the order of their recordings.
        clips: (C) number of each among the clips of all groups.
        trained: training motion of all speakers that has these joints.
        training: that of this speaker; of all speakers if this one has none.
    """

    joints: tuple[str, ...]
    recorded: list[Motion]
    recordings: np.ndarray
    takes: np.ndarray
    generated: list[Motion]
    clips: np.ndarray
    trained: list[Motion]
    training: list[Motion]

    def splits(self) -> list[tuple[list[Motion], list[Motion]]]:
        """Return pairs of (held-out recordings, other recordings of the speaker) to compare.

        Held-out recordings are compared with training motion if there is any, else each take with
        the other takes, else one half of a single take with the other half.
        """
        if self.training:
            return [(self.recorded, self.training)]
        takes = sorted(set(self.takes.tolist()))
        if len(takes) < 2:
            both = halves(self.recorded)
            return [both, both[::-1]]
        every = list(zip(self.recorded, self.takes))
        return [
            ([m for m, take in every if take == held], [m for m, take in every if take != held])
            for held in evenly(takes, MOST_TAKES)
        ]

    def distances(
        self, motions: list[Motion], side: str, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return (N,) distances of windows to the nearest training motion, and motion of each.

        Args:
            motions: `generated` or `recorded`.
            side: of the arm whose windows are compared; "" compares all joints.
            rng: draws windows, if there are too many.
        """
        if side:
            arms, owners = arm_windows(motions, side)
            return nearest_arm(arms, self.trained, side), owners
        windows = subsample(motion_windows(motions, self.joints), rng)
        return nearest_training(windows, self.trained, self.joints), windows.clips


class PooledMetrics:
    """Accumulates the clips of one model and computes the metrics of all of them pooled.

    Args:
        training: motion of the training split; without any, takes are compared with each other.
        seed: seed of subsamples.
        known: values of recordings that other models have in common; filled here.

    Attributes:
        by_clip: the measures of each clip, in the order of `add`; filled by `results`.
        problems: (key, reason) of metrics that could not be computed.
    """

    def __init__(self, training: TrainingMotion, seed: int, known: dict[Hashable, Any]) -> None:
        self.training, self.seed, self._known = training, seed, known
        self.problems: list[tuple[str, str]] = []
        self.by_clip: list[dict[str, float]] = []
        self._recordings: dict[Window, _Recording] = {}
        self._recording_of: list[int] = []  # number of each clip's recording
        self._recorded, self._generated = MotionSample(seed), MotionSample(seed)
        self._without_hands: MotionError | None = None
        self._digest = hashlib.sha256()  # of the recordings

    def add(self, clip: Clip) -> None:
        """Add a clip and its recording."""
        key = clip.pair.of
        if key not in self._recordings:
            motion = at_rate(clip.recording, FPS)
            self._recorded.add(motion)
            self._digest.update(np.ascontiguousarray(motion.rotations).data)
            known, hands = len(self._recordings), self._hands_of(motion)
            self._recordings[key] = _Recording(
                known, clip.pair, motion.skeleton, clip.joints, hands
            )
        recording = self._recordings[key]
        recording.joints = tuple(name for name in recording.joints if name in clip.joints)
        motion = at_rate(clip.generated, FPS)
        self._generated.add(motion)
        recording.samples += self._hands_of(motion)
        self._recording_of.append(recording.number)
        self.by_clip.append({})

    def _hands_of(self, motion: Motion) -> list[Hands]:
        """Return the hands of a motion; without any, return nothing and keep the error."""
        try:
            return [Hands.of(motion)]
        except MotionError as error:
            self._without_hands = self._without_hands or error
            return []

    def results(self) -> dict[str, MetricResult]:
        """Compute the metrics; those that fail are listed in `problems`."""
        metrics: dict[str, MetricResult] = {}
        parts: list[tuple[Sequence[str], Callable[[], dict[str, MetricResult]]]] = [
            (HAND_KEYS, self._hands),
            (["calm_lively_r", "calm_lively_slope"], self._calm_and_lively),
            (["one_nn", "within_reach"], self._windows),
            (["copying", "copying_low"], partial(self._copying, "")),
            *(([key], partial(self._copying, side)) for side, key in ARM_KEYS.items()),
            (["calibration", "seed_spread", "sharpness"], self._calibration),
        ]
        for names, compute in parts:
            try:
                metrics |= compute()
            except GestureKitError as error:
                self.problems += [(name, str(error)) for name in names]
        return metrics

    @cached_property
    def _groups(self) -> list[_Group]:
        """Clips by speaker (and style), of those in the samples."""
        every = list(self._recordings.values())
        names = groups_of([recording.pair for recording in every])
        recorded = list(zip(self._recorded.owners, self._recorded.motions))
        generated = sorted(  # in the order of their recordings
            zip(self._generated.owners, self._generated.motions),
            key=lambda clip: self._recording_of[clip[0]],
        )
        groups = []
        for name in dict.fromkeys(names):
            own = [(n, motion) for n, motion in recorded if names[n] == name]
            clips = [(n, m) for n, m in generated if names[self._recording_of[n]] == name]
            if not own or not clips:
                continue
            members = [recording for recording, of in zip(every, names) if of == name]
            upper = upper_joints(members[0].skeleton)
            joints = tuple(n for n in upper if all(n in one.joints for one in members))
            trained = self.training.with_joints(joints)
            speaker = members[0].pair.speaker
            groups.append(
                _Group(
                    joints,
                    recorded=[motion for _, motion in own],
                    recordings=np.array([n for n, _ in own]),
                    takes=np.array([every[n].pair.take for n, _ in own]),
                    generated=[motion for _, motion in clips],
                    clips=np.array([n for n, _ in clips]),
                    trained=(fitting := [motion for motion, _ in trained]),
                    training=[motion for motion, of in trained if of == speaker] or fitting,
                )
            )
        return groups

    def _result(
        self, key: str, value: float, own: float | None, note: str = "", informative: bool = True
    ) -> MetricResult:
        interval = whole_set(value, self._generated.count)
        return MetricResult(key, interval, own, note=note, informative=informative)

    def _with_hands(self) -> tuple[list[Hands], list[list[Hands]]]:
        """Return the hands of all recordings, and those of the clips for each.

        Raises:
            MotionError: a motion has none.
        """
        if self._without_hands is not None:
            raise self._without_hands
        every = self._recordings.values()
        return [hands for one in every for hands in one.hands], [one.samples for one in every]

    def _hands(self) -> dict[str, MetricResult]:
        recorded, samples = self._with_hands()
        ours = hand_values([hands for clips in samples for hands in clips])
        theirs, results = hand_values(recorded), {}
        # A held-out take may be livelier than all of training; a model can only know the latter.
        motions = self.training.motions
        trained = self._once("hands", lambda: hand_values(motions) if motions else {})
        for key in HAND_KEYS:
            known = np.isfinite(trained.get(key, np.nan))
            note = f"training recordings: {trained[key]:.2f}" if known else ""
            if np.isfinite(ours[key]):
                own = theirs[key] if np.isfinite(theirs[key]) else None
                results[key] = self._result(key, ours[key], own, note)
            else:
                self.problems.append((key, "the clips are too short, or the hands never move"))
        return results

    def _calm_and_lively(self) -> dict[str, MetricResult]:
        found = calm_and_lively(*self._with_hands())
        values = {"calm_lively_r": found.r, "calm_lively_slope": found.slope}
        note, enough = f"{found.n} windows", found.n >= ENOUGH_CALM
        return {key: self._result(key, value, 1.0, note, enough) for key, value in values.items()}

    def _calibration(self) -> dict[str, MetricResult]:
        """Return the calibration of a model with enough samples of each clip; {} for others."""
        counts = np.bincount(self._recording_of)
        if counts.min() < LEAST_SEEDS or len(counts) < 2:
            return {}
        recorded, samples = self._with_hands()
        length = round(float(np.median([len(hands.paths) for hands in recorded])))
        speaker = [
            hand_level(motion[start : start + length])
            for motion in self.training.motions
            for start in range(0, motion.n_frames - length + 1, length)
        ]
        levels = [[hand_level(hands) for hands in clips] for clips in samples]
        found = calibration(levels, [hand_level(hands) for hands in recorded], speaker)
        note = f"{found.clips} clips of {found.seeds} samples"
        values = {
            "calibration": (found.coverage, NOMINAL),
            "seed_spread": (found.spread, None),
            "sharpness": (found.sharpness, 1.0),
        }
        return {key: self._result(key, value, own, note) for key, (value, own) in values.items()}

    def _windows(self) -> dict[str, MetricResult]:
        votes, reached = [], []
        for group in self._groups:
            ours = motion_windows(group.generated, group.joints)
            theirs = motion_windows(group.recorded, group.joints)
            n, (right, drawn) = len(ours), two_sample_votes(ours, theirs, seed=self.seed)
            votes.append((right.sum(), drawn.sum()))
            mine = _shares(group.clips[ours.clips], right[:n], drawn[:n])
            recorded = _shares(group.recordings[theirs.clips], right[n:], drawn[n:])
            for clip, share in mine.items():  # the mean of its windows' and its recording's
                if (number := self._recording_of[clip]) in recorded:
                    self.by_clip[clip]["one_nn"] = float(share + recorded[number]) / 2
            reached.append((len(theirs), 100.0 * within_reach(ours, theirs, seed=self.seed)))
        right, drawn = np.sum(votes, axis=0)
        windows, reach = np.transpose(reached)
        share = float(np.average(reach, weights=windows))
        values = {"one_nn": float(right / drawn), "within_reach": share}
        own, note = self._once("windows", self._own_windows)
        return {key: self._result(key, value, own.get(key), note) for key, value in values.items()}

    def _own_windows(self) -> tuple[dict[str, float], str]:
        """Return the values of held-out recordings against others, and a note."""
        found = []
        try:
            for group in self._groups:
                for sides in group.splits():
                    ours, theirs = (motion_windows(side, group.joints) for side in sides)
                    accuracy = two_sample_accuracy(theirs, ours, seed=self.seed)
                    found.append((accuracy, 100.0 * within_reach(theirs, ours, seed=self.seed)))
        except MotionError:
            return {}, "no value of the recordings: they are too short"
        accuracy, reach = (float(np.mean(values)) for values in zip(*found, strict=True))
        return {"one_nn": accuracy, "within_reach": reach}, f"recording: {self._compared()}"

    def _copying(self, side: str) -> dict[str, MetricResult]:
        """Return distances to training motion, of an arm or (side "") of all; {} without any."""
        if not self.training.motions:
            return {}
        key, rng, distances = ARM_KEYS.get(side, "copying"), np.random.default_rng(self.seed), []
        for group in self._groups:
            values, owners = group.distances(group.generated, side, rng)
            distances.append(values)
            clips = group.clips[owners]
            for clip in np.unique(clips):
                self.by_clip[clip][key] = float(np.median(values[clips == clip]))
        ours, own = np.concatenate(distances), self._once(key, partial(self._own_distances, side))
        if side:
            median = float(np.median(np.concatenate([values for values, _ in own])))
            return {key: self._result(key, float(np.median(ours)), median)}
        quantiles = [np.quantile(values, (0.5, LOW_QUANTILE)) for values, _ in own]
        median, low = np.mean(quantiles, axis=0).tolist()
        takes = [np.median(v[t == take]) for v, t in own for take in np.unique(t)]
        for of_clip in self.by_clip:
            if key in of_clip and median > 0.0:
                of_clip["novelty"] = of_clip[key] / median
        # The ceiling of novelty: the medians of takes relative to all.
        ceiling = replace(level_of(CEILING, np.array(takes) / (median or 1.0)), value=1.0)
        note, lowest = f"recording: {self._compared()}", float(np.quantile(ours, LOW_QUANTILE))
        whole = self._result(key, float(np.median(ours)), median, note)
        return {
            key: replace(whole, ceiling=ceiling),
            "copying_low": self._result("copying_low", lowest, low, note),
        }

    def _own_distances(self, side: str) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return distances of held-out recordings to training motion, and takes, of each group."""
        rng, found = np.random.default_rng(self.seed), []
        for group in self._groups:
            values, owners = group.distances(group.recorded, side, rng)
            found.append((values, group.takes[owners]))
        return found

    def _once(self, name: str, compute: Callable[[], Any]) -> Any:
        """Return a value of the recordings, computed once for all models that share them."""
        # A model lacks the recordings whose clips cannot be read.
        key = (name, tuple(group.joints for group in self._groups), self._digest.hexdigest())
        if key not in self._known:
            self._known[key] = compute()
        return self._known[key]

    def _compared(self) -> str:
        """Return how recordings are compared with recordings, in words."""
        if self.training.motions:
            note = f" ({self.training.note})" if self.training.note else ""
            return f"against the training split{note}"
        if all(group.training or len(set(group.takes.tolist())) > 1 for group in self._groups):
            return "each take against the speaker's others"
        return "one half against the other"


def _shares(owners: np.ndarray, right: np.ndarray, drawn: np.ndarray) -> dict[int, float]:
    """Return {number of a clip: fraction of the draws of its windows (N,) that were right}."""
    total, good = (np.bincount(owners, weights=votes) for votes in (drawn, right))
    return {int(n): good[n] / total[n] for n in np.flatnonzero(total)}
