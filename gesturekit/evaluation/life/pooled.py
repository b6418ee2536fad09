"""Measures of life of a set of clips, pooled, each beside the recordings' own value."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gesturekit.errors import GestureKitError, MotionError
from gesturekit.evaluation.clips import Clip, load_recording
from gesturekit.evaluation.frame_rate import at_rate
from gesturekit.evaluation.intervals import whole_set
from gesturekit.evaluation.metrics.life import (
    FPS,
    calm_and_lively,
    hand_movement,
    upper_joints,
)
from gesturekit.evaluation.metrics.two_sample import (
    copying,
    motion_windows,
    two_sample_accuracy,
    within_reach,
)
from gesturekit.evaluation.pairs import Excluded, Items, Stretch
from gesturekit.evaluation.results import MetricResult
from gesturekit.motion import Motion

TRAINING_SECONDS = 1200.0
"""Length of training motion that is compared with, at most; of more, items are drawn at random."""

_HANDS = {
    "q10": ("hand_q10", 1.0),
    "q50": ("hand_q50", 1.0),
    "q90": ("hand_q90", 1.0),
    "q99": ("hand_q99", 1.0),
    "rest": ("rest", 100.0),
    "near_still": ("near_still", 100.0),
    "reach": ("reach", 1.0),
    "range": ("speed_range", 1.0),
}  # field of `HandMovement`: key of `definitions`, factor to its unit


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
                motion = load_recording(Stretch(item), FPS)
            except GestureKitError as error:
                found.excluded.append(Excluded(item.id, str(error), "the training split"))
                continue
            motion = motion.slice(0, min(motion.n_frames, round(left * FPS)))
            left -= motion.duration
            found.motions.append(motion)
        if total > TRAINING_SECONDS:
            found.note = f"{TRAINING_SECONDS / 60:.0f} of {total / 60:.0f} min of it"
        return found


class LifeMetrics:
    """Accumulates the clips of one model and computes the measures of life of the set.

    Args:
        training: motion of the training split; without any, recordings are compared half by half.
        seed: seed of subsamples.
    """

    def __init__(self, training: TrainingMotion, seed: int) -> None:
        self.training = training
        self.seed = seed
        self.problems: list[tuple[str, str]] = []
        self._recorded: dict[tuple[str, int | None], Motion] = {}
        self._generated: dict[tuple[str, int | None], list[Motion]] = {}
        self._joints: tuple[str, ...] | None = None  # joints that all clips have

    def add(self, clip: Clip) -> None:
        """Add a clip and its recording."""
        window = (clip.pair.stem, clip.pair.window)
        if window not in self._recorded:
            self._recorded[window] = at_rate(clip.recording, FPS)
        self._generated.setdefault(window, []).append(at_rate(clip.generated, FPS))
        known = clip.joints if self._joints is None else self._joints
        self._joints = tuple(name for name in known if name in clip.joints)

    def pooled(self) -> dict[str, MetricResult]:
        """Compute the measures of life; those that fail are listed in `problems`."""
        figures: dict[str, MetricResult] = {}
        for names, compute in (
            ([key for key, _ in _HANDS.values()], self._hands),
            (["calm_lively_r", "calm_lively_slope"], self._calm_and_lively),
            (["one_nn", "within_reach"], self._windows),
            (["copying", "copying_low"], self._copying),
        ):
            try:
                figures |= compute()
            except GestureKitError as error:
                self.problems += [(name, str(error)) for name in names]
        return figures

    def _result(
        self, key: str, value: float, recording: float | None, note: str = ""
    ) -> MetricResult:
        n = sum(map(len, self._generated.values()))
        return MetricResult(key, whole_set(value, n), recording=recording, note=note)

    def _hands(self) -> dict[str, MetricResult]:
        ours, theirs = (
            hand_movement(motions) for motions in (self._all_generated(), self._all_recorded())
        )
        results = {}
        for name, (key, factor) in _HANDS.items():
            value, own = (factor * getattr(side, name) for side in (ours, theirs))
            if np.isfinite(value):
                results[key] = self._result(key, value, own if np.isfinite(own) else None)
            else:
                self.problems.append((key, "the clips are too short, or the hands never move"))
        return results

    def _calm_and_lively(self) -> dict[str, MetricResult]:
        found = calm_and_lively(self._all_recorded(), list(self._generated.values()))
        values = {"calm_lively_r": found.r, "calm_lively_slope": found.slope}
        note = f"{found.n} windows"
        return {key: self._result(key, value, 1.0, note) for key, value in values.items()}

    def _windows(self) -> dict[str, MetricResult]:
        joints = self._upper_joints()
        generated = motion_windows(self._all_generated(), joints)
        recorded = motion_windows(self._all_recorded(), joints)
        comparisons: Mapping[str, Callable[..., float]] = {
            "one_nn": two_sample_accuracy,
            "within_reach": lambda *both, seed: 100.0 * within_reach(*both, seed=seed),
        }
        results = {}
        for key, compare in comparisons.items():
            own, note = None, "no value of the recordings: they are too short"
            try:
                values = [
                    compare(
                        motion_windows(others, joints), motion_windows(held, joints), seed=self.seed
                    )
                    for held, others in self._splits()
                ]
                own, note = float(np.mean(values)), f"recording: {self._compared()}"
            except MotionError:
                pass
            value = compare(generated, recorded, seed=self.seed)
            results[key] = self._result(key, value, own, note)
        return results

    def _copying(self) -> dict[str, MetricResult]:
        joints, recorded = self._upper_joints(), self._all_recorded()
        among = self.training.motions or recorded
        ours = copying(self._all_generated(), recorded, among, joints, seed=self.seed)
        own = [ours]
        if not self.training.motions:
            own = [copying(a, a, b, joints, seed=self.seed) for a, b in self._splits()]
        note = f"recording: {self._compared()}"
        pairs = (
            ("copying", ours.median, [one.held_out_median for one in own]),
            ("copying_low", ours.low, [one.held_out_low for one in own]),
        )
        return {
            key: self._result(key, value, float(np.mean(owns)), note) for key, value, owns in pairs
        }

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
