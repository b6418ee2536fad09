"""Metrics of a set of clips: speed distributions, global CCA, Fréchet distances, diversity."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gesturekit.errors import GestureKitError
from gesturekit.evaluation.definitions import (
    DEFINITIONS,
    PATCHES,
    POOLED,
    SIMILARITY,
    definitions_of,
)
from gesturekit.evaluation.measuring.clip_metrics import ClipMetrics, Problems, compute
from gesturekit.evaluation.measuring.clips import Clip, load_recording
from gesturekit.evaluation.measuring.pooled import PooledMetrics
from gesturekit.evaluation.measuring.samples import MotionSample
from gesturekit.evaluation.metrics import physical, similarity
from gesturekit.evaluation.metrics.frechet.frechet import FrechetResult
from gesturekit.evaluation.metrics.patches import inter_diversity, patch_features
from gesturekit.evaluation.metrics.physical import SpeedHistogram, hellinger
from gesturekit.evaluation.pairs import Excluded, ItemInterval, Pair, Window
from gesturekit.evaluation.results import Interval, MetricResult
from gesturekit.evaluation.statistics.intervals import (
    Takes,
    interval_of,
    interval_of_statistic,
    whole_set,
)
from gesturekit.motion import Motion

if TYPE_CHECKING:
    from gesturekit.evaluation.metrics.frechet.feature_model import Extractor
    from gesturekit.evaluation.metrics.frechet.poses import PoseWindows

INTER_SAMPLES = 20
"""Samples of one recording that are compared with each other, at most."""
ENOUGH_WINDOWS = 32
"""Windows, or clips of 10 s, from which a Fréchet distance is informative: from fewer, a covariance
says so little that motion that hardly moves may be nearer to the recordings than others are."""
INDEPENDENT = 0.8
"""Takes for each motion, or piece of one, from which a bootstrap over motions gives an interval."""
_WRISTS = 20_000
_CCA_FRAMES = 50_000  # frames that the global CCA is fitted on, at most


@dataclass
class SetMeasurement:
    """Metrics of the set of clips of one model, or of one part of them.

    Attributes:
        metrics: {key of `definitions`: result}.
        problems: (key, reason) of metrics that could not be computed.
        by_clip: {key: value} of each clip, of metrics that compare windows of all clips.
        speeds, recorded_speeds: of the joints of the clips, and of their recordings.
        wrists, recorded_wrists: (N,) wrist speeds, m/s.
        training_excluded: items of the training split that cannot be read.
    """

    metrics: dict[str, MetricResult] = field(default_factory=dict)
    problems: Problems = field(default_factory=list)
    by_clip: list[dict[str, float]] = field(default_factory=list)
    speeds: SpeedHistogram = field(default_factory=SpeedHistogram)
    recorded_speeds: SpeedHistogram = field(default_factory=SpeedHistogram)
    wrists: np.ndarray = field(default_factory=lambda: np.empty(0))
    recorded_wrists: np.ndarray = field(default_factory=lambda: np.empty(0))
    training_excluded: list[Excluded] = field(default_factory=list)

    def to_json(self) -> dict[str, Any]:
        """Return plain values."""
        return {
            "metrics": {key: asdict(result) for key, result in self.metrics.items()},
            "problems": self.problems,
            "by_clip": self.by_clip,
            "speeds": [speeds.to_json() for speeds in (self.speeds, self.recorded_speeds)],
            "wrists": [speeds.tolist() for speeds in (self.wrists, self.recorded_wrists)],
            "training_excluded": [asdict(item) for item in self.training_excluded],
        }

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> SetMeasurement:
        """Return the measurement that `to_json` described."""
        speeds, recorded_speeds = map(SpeedHistogram.from_json, values["speeds"])
        wrists, recorded_wrists = map(np.array, values["wrists"])
        return cls(
            {key: MetricResult.from_json(result) for key, result in values["metrics"].items()},
            values["problems"],
            values["by_clip"],
            speeds,
            recorded_speeds,
            wrists,
            recorded_wrists,
            [Excluded(**item) for item in values["training_excluded"]],
        )


class SetMetrics:
    """Accumulates the clips of one model and computes the metrics of the set but Fréchet distances.

    Args:
        measure: the metrics of single clips.
        pooled: those of all clips pooled.
    """

    def __init__(self, measure: ClipMetrics, pooled: PooledMetrics) -> None:
        self.measure = measure
        self.pooled = pooled
        self._pairs: list[Pair] = []
        self._speeds: list[SpeedHistogram] = []
        self._wrists: list[np.ndarray] = []
        self._recorded: dict[Window, tuple[SpeedHistogram, np.ndarray]] = {}
        self._poses: list[tuple[np.ndarray, np.ndarray]] = []
        self._pose_stride = 1
        self._joints: tuple[str, ...] = ()  # of the global CCA
        self._inter: dict[str, tuple[Pair, float]] = {}
        self._samples: list[np.ndarray] = []

    def add(self, clip: Clip) -> None:
        """Add a clip; clips must be ordered by recording."""
        groups = self.measure.groups
        same = bool(self._pairs) and self._pairs[-1].stem == clip.pair.stem
        self._pairs.append(clip.pair)
        if clip.pair.of not in self._recorded:
            self._recorded[clip.pair.of] = _speeds(clip.recording, clip.joints)
        speeds, wrists = _speeds(clip.generated, clip.joints)
        self._speeds.append(speeds)
        self._wrists.append(wrists)
        if POOLED in groups:
            self.pooled.add(clip)
        if SIMILARITY in groups:
            self._joints = self._joints or clip.joints
            if clip.joints == self._joints:
                self._add_poses(clip)
        if PATCHES in groups:
            self._samples = self._samples if same else []
            self._compare_samples(clip)

    def measured(self) -> SetMeasurement:
        """Compute the metrics."""
        speeds, wrists = zip(*self._recorded.values(), strict=True) if self._pairs else ((), ())
        found = SetMeasurement(
            speeds=SpeedHistogram.sum_of(self._speeds),
            recorded_speeds=SpeedHistogram.sum_of(speeds),
            wrists=_thinned(self._wrists),
            recorded_wrists=_thinned(wrists),
            training_excluded=self.pooled.training.excluded,
        )
        if not self._pairs:
            return found
        for key, make in (("hellinger", self._hellinger), ("cca_global", self._cca)):
            try:
                if key == "hellinger" or self._poses:
                    found.metrics[key] = make()
            except GestureKitError as error:
                found.problems.append((key, str(error)))
        if self._inter:
            pairs, values = zip(*self._inter.values(), strict=True)
            within = DEFINITIONS["inter_diversity"].within
            interval = interval_of(values, Takes.of(pairs), within)
            found.metrics["inter_diversity"] = MetricResult("inter_diversity", interval)
        if POOLED in self.measure.groups:
            found.metrics |= self.pooled.results()
            found.problems += self.pooled.problems
            found.by_clip = self.pooled.by_clip()
        return found

    def _hellinger(self) -> MetricResult:
        recorded = [self._recorded[pair.of][0] for pair in self._pairs]

        def distance(drawn: np.ndarray) -> float:
            sides = ([side[i] for i in drawn] for side in (self._speeds, recorded))
            return hellinger(*map(SpeedHistogram.sum_of, sides))

        interval = interval_of_statistic(
            distance, Takes.of(self._pairs), DEFINITIONS["hellinger"].within
        )
        total = sum(int(h.counts.sum()) + h.beyond for h in self._speeds)
        beyond = 100.0 * sum(h.beyond for h in self._speeds) / max(total, 1)
        return MetricResult("hellinger", interval, note=f"{beyond:.1f} % beyond the last bin")

    def _cca(self) -> MetricResult:
        ours, theirs = (np.concatenate(side) for side in zip(*self._poses, strict=True))
        r = similarity.cca(ours, theirs)
        return MetricResult("cca_global", whole_set(r, len(self._poses)))

    def _add_poses(self, clip: Clip) -> None:
        """Keep every k-th pose of all clips; k is doubled when there are too many."""
        # Copies: a view would keep the poses that are dropped.
        step = self._pose_stride
        ours, theirs = similarity.pose_pair(clip.generated, clip.recording, clip.joints)
        self._poses.append((ours[::step].copy(), theirs[::step].copy()))
        while sum(len(ours) for ours, _ in self._poses) > _CCA_FRAMES:
            self._pose_stride *= 2
            self._poses = [(one[::2].copy(), other[::2].copy()) for one, other in self._poses]

    def _compare_samples(self, clip: Clip) -> None:
        if len(self._samples) >= INTER_SAMPLES:
            return
        try:
            variant = self.measure.variants.patches
            self._samples.append(patch_features(clip.generated, variant, joints=clip.joints))
            if len(self._samples) > 1:
                self._inter[clip.pair.stem] = clip.pair, inter_diversity(self._samples)
        except GestureKitError:
            return  # local diversity reports the reason


def _speeds(motion: Motion, joints: Sequence[str]) -> tuple[SpeedHistogram, np.ndarray]:
    """Return the speeds of all joints, and (T - 1,) of the wrists, m/s; empty without wrists."""
    try:
        wrists = physical.wrist_speed(motion)
    except GestureKitError:
        wrists = np.empty(0)
    return SpeedHistogram.of([physical.relative_speed(motion, joints)]), wrists


def _thinned(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Concatenate arrays (N_i,); keep every k-th value if there are more than `_WRISTS`."""
    whole = np.concatenate(parts) if parts else np.empty(0)
    return whole[:: max(1, -(-len(whole) // _WRISTS))]


@dataclass(frozen=True, eq=False)
class SetInputs:
    """Inputs of the metrics of a set of motions.

    Attributes:
        reference: all recordings.
        model: the feature extractor of FGD, or None.
        joints: names of the joints that all of them have.
        seed: of intervals.
        kinetic: variant of the kinetic features.
        generated: all motion of a model.
    """

    reference: Sequence[Motion]
    model: Extractor | None
    joints: tuple[str, ...]
    seed: int
    kinetic: str
    generated: Sequence[Motion]

    @property
    def motions(self) -> Sequence[Motion]:
        """The motion whose diversity is measured: `generated`."""
        return self.generated

    @property
    def windows(self) -> PoseWindows | None:
        """The windows of the feature extractor, or None."""
        return None if self.model is None else self.model.windows


def frechet_metrics(
    clips: Iterable[Clip],
    sources: Mapping[str, Path | ItemInterval],
    model: Extractor | None,
    *,
    fps: float,
    kinetic: str,
    seed: int,
) -> SetMeasurement:
    """Compute Fréchet distances of clips to the full set of recordings, and their diversity.

    Windows and kinetic features use the body joints that all clips share with the recordings;
    geometric features and those of `model` need their own joints. Where clips are not of all
    recordings, or of windows of them, the distance of these to the full set is the lower bound.

    Args:
        clips: the clips of a model.
        sources: all recordings by key.
        model: the feature extractor of `gesturekit fit-features`; without it, no FGD.
        fps: frame rate of the evaluation.
        kinetic: variant of the kinetic features.
        seed: of intervals and subsamples.
    """
    generated, recorded = MotionSample(seed), MotionSample(seed)
    windows, pairs, joints = set[Window](), list[Pair](), None
    for clip in clips:
        pairs.append(clip.pair)
        generated.add(clip.generated)
        known = clip.joints if joints is None else joints
        joints = tuple(name for name in known if name in clip.joints)
        if clip.pair.of not in windows:
            windows.add(clip.pair.of)
            recorded.add(clip.recording)
    found = SetMeasurement()
    if joints is None:
        return found
    full = recorded
    if windows != {(key, None) for key in sources}:
        full = MotionSample(seed)
        for source in sources.values():
            full.add(load_recording(source, fps))
    inputs = partial(SetInputs, full.motions, model, joints, seed, kinetic)
    takes = Takes.of([pairs[owner] for owner in generated.owners]).count
    apart = takes >= INDEPENDENT * len(generated.owners)
    for definition in definitions_of("distance", "diversity"):
        try:
            ours = compute(definition, inputs(generated.motions))
            if ours is None:  # it needs a feature extractor
                continue
            if definition.of == "distance":
                top = None if full is recorded else compute(definition, inputs(recorded.motions))
                result = _distance(definition.key, ours, top, apart)
            else:
                own = compute(definition, inputs(recorded.motions))
                result = MetricResult(definition.key, whole_set(ours, generated.count), own)
            found.metrics[definition.key] = result
        except GestureKitError as error:
            found.problems.append((definition.key, str(error)))
    return found


def _distance(
    key: str, ours: FrechetResult, top: FrechetResult | None, apart: bool
) -> MetricResult:
    """Return a Fréchet distance, with its interval over motions if each has a take of its own."""
    known = apart and not np.isnan(ours.low)
    interval = Interval(
        ours.value,
        ours.low if known else None,
        ours.high if known else None,
        ours.n_generated,
        ours.n_generated,
        f"windows, against {ours.n_reference} of the recordings",
    )
    enough = ours.n_generated >= ENOUGH_WINDOWS
    recording = None if top is None else top.value
    return MetricResult(key, interval, recording, note=ours.note, informative=enough)
