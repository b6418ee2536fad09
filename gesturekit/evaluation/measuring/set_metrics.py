"""Metrics of a set of clips: speed distributions, global CCA, Fréchet distances, diversity."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from gesturekit.errors import GestureKitError
from gesturekit.evaluation.definitions import (
    DEFINITIONS,
    PATCHES,
    SIMILARITY,
    Definition,
    definitions_of,
)
from gesturekit.evaluation.measuring.clip_metrics import ClipMetrics, compute
from gesturekit.evaluation.measuring.clips import Clip, MotionSample, evenly, load_recording
from gesturekit.evaluation.measuring.pooled import PooledMetrics
from gesturekit.evaluation.metrics import physical, similarity
from gesturekit.evaluation.metrics.distributions import SpeedHistogram, hellinger
from gesturekit.evaluation.metrics.frechet.frechet import FrechetResult
from gesturekit.evaluation.metrics.patches import inter_diversity, patch_features
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
    problems: list[tuple[str, str]] = field(default_factory=list)
    by_clip: list[dict[str, float]] = field(default_factory=list)
    speeds: SpeedHistogram = field(default_factory=SpeedHistogram)
    recorded_speeds: SpeedHistogram = field(default_factory=SpeedHistogram)
    wrists: np.ndarray = field(default_factory=lambda: np.empty(0))
    recorded_wrists: np.ndarray = field(default_factory=lambda: np.empty(0))
    training_excluded: list[Excluded] = field(default_factory=list)


_Speeds = tuple[SpeedHistogram, np.ndarray]
"""Speeds of all joints, and (T - 1,) of the wrists, m/s."""


def set_metrics(
    clips: Iterable[Clip],
    measure: ClipMetrics,
    pooled: PooledMetrics | None,
    frechet: FrechetMetrics | None,
) -> SetMeasurement:
    """Compute the metrics of a set.

    Args:
        clips: the clips of a model, ordered by recording.
        measure: the metrics of single clips.
        pooled, frechet: accumulate the metrics of their groups, if these are taken.
    """
    groups, pairs, speeds = measure.groups, list[Pair](), list[_Speeds]()
    recorded: dict[Window, _Speeds] = {}
    inter: dict[str, tuple[Pair, float]] = {}
    features: list[np.ndarray] = []  # of the samples of one recording
    joints, step, poses = tuple[str, ...](), 1, list[list[np.ndarray]]()  # of the global CCA
    for clip in clips:
        if pairs and pairs[-1].stem != clip.pair.stem:
            features = []
        pairs.append(clip.pair)
        speeds.append(_speeds(clip.generated, clip.joints))
        if clip.pair.of not in recorded:
            recorded[clip.pair.of] = _speeds(clip.recording, clip.joints)
        if pooled is not None:
            pooled.add(clip)
        if frechet is not None:
            frechet.add(clip)
        if SIMILARITY in groups and clip.joints == (joints := joints or clip.joints):
            both = similarity.pose_pair(clip.generated, clip.recording, clip.joints)
            poses.append([side[::step].copy() for side in both])  # a view would keep the rest
            while sum(len(ours) for ours, _ in poses) > _CCA_FRAMES:
                step, poses = 2 * step, [[side[::2].copy() for side in sides] for sides in poses]
        if PATCHES in groups and len(features) < INTER_SAMPLES:
            with suppress(GestureKitError):  # local diversity reports the reason
                variant = measure.variants.patches
                features.append(patch_features(clip.generated, variant, joints=clip.joints))
                if len(features) > 1:
                    inter[clip.pair.stem] = clip.pair, inter_diversity(features)
    found = _speeds_of_set(speeds, list(recorded.values()))
    for key, kept, metric in (
        ("hellinger", pairs, lambda: _hellinger(pairs, [own for own, _ in speeds], recorded)),
        ("cca_global", poses, lambda: _global_cca(poses)),
        ("inter_diversity", inter, lambda: _inter_diversity(list(inter.values()))),
    ):
        try:
            found.metrics |= {key: metric()} if kept else {}
        except GestureKitError as error:
            found.problems.append((key, str(error)))
    if pooled is not None and pairs:
        found.metrics |= pooled.results()
        found.problems, found.by_clip = found.problems + pooled.problems, pooled.by_clip
        found.training_excluded = pooled.training.excluded
    if frechet is not None and pairs:
        found.metrics |= frechet.results()
        found.problems = frechet.problems + found.problems
    return found


def _speeds(motion: Motion, joints: Sequence[str]) -> _Speeds:
    try:
        wrists = physical.wrist_speed(motion)
    except GestureKitError:
        wrists = np.empty(0)
    return SpeedHistogram.of([physical.relative_speed(motion, joints)]), wrists


def _speeds_of_set(generated: Sequence[_Speeds], recorded: Sequence[_Speeds]) -> SetMeasurement:
    """Return the speeds of all clips and recordings; of wrists every k-th, if there are many."""
    wrists = [np.concatenate([np.empty(0), *(w for _, w in s)]) for s in (generated, recorded)]
    return SetMeasurement(
        speeds=SpeedHistogram.sum_of(joints for joints, _ in generated),
        recorded_speeds=SpeedHistogram.sum_of(joints for joints, _ in recorded),
        wrists=evenly(wrists[0], _WRISTS),
        recorded_wrists=evenly(wrists[1], _WRISTS),
    )


def _hellinger(
    pairs: Sequence[Pair],
    speeds: Sequence[SpeedHistogram],
    recorded: Mapping[Window, _Speeds],
) -> MetricResult:
    def distance(drawn: np.ndarray) -> float:
        ours = SpeedHistogram.sum_of(speeds[i] for i in drawn)
        return hellinger(ours, SpeedHistogram.sum_of(recorded[pairs[i].of][0] for i in drawn))

    interval = interval_of_statistic(distance, Takes.of(pairs), DEFINITIONS["hellinger"].within)
    whole = SpeedHistogram.sum_of(speeds)
    beyond = 100.0 * whole.beyond / max(int(whole.counts.sum()) + whole.beyond, 1)
    return MetricResult("hellinger", interval, note=f"{beyond:.1f} % beyond the last bin")


def _global_cca(poses: Sequence[Sequence[np.ndarray]]) -> MetricResult:
    r = similarity.cca(*map(np.concatenate, zip(*poses, strict=True)))
    return MetricResult("cca_global", whole_set(r, len(poses)))


def _inter_diversity(of_recordings: Sequence[tuple[Pair, float]]) -> MetricResult:
    pairs, values = zip(*of_recordings, strict=True)
    interval = interval_of(values, Takes.of(pairs), DEFINITIONS["inter_diversity"].within)
    return MetricResult("inter_diversity", interval)


class FrechetMetrics:
    """Accumulates clips and computes their Fréchet distances to all recordings, and diversity.

    Windows and kinetic features use the body joints that all clips share with the recordings;
    geometric features and those of `model` need their own joints. Where clips are not of all
    recordings, or of windows of them, the distance of these to the full set is the lower bound.

    Args:
        sources: all recordings by key.
        fps: frame rate of the evaluation.
        model: the feature extractor of `gesturekit fit-features`; without it, no FGD.
        kinetic: variant of the kinetic features.
        seed: of intervals and subsamples.

    Attributes:
        problems: (key, reason) of metrics that could not be computed.
    """

    def __init__(
        self,
        sources: Mapping[str, Path | ItemInterval],
        fps: float,
        model: Extractor | None,
        kinetic: str,
        seed: int,
    ) -> None:
        self.problems: list[tuple[str, str]] = []
        self._sources, self._fps = sources, fps
        self._generated, self._recorded = MotionSample(seed), MotionSample(seed)
        self._pairs: list[Pair] = []
        self._windows: set[Window] = set()
        windows = model and model.windows
        self._inputs = SimpleNamespace(model=model, windows=windows, kinetic=kinetic, seed=seed)

    def add(self, clip: Clip) -> None:
        """Add a clip and its recording."""
        known = self._inputs.joints if self._pairs else clip.joints
        self._inputs.joints = tuple(name for name in known if name in clip.joints)
        self._pairs.append(clip.pair)
        self._generated.add(clip.generated)
        if clip.pair.of not in self._windows:
            self._windows.add(clip.pair.of)
            self._recorded.add(clip.recording)

    def results(self) -> dict[str, MetricResult]:
        """Compute the metrics; those that fail are listed in `problems`."""
        full, generated, found = self._recorded, self._generated, dict[str, MetricResult]()
        if self._windows != {(key, None) for key in self._sources}:
            full = MotionSample(self._inputs.seed)
            for source in self._sources.values():
                full.add(load_recording(source, self._fps))
        self._inputs.reference = full.motions
        takes = Takes.of([self._pairs[owner] for owner in generated.owners]).count
        apart = takes >= INDEPENDENT * len(generated.owners)
        for definition in definitions_of("distance", "diversity"):
            key, is_distance = definition.key, definition.of == "distance"
            try:
                ours = self._computed(definition, generated)
                if ours is None:  # it needs a feature extractor
                    continue
                own = None
                if full is not self._recorded or not is_distance:
                    own = self._computed(definition, self._recorded)
                if is_distance:
                    found[key] = _distance(key, ours, own, apart)
                else:
                    found[key] = MetricResult(key, whole_set(ours, generated.count), own)
            except GestureKitError as error:
                self.problems.append((key, str(error)))
        return found

    def _computed(self, definition: Definition, sample: MotionSample) -> Any | None:
        motions = SimpleNamespace(generated=sample.motions, motions=sample.motions)
        return compute(definition, motions, self._inputs)


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
