"""Metrics of all clips pooled (hands, windows, copying), each beside the recordings' own value."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from gesturekit.errors import GestureKitError, MotionError
from gesturekit.evaluation.measuring.clips import Clip
from gesturekit.evaluation.measuring.speakers import (
    TRAINING_SECONDS,
    SpeakerClips,
    TrainingMotion,
    backwards,
    own_windows,
)
from gesturekit.evaluation.metrics.frame_rate import at_rate
from gesturekit.evaluation.metrics.hands import (
    FPS,
    HAND_KEYS,
    LEAST_SEEDS,
    NOMINAL,
    calibration,
    calm_and_lively,
    hand_level,
    hand_values,
    upper_joints,
)
from gesturekit.evaluation.metrics.two_sample import (
    LOW_QUANTILE,
    MotionWindows,
    forward_votes,
    motion_windows,
    nearest_training,
    subsample,
    two_sample_votes,
    within_reach,
)
from gesturekit.evaluation.pairs import Pair
from gesturekit.evaluation.results import Level, MetricResult
from gesturekit.evaluation.statistics.groups import groups_of
from gesturekit.evaluation.statistics.intervals import whole_set
from gesturekit.evaluation.statistics.levels import CEILING, level_of
from gesturekit.motion import Motion

ENOUGH_CALM = 16
"""Windows from which the correlation of calm and lively stretches is informative. Where the true
one is 0.8, that of 4 windows is below 0.4 in 14 of 100 cases, that of 16 windows in 2."""

Window = tuple[str, int | None]
"""A recording and the index of its 10 s window; None for the whole recording."""


class PooledMetrics:
    """Accumulates the clips of one model and computes the metrics of all of them pooled.

    Args:
        training: motion of the training split; without any, takes are compared with each other.
        seed: seed of subsamples.
        known: values of recordings that other models have in common; filled here.
    """

    def __init__(
        self, training: TrainingMotion, seed: int, known: dict[Hashable, Any] | None = None
    ) -> None:
        self.training = training
        self.seed = seed
        self._known = {} if known is None else known
        self.problems: list[tuple[str, str]] = []
        self._pairs: dict[Window, Pair] = {}
        self._recorded: dict[Window, Motion] = {}
        self._generated: dict[Window, list[Motion]] = {}
        self._joints: dict[Window, tuple[str, ...]] = {}  # that all clips of the recording have
        self._added: list[tuple[Window, int]] = []  # window and sample of each clip
        self._by_clip: dict[str, dict[int, float]] = {}  # {key: {number of the clip: value}}

    def add(self, clip: Clip) -> None:
        """Add a clip and its recording."""
        window = (clip.pair.stem, clip.pair.window)
        if window not in self._recorded:
            self._recorded[window] = at_rate(clip.recording, FPS)
            self._pairs[window] = clip.pair
        samples = self._generated.setdefault(window, [])
        self._added.append((window, len(samples)))
        samples.append(at_rate(clip.generated, FPS))
        known = self._joints.get(window, clip.joints)
        self._joints[window] = tuple(name for name in known if name in clip.joints)

    def pooled(self) -> dict[str, MetricResult]:
        """Compute the metrics; those that fail are listed in `problems`."""
        metrics: dict[str, MetricResult] = {}
        for names, compute in (
            (HAND_KEYS, self._hands),
            (["calm_lively_r", "calm_lively_slope"], self._calm_and_lively),
            (["one_nn", "within_reach", "forward"], self._windows),
            (["copying", "copying_low"], self._copying),
            (["calibration", "seed_spread", "sharpness"], self._calibration),
        ):
            try:
                metrics |= compute()
            except GestureKitError as error:
                self.problems += [(name, str(error)) for name in names]
        return metrics

    def by_clip(self) -> list[dict[str, float]]:
        """Return the measures of each clip, in the order of `add`, after `pooled`."""
        numbers = {}
        for window, samples in self._generated.items():
            for sample in range(len(samples)):
                numbers[window, sample] = len(numbers)
        return [
            {key: values[n] for key, values in self._by_clip.items() if n in values}
            for n in (numbers[added] for added in self._added)
        ]

    @cached_property
    def _groups(self) -> list[SpeakerClips]:
        """Clips by speaker (and style)."""
        names = groups_of(list(self._pairs.values()))
        numbers = iter(range(len(self._added)))
        numbered = {w: [next(numbers) for _ in clips] for w, clips in self._generated.items()}
        groups = []
        for name in dict.fromkeys(names):
            windows = [window for window, of in zip(self._pairs, names) if of == name]
            clips = [(n, m) for w in windows for n, m in zip(numbered[w], self._generated[w])]
            known = [set(self._joints[window]) for window in windows]
            rig = self._recorded[windows[0]].skeleton
            joints = tuple(n for n in upper_joints(rig) if all(n in one for one in known))
            groups.append(
                SpeakerClips(
                    recorded=[self._recorded[window] for window in windows],
                    takes=[self._pairs[window].take for window in windows],
                    generated=[motion for _, motion in clips],
                    numbers=[number for number, _ in clips],
                    recording_of=[i for i, w in enumerate(windows) for _ in numbered[w]],
                    joints=joints,
                    training=self.training.of_speaker(self._pairs[windows[0]].speaker, joints),
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
        interval = whole_set(value, sum(map(len, self._generated.values())))
        return MetricResult(key, interval, recording, note=note, informative=informative)

    def _hands(self) -> dict[str, MetricResult]:
        ours, theirs = map(hand_values, (self._all_generated(), self._all_recorded()))
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

    def _trained_hands(self) -> dict[str, float]:
        """Return the hand values of the training recordings; {} without these.

        A held-out take may be livelier than all of training; a model can only know the latter.
        """
        found = hand_values(self.training.motions) if self.training.motions else {}
        return {key: value for key, value in found.items() if np.isfinite(value)}

    def _calm_and_lively(self) -> dict[str, MetricResult]:
        found = calm_and_lively(self._all_recorded(), list(self._generated.values()))
        values = {"calm_lively_r": found.r, "calm_lively_slope": found.slope}
        note, enough = f"{found.n} windows", found.n >= ENOUGH_CALM
        return {key: self._result(key, value, 1.0, note, enough) for key, value in values.items()}

    def _calibration(self) -> dict[str, MetricResult]:
        """Return the calibration of a model with enough samples of each clip; {} for others."""
        if min(map(len, self._generated.values())) < LEAST_SEEDS or len(self._generated) < 2:
            return {}
        recorded = self._all_recorded()
        length = round(float(np.median([motion.n_frames for motion in recorded])))
        speaker = [
            hand_level(motion.slice(start, start + length))
            for motion in self.training.motions
            for start in range(0, motion.n_frames - length + 1, length)
        ]
        found = calibration(
            [[hand_level(motion) for motion in samples] for samples in self._generated.values()],
            [hand_level(motion) for motion in recorded],
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
        votes, ahead, reached = [], [], []
        for group in self._groups:
            joints, recorded = group.joints, group.recorded
            ours, theirs = (motion_windows(m, joints) for m in (group.generated, recorded))
            back = motion_windows([backwards(motion) for motion in recorded], joints)
            right, drawn = two_sample_votes(ours, theirs, seed=self.seed)
            votes.append((right.sum(), drawn.sum()))
            self._vote(group, right, drawn, ours, theirs)
            ahead.append(100.0 * forward_votes(ours, theirs, back))
            self._keep("forward", group, _clip_means(ours, ahead[-1]))
            reached.append((len(theirs), 100.0 * within_reach(ours, theirs, seed=self.seed)))
        right, drawn = np.sum(votes, axis=0)
        windows, reach = np.transpose(reached)
        values = {
            "one_nn": float(right / drawn),
            "within_reach": float(np.average(reach, weights=windows)),
            "forward": float(np.concatenate(ahead).mean()),
        }
        own, note = self._once("windows", self._own_windows)
        return {key: self._result(key, value, own.get(key), note) for key, value in values.items()}

    def _own_windows(self) -> tuple[dict[str, float], str]:
        """Return the values of held-out recordings against others, and a note."""
        found: dict[str, list[float]] = {}
        try:
            for group in self._groups:
                for held, others in group.splits():
                    for key, value in own_windows(held, others, group.joints, self.seed).items():
                        found.setdefault(key, []).append(value)
        except MotionError:
            return {}, "no value of the recordings: they are too short"
        means = {key: float(np.mean(values)) for key, values in found.items()}
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
        mine, own = (
            {
                clip: right[side][windows.clips == clip].sum() / count
                for clip in set(windows.clips.tolist())
                if (count := drawn[side][windows.clips == clip].sum())
            }
            for side, windows in ((slice(n), ours), (slice(n, None), theirs))
        )
        accuracies = {
            clip: float(value + own[recording]) / 2
            for clip, value in mine.items()
            if (recording := group.recording_of[clip]) in own
        }
        self._keep("one_nn", group, accuracies)

    def _keep(self, key: str, group: SpeakerClips, values: Mapping[int, float]) -> None:
        """Keep the values of the clips of a group, by their index in it."""
        known = self._by_clip.setdefault(key, {})
        known |= {group.numbers[clip]: value for clip, value in values.items()}

    def _copying(self) -> dict[str, MetricResult]:
        rng = np.random.default_rng(self.seed)
        every = []
        for group in self._groups:
            among = self._among(group.joints) or _at_most(group.recorded)
            ours = subsample(motion_windows(group.generated, group.joints), rng)
            every.append(nearest_training(ours, among, group.joints))
            self._keep("copying", group, _clip_means(ours, every[-1], np.median))
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

    def _among(self, joints: Sequence[str]) -> list[Motion]:
        """Return the training motion of all speakers that has these joints."""
        motions = self.training.motions
        return [motion for motion in motions if set(joints) <= set(motion.skeleton.names)]

    def _own_copying(self) -> tuple[float, float, Level]:
        """Return median and 5 % quantile of the distances of held-out recordings to others.

        Returns:
            both, and the ceiling of novelty: the medians of takes relative to all.
        """
        rng = np.random.default_rng(self.seed)
        quantiles, medians = [], []
        single = not any(group.has_others for group in self._groups)
        for group in self._groups:
            for mine, others in group.splits():
                windows = subsample(motion_windows(mine, group.joints), rng)
                among = self._among(group.joints) or _at_most(others)
                distances = nearest_training(windows, among, group.joints)
                quantiles.append(np.quantile(distances, (0.5, LOW_QUANTILE)))
                takes = group.takes if group.training else [""] * len(mine)
                take = np.array(takes)[windows.clips]
                if single or group.has_others:
                    medians += [np.median(distances[take == name]) for name in set(take.tolist())]
        median, low = np.mean(quantiles, axis=0)
        ceiling = level_of(CEILING, np.array(medians) / (median or 1.0), pieces=single)
        return float(median), float(low), replace(ceiling, value=1.0)

    def _once(self, name: str, compute: Callable[[], Any]) -> Any:
        """Return a value of the recordings, computed once for all models that share them."""
        key = (name, tuple(group.joints for group in self._groups), self._recordings)
        if key not in self._known:
            self._known[key] = compute()
        return self._known[key]

    @cached_property
    def _recordings(self) -> str:
        """Digest of the recordings: a model lacks those whose clips cannot be read."""
        digest = hashlib.sha256()
        for motion in self._recorded.values():
            digest.update(np.ascontiguousarray(motion.rotations))
        return digest.hexdigest()

    def _compared(self) -> str:
        """Return how recordings are compared with recordings, in words."""
        if self.training.motions:
            note = f" ({self.training.note})" if self.training.note else ""
            return f"against the training split{note}"
        if all(group.has_others for group in self._groups):
            return "each take against the speaker's others"
        return "one half against the other"

    def _all_recorded(self) -> list[Motion]:
        return list(self._recorded.values())

    def _all_generated(self) -> list[Motion]:
        return [motion for samples in self._generated.values() for motion in samples]


def _clip_means(
    windows: MotionWindows,
    values: np.ndarray,
    mean: Callable[[np.ndarray], float] = np.mean,
) -> dict[int, float]:
    """Return {number of a clip: mean of its windows' values}."""
    return {
        clip: float(mean(values[windows.clips == clip])) for clip in set(windows.clips.tolist())
    }


def _at_most(motions: list[Motion], seconds: float = TRAINING_SECONDS) -> list[Motion]:
    """Return the first motions of at most that length together, and at least one."""
    ends = np.cumsum([motion.duration for motion in motions])
    return motions[: max(1, int(np.searchsorted(ends, seconds, side="right")))]
