"""Metrics of a set of clips: speed distributions, global CCA, Fréchet distances, diversity."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from gesturekit.errors import GestureKitError
from gesturekit.evaluation.definitions import (
    DEFINITIONS,
    FRECHET,
    PATCHES,
    POOLED,
    SIMILARITY,
    Definition,
    definitions_of,
)
from gesturekit.evaluation.measuring.clip_metrics import ClipMetrics
from gesturekit.evaluation.measuring.clips import Clip
from gesturekit.evaluation.measuring.inputs import SetInputs, compute
from gesturekit.evaluation.measuring.pooled import PooledMetrics
from gesturekit.evaluation.measuring.samples import MotionSample
from gesturekit.evaluation.metrics import physical, similarity
from gesturekit.evaluation.metrics.distributions import SpeedHistogram, hellinger
from gesturekit.evaluation.metrics.frechet.frechet import FrechetResult
from gesturekit.evaluation.metrics.patches import inter_diversity, patch_features
from gesturekit.evaluation.pairs import Pair
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


class SetMetrics:
    """Accumulates the clips of one model and computes the metrics of the set.

    Args:
        measure: the metrics of single clips.
        seed: seed of subsamples.
        pooled_metrics: those of all clips pooled.
    """

    def __init__(self, measure: ClipMetrics, seed: int, pooled_metrics: PooledMetrics) -> None:
        self.measure = measure
        self.seed = seed
        self.pooled_metrics = pooled_metrics
        self.sample = MotionSample(seed)
        self.histograms: list[SpeedHistogram] = []
        self.recorded: list[SpeedHistogram] = []
        self.wrists: list[np.ndarray] = []
        self.problems: list[tuple[str, str]] = []
        self._pairs: list[Pair] = []
        self._poses: list[tuple[np.ndarray, np.ndarray]] = []
        self._pose_stride = 1
        self._joints: tuple[str, ...] = ()  # of the global CCA
        self._shared: tuple[str, ...] | None = None  # joints that all clips have
        self._inter: dict[str, tuple[Pair, float]] = {}
        self._samples: list[np.ndarray] = []

    def add(self, clip: Clip, recorded: SpeedHistogram) -> None:
        """Add a clip; clips must be ordered by recording.

        Args:
            clip: a measured clip.
            recorded: speeds of its recording.
        """
        groups = self.measure.groups
        same = bool(self._pairs) and self._pairs[-1].stem == clip.pair.stem
        self._pairs.append(clip.pair)
        self.histograms.append(SpeedHistogram.of([speeds_of(clip.generated, clip.joints)]))
        self.recorded.append(recorded)
        self.wrists.append(wrists_of(clip.generated))
        if POOLED in groups:
            self.pooled_metrics.add(clip)
        if FRECHET in groups:
            self.sample.add(clip.generated)
            known = clip.joints if self._shared is None else self._shared
            self._shared = tuple(name for name in known if name in clip.joints)
        if SIMILARITY in groups:
            self._joints = self._joints or clip.joints
            if clip.joints == self._joints:
                self._add_poses(clip)
        if PATCHES in groups:
            self._samples = self._samples if same else []
            self._compare_samples(clip)

    def pooled(self) -> dict[str, MetricResult]:
        """Compute the metrics of the set, except those of `frechet`."""
        metrics: dict[str, MetricResult] = {}
        self._try(metrics, "hellinger", self._hellinger)
        if self._poses:
            self._try(metrics, "cca_global", self._cca)
        if self._inter:
            pairs, values = zip(*self._inter.values(), strict=True)
            within = DEFINITIONS["inter_diversity"].within
            interval = interval_of(values, Takes.of(pairs), within)
            metrics["inter_diversity"] = MetricResult("inter_diversity", interval)
        if POOLED in self.measure.groups:
            metrics |= self.pooled_metrics.pooled()
            self.problems += self.pooled_metrics.problems
        return metrics

    def frechet(
        self,
        full: MotionSample,
        compared: MotionSample | None,
        model: Extractor | None,
    ) -> dict[str, MetricResult]:
        """Compute Fréchet distances to the full set of recordings, and the diversity of clips.

        Windows and kinetic features use the body joints that all clips share with the recordings;
        geometric features and those of `model` need their own joints.

        Args:
            full: all recordings.
            compared: the recordings (or windows) that the clips were generated for; their own
                distance to the full set is the lower bound. None if they are the full set.
            model: the feature extractor of `gesturekit fit-features`; without it, no FGD.
        """
        metrics: dict[str, MetricResult] = {}
        for definition in definitions_of("distance", "diversity"):
            self._try(
                metrics,
                definition.key,
                partial(self._of_sets, definition, full, compared, model),
            )
        return metrics

    def _of_sets(
        self,
        definition: Definition,
        full: MotionSample,
        compared: MotionSample | None,
        model: Extractor | None,
    ) -> MetricResult | None:
        """Return one metric of `frechet`; None if it needs a feature extractor."""

        def taken(sample: MotionSample) -> Any | None:
            sides, kinetic = (sample.motions, full.motions), self.measure.variants.kinetic
            return compute(definition, SetInputs(*sides, model, self._shared, self.seed, kinetic))

        ours = taken(self.sample)
        if ours is None:
            return None
        if definition.of == "distance":
            top = None if compared is None else taken(compared)
            takes = Takes.of([self._pairs[owner] for owner in self.sample.owners]).count
            apart = takes >= INDEPENDENT * len(self.sample.owners)
            return _frechet(definition.key, ours, top, apart)
        interval = whole_set(ours, self.sample.count)
        return MetricResult(definition.key, interval, taken(full if compared is None else compared))

    def _try(
        self, metrics: dict[str, MetricResult], key: str, make: Callable[[], MetricResult | None]
    ) -> None:
        try:
            made = make()
        except GestureKitError as error:
            self.problems.append((key, str(error)))
        else:
            metrics |= {} if made is None else {key: made}

    def _hellinger(self) -> MetricResult:
        def distance(drawn: np.ndarray) -> float:
            return hellinger(
                *(pooled([own[i] for i in drawn]) for own in (self.histograms, self.recorded))
            )

        interval = interval_of_statistic(
            distance, Takes.of(self._pairs), DEFINITIONS["hellinger"].within
        )
        total = sum(int(h.counts.sum()) + h.beyond for h in self.histograms)
        beyond = 100.0 * sum(h.beyond for h in self.histograms) / max(total, 1)
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


def speeds_of(motion: Motion, joints: Sequence[str]) -> np.ndarray:
    """Return (N,) speeds of all joints in all frames, m/s on the reference body."""
    return physical.relative_speed(motion, joints).ravel()


def wrists_of(motion: Motion) -> np.ndarray:
    """Return (T - 1,) wrist speeds, m/s; empty for a rig without wrists."""
    try:
        return physical.wrist_speed(motion)
    except GestureKitError:
        return np.empty(0)


def thinned(parts: Sequence[np.ndarray], most: int = _WRISTS) -> np.ndarray:
    """Concatenate arrays (N_i,); keep every k-th value if there are more than `most`."""
    whole = np.concatenate(parts) if parts else np.empty(0)
    return whole[:: max(1, -(-len(whole) // most))]


def pooled(histograms: Sequence[SpeedHistogram]) -> SpeedHistogram:
    """Return the sum of histograms."""
    whole = SpeedHistogram()
    for histogram in histograms:
        whole.counts += histogram.counts
        whole.beyond += histogram.beyond
    return whole


def _frechet(key: str, ours: FrechetResult, top: FrechetResult | None, apart: bool) -> MetricResult:
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
