"""Metrics of all clips pooled (hands, windows, copying), each beside the recordings' own value."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from gesturekit.errors import GestureKitError, MotionError
from gesturekit.evaluation.measuring.clips import Clip, load_recording
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
    two_sample_accuracy,
    two_sample_votes,
    within_reach,
)
from gesturekit.evaluation.pairs import Excluded, ItemInterval, Items
from gesturekit.evaluation.results import MetricResult
from gesturekit.evaluation.statistics.intervals import whole_set
from gesturekit.motion import Motion

TRAINING_SECONDS = 1200.0
"""Length of training motion that is compared with, at most; of more, items are drawn at random."""

ENOUGH_CALM = 16
"""Windows from which the correlation of calm and lively stretches is informative. Where the true
one is 0.8, that of 4 windows is below 0.4 in 14 of 100 cases, that of 16 windows in 2."""


@dataclass
class TrainingMotion:
    """Motion of the manifest's training split.

    Attributes:
        motions: at 25 fps; empty without such a split.
        note: "" or how much of the split is used.
        excluded: items that cannot be read.
    """

    motions: list[Motion] = field(default_factory=list)
    note: str = ""
    excluded: list[Excluded] = field(default_factory=list)

    @classmethod
    def of(cls, reference: Path | Items, seed: int) -> TrainingMotion:
        """Read the training split that belongs to recordings; nothing unless they are `Items`."""
        found = cls()
        items = list(reference.training) if isinstance(reference, Items) else []
        total = sum(item.duration for item in items)
        if total > TRAINING_SECONDS:
            np.random.default_rng(seed).shuffle(items)
        left = TRAINING_SECONDS
        for item in items:
            if left < 1.0:
                break
            try:
                motion = load_recording(ItemInterval(item), FPS)
            except GestureKitError as error:
                found.excluded.append(Excluded(item.id, str(error), "the training split"))
                continue
            motion = motion.slice(0, min(motion.n_frames, round(left * FPS)))
            left -= motion.duration
            found.motions.append(motion)
        if total > TRAINING_SECONDS:
            found.note = f"{TRAINING_SECONDS / 60:.0f} of {total / 60:.0f} min of it"
        return found


class PooledMetrics:
    """Accumulates the clips of one model and computes the metrics of all of them pooled.

    Args:
        training: motion of the training split; without any, recordings are compared half by half.
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
        self._recorded: dict[tuple[str, int | None], Motion] = {}
        self._generated: dict[tuple[str, int | None], list[Motion]] = {}
        self._joints: tuple[str, ...] | None = None  # joints that all clips have
        self._added: list[tuple[tuple[str, int | None], int]] = []  # window and sample of each clip
        self._by_clip: dict[str, dict[int, float]] = {}  # {key: {number of the clip: value}}

    def add(self, clip: Clip) -> None:
        """Add a clip and its recording."""
        window = (clip.pair.stem, clip.pair.window)
        if window not in self._recorded:
            self._recorded[window] = at_rate(clip.recording, FPS)
        samples = self._generated.setdefault(window, [])
        self._added.append((window, len(samples)))
        samples.append(at_rate(clip.generated, FPS))
        known = clip.joints if self._joints is None else self._joints
        self._joints = tuple(name for name in known if name in clip.joints)

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
    def _recording_of(self) -> list[int]:
        """Number of the recording of each clip, in the order of `_all_generated`."""
        return [n for n, clips in enumerate(self._generated.values()) for _ in clips]

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
        trained = self._once("hands", (), self._trained_hands)
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
        joints = self._upper_joints()
        recorded = self._all_recorded()
        ours, theirs = (
            motion_windows(motions, joints) for motions in (self._all_generated(), recorded)
        )
        back = motion_windows([_reversed(motion) for motion in recorded], joints)
        right, drawn = two_sample_votes(ours, theirs, seed=self.seed)
        forward = 100.0 * forward_votes(ours, theirs, back)
        self._vote(right, drawn, ours, theirs)
        self._by_clip["forward"] = _clip_means(ours, forward)
        values = {
            "one_nn": float(right.sum() / drawn.sum()),
            "within_reach": 100.0 * within_reach(ours, theirs, seed=self.seed),
            "forward": float(forward.mean()),
        }
        own, note = self._once("windows", joints, lambda: self._own_windows(joints))
        return {key: self._result(key, value, own.get(key), note) for key, value in values.items()}

    def _own_windows(self, joints: Sequence[str]) -> tuple[dict[str, float], str]:
        """Return the values of held-out recordings against others, and a note."""
        found: dict[str, list[float]] = {}
        try:
            for held, others in self._splits():
                mine, theirs = motion_windows(held, joints), motion_windows(others, joints)
                back = motion_windows([_reversed(motion) for motion in others], joints)
                for key, value in (
                    ("one_nn", two_sample_accuracy(theirs, mine, seed=self.seed)),
                    ("within_reach", 100.0 * within_reach(theirs, mine, seed=self.seed)),
                    ("forward", 100.0 * float(forward_votes(mine, theirs, back).mean())),
                ):
                    found.setdefault(key, []).append(value)
        except MotionError:
            return {}, "no value of the recordings: they are too short"
        means = {key: float(np.mean(values)) for key, values in found.items()}
        return means, f"recording: {self._compared()}"

    def _vote(
        self, right: np.ndarray, drawn: np.ndarray, ours: MotionWindows, theirs: MotionWindows
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
        self._by_clip["one_nn"] = {
            clip: float(value + own[recording]) / 2
            for clip, value in mine.items()
            if (recording := self._recording_of[clip]) in own
        }

    def _copying(self) -> dict[str, MetricResult]:
        joints, recorded = self._upper_joints(), self._all_recorded()
        among = self.training.motions or _at_most(recorded)
        rng = np.random.default_rng(self.seed)
        ours = subsample(motion_windows(self._all_generated(), joints), rng)
        distances = nearest_training(ours, among, joints)
        self._by_clip["copying"] = _clip_means(ours, distances, np.median)
        median, low = self._once("copying", joints, lambda: self._own_copying(joints))
        if median > 0.0:
            self._by_clip["novelty"] = {
                clip: value / median for clip, value in self._by_clip["copying"].items()
            }
        note = f"recording: {self._compared()}"
        values = {
            "copying": (float(np.median(distances)), median),
            "copying_low": (float(np.quantile(distances, LOW_QUANTILE)), low),
        }
        return {key: self._result(key, value, own, note) for key, (value, own) in values.items()}

    def _own_copying(self, joints: Sequence[str]) -> tuple[float, float]:
        """Return median and 5 % quantile of the distances of held-out recordings to others."""
        rng = np.random.default_rng(self.seed)
        quantiles = []
        for mine, others in self._splits():
            windows = subsample(motion_windows(mine, joints), rng)
            distances = nearest_training(windows, _at_most(others), joints)
            quantiles.append(np.quantile(distances, (0.5, LOW_QUANTILE)))
        median, low = np.mean(quantiles, axis=0)
        return float(median), float(low)

    def _once(self, name: str, joints: Sequence[str], compute: Callable[[], Any]) -> Any:
        """Return a value of the recordings, computed once for all models that share them."""
        key = (name, tuple(joints), self._recordings)
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

    def _splits(self) -> list[tuple[list[Motion], list[Motion]]]:
        """Return pairs of (held-out recordings, other recordings) to compare."""
        recorded = self._all_recorded()
        if self.training.motions:
            return [(recorded, self.training.motions)]
        if len(recorded) > 1:
            halves = recorded[::2], recorded[1::2]
        else:
            (motion,) = recorded
            middle = motion.n_frames // 2
            if middle < 1:
                raise MotionError("the recording is too short to be cut into halves")
            halves = [motion.slice(0, middle)], [motion.slice(middle, motion.n_frames)]
        return [halves, halves[::-1]]

    def _compared(self) -> str:
        """Return how recordings are compared with recordings, in words."""
        if not self.training.motions:
            return "one half against the other"
        note = f" ({self.training.note})" if self.training.note else ""
        return f"against the training split{note}"

    def _upper_joints(self) -> tuple[str, ...]:
        rig = next(iter(self._recorded.values())).skeleton
        return tuple(name for name in upper_joints(rig) if name in (self._joints or ()))

    def _all_recorded(self) -> list[Motion]:
        return list(self._recorded.values())

    def _all_generated(self) -> list[Motion]:
        return [motion for samples in self._generated.values() for motion in samples]


def _reversed(motion: Motion) -> Motion:
    """Return a motion with its frames in reverse order."""
    return replace(
        motion,
        rotations=motion.rotations[::-1],
        translation=motion.translation[::-1],
        joint_translations={name: v[::-1] for name, v in motion.joint_translations.items()},
    )


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
