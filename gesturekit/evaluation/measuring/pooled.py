"""Metrics of all clips pooled (hands, windows, copying), each beside the recordings' own value."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from gesturekit.errors import GestureKitError, MotionError
from gesturekit.evaluation.measuring.clips import Clip
from gesturekit.evaluation.measuring.samples import MotionSample, SpeakerClips, TrainingMotion
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
from gesturekit.evaluation.metrics.inputs import at_rate
from gesturekit.evaluation.metrics.two_sample import (
    ARM_KEYS,
    LOW_QUANTILE,
    MotionWindows,
    arm_windows,
    motion_windows,
    nearest_arm,
    nearest_training,
    subsample,
    two_sample_accuracy,
    two_sample_votes,
    within_reach,
)
from gesturekit.evaluation.pairs import Pair, Window
from gesturekit.evaluation.results import Level, MetricResult
from gesturekit.evaluation.statistics.intervals import groups_of, whole_set
from gesturekit.evaluation.statistics.levels import CEILING, level_of
from gesturekit.motion import Motion, Skeleton

ENOUGH_CALM = 16
"""Windows from which the correlation of calm and lively stretches is informative. Where the true
one is 0.8, that of 4 windows is below 0.4 in 14 of 100 cases, that of 16 windows in 2."""


class PooledMetrics:
    """Accumulates the clips of one model and computes the metrics of all of them pooled.

    Args:
        training: motion of the training split; without any, takes are compared with each other.
        seed: seed of subsamples.
        known: values of recordings that other models have in common; filled here.
    """

    def __init__(self, training: TrainingMotion, seed: int, known: dict[Hashable, Any]) -> None:
        self.training = training
        self.seed = seed
        self._known = known
        self.problems: list[tuple[str, str]] = []
        self._of_window: dict[Window, _Window] = {}
        self._window_of: list[int] = []  # number of each clip's window
        self._recorded, self._generated = MotionSample(seed), MotionSample(seed)
        self._without_hands: MotionError | None = None
        self._digest = hashlib.sha256()  # of the recordings
        self._by_clip: dict[str, dict[int, float]] = {}  # {key: {number of the clip: value}}

    def add(self, clip: Clip) -> None:
        """Add a clip and its recording."""
        key = clip.pair.of
        if key not in self._of_window:
            motion = at_rate(clip.recording, FPS)
            self._recorded.add(motion)
            self._digest.update(np.ascontiguousarray(motion.rotations).data)
            self._of_window[key] = _Window(
                len(self._of_window),
                clip.pair,
                motion.skeleton,
                clip.joints,
                self._hands_of(motion),
            )
        window = self._of_window[key]
        window.joints = tuple(name for name in window.joints if name in clip.joints)
        self._window_of.append(window.number)
        motion = at_rate(clip.generated, FPS)
        self._generated.add(motion)
        window.samples += self._hands_of(motion)

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
        for names, compute in (
            (HAND_KEYS, self._hands),
            (["calm_lively_r", "calm_lively_slope"], self._calm_and_lively),
            (["one_nn", "within_reach"], self._windows),
            (["copying", "copying_low"], self._copying),
            (list(ARM_KEYS.values()), self._copied_arms),
            (["calibration", "seed_spread", "sharpness"], self._calibration),
        ):
            try:
                metrics |= compute()
            except GestureKitError as error:
                self.problems += [(name, str(error)) for name in names]
        return metrics

    def by_clip(self) -> list[dict[str, float]]:
        """Return the measures of each clip, in the order of `add`, after `results`."""
        return [
            {key: values[n] for key, values in self._by_clip.items() if n in values}
            for n in range(len(self._window_of))
        ]

    @cached_property
    def _groups(self) -> list[SpeakerClips]:
        """Clips by speaker (and style), of those in the samples."""
        names = groups_of([window.pair for window in self._of_window.values()])
        generated = sorted(  # in the order of their recordings
            zip(self._generated.owners, self._generated.motions),
            key=lambda clip: self._window_of[clip[0]],
        )
        groups = []
        for name in dict.fromkeys(names):
            windows = [w for w, of in zip(self._of_window.values(), names) if of == name]
            recorded = [
                (number, motion)
                for number, motion in zip(self._recorded.owners, self._recorded.motions)
                if names[number] == name
            ]
            clips = [(n, m) for n, m in generated if names[self._window_of[n]] == name]
            if not recorded or not clips:
                continue
            pairs = {window.number: window.pair for window in windows}
            known = [set(window.joints) for window in windows]
            rig = windows[0].skeleton
            joints = tuple(n for n in upper_joints(rig) if all(n in one for one in known))
            groups.append(
                SpeakerClips(
                    recorded=[motion for _, motion in recorded],
                    recordings=np.array([number for number, _ in recorded]),
                    takes=[pairs[number].take for number, _ in recorded],
                    generated=[motion for _, motion in clips],
                    clips=np.array([number for number, _ in clips]),
                    recording_of=self._window_of,
                    joints=joints,
                    training=self.training.of_speaker(windows[0].pair.speaker, joints),
                )
            )
        return groups

    def _result(
        self,
        key: str,
        value: float,
        recording: float | None,
        note: str = "",
        informative: bool = True,
    ) -> MetricResult:
        interval = whole_set(value, self._generated.count)
        return MetricResult(key, interval, recording, note=note, informative=informative)

    def _hands(self) -> dict[str, MetricResult]:
        samples = [hands for window in self._with_hands for hands in window.samples]
        ours, theirs = map(hand_values, (samples, self._recorded_hands))
        trained = self._once("hands", self._trained_hands)
        results = {}
        for key in HAND_KEYS:
            value, own = ours[key], theirs[key]
            note = f"training recordings: {trained[key]:.2f}" if key in trained else ""
            if np.isfinite(value):
                results[key] = self._result(key, value, own if np.isfinite(own) else None, note)
            else:
                self.problems.append((key, "the clips are too short, or the hands never move"))
        return results

    @property
    def _recorded_hands(self) -> list[Hands]:
        return [hands for window in self._with_hands for hands in window.recorded]

    @property
    def _with_hands(self) -> list[_Window]:
        """The windows, with the hands of all their motions.

        Raises:
            MotionError: a motion has none.
        """
        if self._without_hands is not None:
            raise self._without_hands
        return list(self._of_window.values())

    def _trained_hands(self) -> dict[str, float]:
        """Return the hand values of the training recordings; {} without these.

        A held-out take may be livelier than all of training; a model can only know the latter.
        """
        found = hand_values(self.training.motions) if self.training.motions else {}
        return {key: value for key, value in found.items() if np.isfinite(value)}

    def _calm_and_lively(self) -> dict[str, MetricResult]:
        found = calm_and_lively(
            self._recorded_hands, [window.samples for window in self._with_hands]
        )
        values = {"calm_lively_r": found.r, "calm_lively_slope": found.slope}
        note, enough = f"{found.n} windows", found.n >= ENOUGH_CALM
        return {key: self._result(key, value, 1.0, note, enough) for key, value in values.items()}

    def _calibration(self) -> dict[str, MetricResult]:
        """Return the calibration of a model with enough samples of each clip; {} for others."""
        counts = np.bincount(self._window_of)
        if counts.min() < LEAST_SEEDS or len(counts) < 2:
            return {}
        recorded = self._recorded_hands
        length = round(float(np.median([len(hands.paths) for hands in recorded])))
        speaker = [
            hand_level(motion[start : start + length])
            for motion in self.training.motions
            for start in range(0, motion.n_frames - length + 1, length)
        ]
        found = calibration(
            [[hand_level(hands) for hands in window.samples] for window in self._with_hands],
            [hand_level(hands) for hands in recorded],
            speaker,
        )
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
            right, drawn = two_sample_votes(ours, theirs, seed=self.seed)
            votes.append((right.sum(), drawn.sum()))
            self._vote(group, right, drawn, ours, theirs)
            reached.append((len(theirs), 100.0 * within_reach(ours, theirs, seed=self.seed)))
        right, drawn = np.sum(votes, axis=0)
        windows, reach = np.transpose(reached)
        values = {
            "one_nn": float(right / drawn),
            "within_reach": float(np.average(reach, weights=windows)),
        }
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
        means = {"one_nn": accuracy, "within_reach": reach}
        return means, f"recording: {self._compared()}"

    def _vote(
        self,
        group: SpeakerClips,
        right: np.ndarray,
        drawn: np.ndarray,
        ours: MotionWindows,
        theirs: MotionWindows,
    ) -> None:
        """Keep the 1-NN accuracy of each clip: the mean of its windows' and its recording's."""
        n = len(ours)
        mine = _shares(group.clips[ours.clips], right[:n], drawn[:n])
        own = _shares(group.recordings[theirs.clips], right[n:], drawn[n:])
        accuracies = {
            clip: float(value + own[recording]) / 2
            for clip, value in mine.items()
            if (recording := group.recording_of[clip]) in own
        }
        self._keep("one_nn", accuracies)

    def _keep(self, key: str, values: Mapping[int, float]) -> None:
        """Keep values of clips, by number."""
        known = self._by_clip.setdefault(key, {})
        known |= values

    def _copying(self) -> dict[str, MetricResult]:
        """Return distances to training motion; {} without any."""
        if not self.training.motions:
            return {}
        rng = np.random.default_rng(self.seed)
        every = []
        for group in self._groups:
            ours = subsample(motion_windows(group.generated, group.joints), rng)
            every.append(nearest_training(ours, self._among(group.joints), group.joints))
            self._keep("copying", _clip_medians(group.clips[ours.clips], every[-1]))
        distances = np.concatenate(every)
        median, low, ceiling = self._once("copying", self._own_copying)
        if median > 0.0:
            self._by_clip["novelty"] = {
                clip: value / median for clip, value in self._by_clip["copying"].items()
            }
        note = f"recording: {self._compared()}"
        values = {
            "copying": (float(np.median(distances)), median),
            "copying_low": (float(np.quantile(distances, LOW_QUANTILE)), low),
        }
        found = {key: self._result(key, value, own, note) for key, (value, own) in values.items()}
        return {**found, "copying": replace(found["copying"], ceiling=ceiling)}

    def _copied_arms(self) -> dict[str, MetricResult]:
        """Return distances of each arm to training motion; {} without any."""
        results = {}
        for side, key in ARM_KEYS.items() if self.training.motions else ():
            every = []
            for group in self._groups:
                windows = arm_windows(group.generated, side)
                every.append(nearest_arm(windows, self._among(group.joints), side))
                self._keep(key, _clip_medians(group.clips[windows.clips], every[-1]))
            own = self._once(key, partial(self._own_arm, side))
            results[key] = self._result(key, float(np.median(np.concatenate(every))), own)
        return results

    def _own_arm(self, side: str) -> float:
        """Return the median distance of held-out recordings' arms to training motion."""
        return float(np.median(np.concatenate([
            nearest_arm(arm_windows(group.recorded, side), self._among(group.joints), side)
            for group in self._groups
        ])))  # fmt: skip

    def _among(self, joints: Sequence[str]) -> list[Motion]:
        """Return the training motion of all speakers that has these joints."""
        motions = self.training.motions
        return [motion for motion in motions if set(joints) <= set(motion.skeleton.names)]

    def _own_copying(self) -> tuple[float, float, Level]:
        """Return median and 5 % quantile of the distances of held-out recordings to training.

        Returns:
            both, and the ceiling of novelty: the medians of takes relative to all.
        """
        rng = np.random.default_rng(self.seed)
        quantiles, medians = [], []
        for group in self._groups:
            windows = subsample(motion_windows(group.recorded, group.joints), rng)
            distances = nearest_training(windows, self._among(group.joints), group.joints)
            quantiles.append(np.quantile(distances, (0.5, LOW_QUANTILE)))
            take = np.array(group.takes)[windows.clips]
            medians += [np.median(distances[take == name]) for name in set(take.tolist())]
        median, low = np.mean(quantiles, axis=0)
        ceiling = level_of(CEILING, np.array(medians) / (median or 1.0))
        return float(median), float(low), replace(ceiling, value=1.0)

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
        if all(group.has_others for group in self._groups):
            return "each take against the speaker's others"
        return "one half against the other"


@dataclass
class _Window:
    """A recording and the hands of the clips for it.

    Attributes:
        number: number of the recording, from 0.
        pair: its first clip.
        skeleton: its rig.
        joints: names of the joints that all its clips have.
        recorded: its hands; empty for a rig without.
        samples: hands of its clips.
    """

    number: int
    pair: Pair
    skeleton: Skeleton
    joints: tuple[str, ...]
    recorded: list[Hands]
    samples: list[Hands] = field(default_factory=list)


def _shares(owners: np.ndarray, right: np.ndarray, drawn: np.ndarray) -> dict[int, float]:
    """Return {number of a clip: fraction of the draws of its windows (N,) that were right}."""
    total, good = (np.bincount(owners, weights=votes) for votes in (drawn, right))
    return {int(n): good[n] / total[n] for n in np.flatnonzero(total)}


def _clip_medians(owners: np.ndarray, values: np.ndarray) -> dict[int, float]:
    """Return {number of a clip: median of the values of its windows (N,)}."""
    order = np.argsort(owners, kind="stable")
    clips, first = np.unique(owners[order], return_index=True)
    parts = np.split(values[order], first[1:])
    return {clip: float(np.median(part)) for clip, part in zip(clips.tolist(), parts)}
