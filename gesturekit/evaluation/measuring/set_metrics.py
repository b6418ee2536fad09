"""Metrics of a set of clips: speeds, global CCA, diversity, all clips pooled, Fréchet distances.

Those of all clips pooled (hands, windows, copying) are each beside the recordings' own value.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from gesturekit.corpus.manifest import Item
from gesturekit.errors import GestureKitError, MotionError
from gesturekit.evaluation.definitions import (
    DEFINITIONS,
    FRECHET,
    PATCHES,
    POOLED,
    SIMILARITY,
    Definition,
    definitions_of,
)
from gesturekit.evaluation.measuring.clip_metrics import ClipMetrics, compute
from gesturekit.evaluation.measuring.clips import (
    TRAINING_SECONDS,
    Clip,
    MotionSample,
    evenly,
    halves,
    load_recording,
    training_motion,
)
from gesturekit.evaluation.metrics import physical, similarity
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
from gesturekit.evaluation.metrics.patches import inter_diversity, patch_features
from gesturekit.evaluation.metrics.physical import SpeedHistogram, hellinger
from gesturekit.evaluation.metrics.two_sample import (
    ARM_KEYS,
    LOW_QUANTILE,
    arm_windows,
    motion_windows,
    nearest_arm,
    nearest_training,
    subsample,
    two_sample_accuracy,
    two_sample_votes,
    within_reach,
)
from gesturekit.evaluation.pairs import Excluded, Pair, Window, grouped
from gesturekit.evaluation.results import Interval, MetricResult
from gesturekit.evaluation.statistics.intervals import (
    Takes,
    groups_of,
    interval_of,
    interval_of_statistic,
    whole_set,
)
from gesturekit.evaluation.statistics.model_metrics import CEILING, level_of
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
ENOUGH_CALM = 16
"""Windows from which the correlation of calm and lively stretches is informative. Where the true
one is 0.8, that of 4 windows is below 0.4 in 14 of 100 cases, that of 16 windows in 2."""
MOST_TAKES = 12
"""Takes of a speaker that are compared with that speaker's other takes, at most."""
_WRISTS = 20_000  # speeds of wrists that are kept, at most
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


@dataclass(frozen=True, eq=False)
class _Moved:
    """A clip of a set, or a recording or window of one, without its motion.

    Attributes:
        pair: the clip; of a recording, its first clip.
        joints: common body joints of the clip and its recording.
        speeds: of these joints.
        wrists: (T - 1,) speeds, m/s; empty without wrists.
        hands: None for a rig without, and where these are not measured.
    """

    pair: Pair
    joints: tuple[str, ...]
    speeds: SpeedHistogram
    wrists: np.ndarray
    hands: Hands | None


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
            arms = arm_windows(motions, side)
            return nearest_arm(arms, self.trained, side), arms.clips
        windows = subsample(motion_windows(motions, self.joints), rng)
        return nearest_training(windows, self.trained, self.joints), windows.clips


@dataclass(eq=False)
class SetMetrics:
    """Accumulates the clips of one model, ordered by recording, and computes metrics of their set.

    Attributes:
        measure: the metrics of single clips, with groups and variants.
        sources: all recordings by key.
        training: items of the training split; without any, takes are compared with each other.
        fps: frame rate of the evaluation.
        features: the feature extractor of `gesturekit fit-features`; without it, no FGD.
        seed: seed of intervals and subsamples.
        known: values of recordings that other models have in common; filled here.
    """

    measure: ClipMetrics
    sources: Mapping[str, Item]
    training: Sequence[Item]
    fps: float
    features: Extractor | None
    seed: int
    known: dict[Hashable, Any]

    def __post_init__(self) -> None:
        seed = self.seed
        pooled = POOLED in self.measure.groups
        self._trained, excluded = training_motion(self.training if pooled else (), seed)
        self._found = SetMeasurement(training_excluded=excluded)
        self._clips: list[_Moved] = []
        self._recordings: dict[Window, _Moved] = {}
        self._poses: list[list[np.ndarray]] = []  # of the global CCA, every k-th; and their joints
        self._step, self._pose_joints = 1, tuple[str, ...]()
        self._inter: dict[str, tuple[Pair, float]] = {}
        self._features: list[np.ndarray] = []  # of the samples of one recording
        self._recorded, self._generated = MotionSample(seed), MotionSample(seed)  # 25 fps
        self._recorded_at_fps, self._generated_at_fps = MotionSample(seed), MotionSample(seed)
        self._without_hands: MotionError | None = None

    def add(self, clip: Clip) -> None:
        """Add a clip and its recording."""
        groups, pair = self.measure.groups, clip.pair
        if pair.of not in self._recordings:
            samples = self._recorded, self._recorded_at_fps
            self._recordings[pair.of] = self._moved(clip, clip.recording, *samples)
        if self._clips and self._clips[-1].pair.stem != pair.stem:
            self._features = []
        samples = self._generated, self._generated_at_fps
        self._clips.append(self._moved(clip, clip.generated, *samples))
        self._found.by_clip.append({})
        if SIMILARITY in groups:
            self._add_poses(clip)
        if PATCHES in groups and len(self._features) < INTER_SAMPLES:
            with suppress(GestureKitError):  # local diversity reports the reason
                variant = self.measure.variants.patches
                self._features.append(patch_features(clip.generated, variant, joints=clip.joints))
                if len(self._features) > 1:
                    self._inter[pair.stem] = pair, inter_diversity(self._features)

    def _moved(
        self, clip: Clip, motion: Motion, sample: MotionSample, sample_at_fps: MotionSample
    ) -> _Moved:
        """Add the motion of a clip, or its recording, to the samples; return the rest of it."""
        hands, wrists = None, np.empty(0)
        with suppress(GestureKitError):  # a rig without wrists
            wrists = physical.wrist_speed(motion)
        if FRECHET in self.measure.groups:
            sample_at_fps.add(motion)
        if POOLED in self.measure.groups:
            sample.add(at_25 := at_rate(motion, FPS))
            try:
                hands = Hands.of(at_25)
            except MotionError as error:
                self._without_hands = self._without_hands or error
        speeds = SpeedHistogram.of([physical.relative_speed(motion, clip.joints)])
        return _Moved(clip.pair, clip.joints, speeds, wrists, hands)

    def _add_poses(self, clip: Clip) -> None:
        """Keep every k-th pose of all clips; k is doubled when there are too many."""
        self._pose_joints = self._pose_joints or clip.joints
        if clip.joints == self._pose_joints:
            both = similarity.pose_pair(clip.generated, clip.recording, clip.joints)
            self._poses.append([side[:: self._step].copy() for side in both])  # a view keeps all
            while sum(len(ours) for ours, _ in self._poses) > _CCA_FRAMES:
                self._step *= 2
                self._poses = [[side[::2].copy() for side in sides] for sides in self._poses]

    def measured(self) -> SetMeasurement:
        """Compute the metrics; those that fail are listed as problems."""
        found, recorded = self._found, self._recordings.values()
        found.speeds = SpeedHistogram.sum_of(clip.speeds for clip in self._clips)
        found.recorded_speeds = SpeedHistogram.sum_of(one.speeds for one in recorded)
        found.wrists = _thinned([clip.wrists for clip in self._clips])
        found.recorded_wrists = _thinned([one.wrists for one in recorded])
        parts: list[tuple[Sequence[str], Callable[[], dict[str, MetricResult]]]] = []
        if self._clips:
            parts += [(["hellinger"], self._hellinger), (["cca_global"], self._global_cca)]
            parts += [(["inter_diversity"], self._inter_diversity)]
        if self._clips and POOLED in self.measure.groups:
            parts += [
                (HAND_KEYS, self._hands),
                (["calm_lively_r", "calm_lively_slope"], self._calm_and_lively),
                (["one_nn", "within_reach"], self._windows),
                (["copying", "copying_low"], partial(self._copying, "")),
                *(([key], partial(self._copying, side)) for side, key in ARM_KEYS.items()),
                (["calibration", "seed_spread", "sharpness"], self._calibration),
            ]
        if self._clips and FRECHET in self.measure.groups:
            definitions = definitions_of("distance", "diversity")
            parts += [([d.key], partial(self._frechet, d)) for d in definitions]
        for names, metrics in parts:
            try:
                found.metrics |= metrics()
            except GestureKitError as error:
                found.problems += [(name, str(error)) for name in names]
        return found

    def _result(
        self, key: str, value: float, own: float | None, note: str = "", informative: bool = True
    ) -> dict[str, MetricResult]:
        interval = whole_set(value, len(self._clips))
        return {key: MetricResult(key, interval, own, note=note, informative=informative)}

    def _hellinger(self) -> dict[str, MetricResult]:
        own = [clip.speeds for clip in self._clips]
        recorded = [self._recordings[clip.pair.of].speeds for clip in self._clips]

        def distance(drawn: np.ndarray) -> float:
            sides = ([side[i] for i in drawn] for side in (own, recorded))
            return hellinger(*map(SpeedHistogram.sum_of, sides))

        within, whole = DEFINITIONS["hellinger"].within, self._found.speeds
        interval = interval_of_statistic(
            distance, Takes.of([clip.pair for clip in self._clips]), within
        )
        beyond = 100.0 * whole.beyond / max(int(whole.counts.sum()) + whole.beyond, 1)
        note = f"{beyond:.1f} % beyond the last bin"
        return {"hellinger": MetricResult("hellinger", interval, note=note)}

    def _global_cca(self) -> dict[str, MetricResult]:
        if not self._poses:
            return {}
        r = similarity.cca(*map(np.concatenate, zip(*self._poses, strict=True)))
        return {"cca_global": MetricResult("cca_global", whole_set(r, len(self._poses)))}

    def _inter_diversity(self) -> dict[str, MetricResult]:
        if not self._inter:
            return {}
        pairs, values = zip(*self._inter.values(), strict=True)
        interval = interval_of(values, Takes.of(pairs), DEFINITIONS["inter_diversity"].within)
        return {"inter_diversity": MetricResult("inter_diversity", interval)}

    @cached_property
    def _recording_of(self) -> list[int]:
        """Number of the recording of each clip."""
        numbers = {window: number for number, window in enumerate(self._recordings)}
        return [numbers[clip.pair.of] for clip in self._clips]

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
            numbered = zip(self._clips, self._recording_of)
            rigs = [clip.joints for clip, n in numbered if names[n] == name]
            upper = upper_joints(own[0][1].skeleton)
            joints = tuple(joint for joint in upper if all(joint in rig for rig in rigs))
            trained = [(m, of) for m, of in self._trained if {*joints} <= {*m.skeleton.names}]
            speaker = every[own[0][0]].pair.speaker
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

    def _with_hands(self) -> tuple[list[Hands], list[list[Hands]]]:
        """Return the hands of all recordings, and those of the clips for each.

        Raises:
            MotionError: a motion has none.
        """
        if self._without_hands is not None:
            raise self._without_hands
        recorded = [one.hands for one in self._recordings.values() if one.hands]
        samples = grouped((clip.pair.of, clip.hands) for clip in self._clips if clip.hands)
        return recorded, list(samples.values())

    def _hands(self) -> dict[str, MetricResult]:
        recorded, samples = self._with_hands()
        ours = hand_values([hands for clips in samples for hands in clips])
        theirs, results = hand_values(recorded), dict[str, MetricResult]()
        # A held-out take may be livelier than all of training; a model can only know the latter.
        motions = [motion for motion, _ in self._trained]
        trained = self._once("hands", lambda: hand_values(motions) if motions else {})
        for key in HAND_KEYS:
            known = np.isfinite(trained.get(key, np.nan))
            note = f"training recordings: {trained[key]:.2f}" if known else ""
            if np.isfinite(ours[key]):
                own = theirs[key] if np.isfinite(theirs[key]) else None
                results |= self._result(key, ours[key], own, note)
            else:
                reason = "the clips are too short, or the hands never move"
                self._found.problems.append((key, reason))
        return results

    def _calm_and_lively(self) -> dict[str, MetricResult]:
        found = calm_and_lively(*self._with_hands())
        own = 1.0, f"{found.n} windows", found.n >= ENOUGH_CALM
        slope = self._result("calm_lively_slope", found.slope, *own)
        return self._result("calm_lively_r", found.r, *own) | slope

    def _calibration(self) -> dict[str, MetricResult]:
        """Return the calibration of a model with enough samples of each clip; {} for others."""
        counts = np.bincount(self._recording_of)
        if counts.min() < LEAST_SEEDS or len(counts) < 2:
            return {}
        recorded, samples = self._with_hands()
        length = round(float(np.median([len(hands.paths) for hands in recorded])))
        speaker = [
            hand_level(motion[start : start + length])
            for motion, _ in self._trained
            for start in range(0, motion.n_frames - length + 1, length)
        ]
        levels = [[hand_level(hands) for hands in clips] for clips in samples]
        found = calibration(levels, [hand_level(hands) for hands in recorded], speaker)
        note = f"{found.clips} clips of {found.seeds} samples"
        return (
            self._result("calibration", found.coverage, NOMINAL, note)
            | self._result("seed_spread", found.spread, None, note)
            | self._result("sharpness", found.sharpness, 1.0, note)
        )

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
                    self._found.by_clip[clip]["one_nn"] = float(share + recorded[number]) / 2
            reached.append((len(theirs), 100.0 * within_reach(ours, theirs, seed=self.seed)))
        right, drawn = np.sum(votes, axis=0)
        windows, reach = np.transpose(reached)
        share = float(np.average(reach, weights=windows))
        accuracy, own_share, note = self._once("windows", self._own_windows)
        one_nn = self._result("one_nn", float(right / drawn), accuracy, note)
        return one_nn | self._result("within_reach", share, own_share, note)

    def _own_windows(self) -> tuple[float | None, float | None, str]:
        """Return 1-NN and share of held-out recordings against others, and a note."""
        found = []
        try:
            for group in self._groups:
                for sides in group.splits():
                    ours, theirs = (motion_windows(side, group.joints) for side in sides)
                    accuracy = two_sample_accuracy(theirs, ours, seed=self.seed)
                    found.append((accuracy, 100.0 * within_reach(theirs, ours, seed=self.seed)))
        except MotionError:
            return None, None, "no value of the recordings: they are too short"
        accuracy, reach = (float(np.mean(values)) for values in zip(*found, strict=True))
        return accuracy, reach, f"recording: {self._compared()}"

    def _copying(self, side: str) -> dict[str, MetricResult]:
        """Return distances to training motion, of an arm or (side "") of all; {} without any."""
        if not self._trained:
            return {}
        key, rng, distances = ARM_KEYS.get(side, "copying"), np.random.default_rng(self.seed), []
        for group in self._groups:
            values, owners = group.distances(group.generated, side, rng)
            distances.append(values)
            clips = group.clips[owners]
            for clip in np.unique(clips):
                self._found.by_clip[clip][key] = float(np.median(values[clips == clip]))
        ours, own = np.concatenate(distances), self._once(key, partial(self._own_distances, side))
        if side:
            median = float(np.median(np.concatenate([values for values, _ in own])))
            return self._result(key, float(np.median(ours)), median)
        quantiles = [np.quantile(values, (0.5, LOW_QUANTILE)) for values, _ in own]
        median, low = np.mean(quantiles, axis=0).tolist()
        takes = [np.median(v[t == take]) for v, t in own for take in np.unique(t)]
        for of_clip in self._found.by_clip:
            if key in of_clip and median > 0.0:
                of_clip["novelty"] = of_clip[key] / median
        # The ceiling of novelty: the medians of takes relative to all.
        ceiling = replace(level_of(CEILING, np.array(takes) / (median or 1.0)), value=1.0)
        note, lowest = f"recording: {self._compared()}", float(np.quantile(ours, LOW_QUANTILE))
        whole = self._result(key, float(np.median(ours)), median, note)
        whole[key] = replace(whole[key], ceiling=ceiling)
        return whole | self._result("copying_low", lowest, low, note)

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
        key = (name, tuple(group.joints for group in self._groups), tuple(self._recordings))
        if key not in self.known:
            self.known[key] = compute()
        return self.known[key]

    def _compared(self) -> str:
        """Return how recordings are compared with recordings, in words."""
        if self._trained:
            total, most = sum(item.duration for item in self.training), TRAINING_SECONDS
            of_it = f" ({most / 60:.0f} of {total / 60:.0f} min of it)" if total > most else ""
            return f"against the training split{of_it}"
        if all(group.training or len(set(group.takes.tolist())) > 1 for group in self._groups):
            return "each take against the speaker's others"
        return "one half against the other"

    @cached_property
    def _frechet_inputs(self) -> SimpleNamespace:
        """Inputs of Fréchet distances and diversity beside the motion of a model.

        Windows and kinetic features use the body joints that all clips share with the recordings;
        geometric features and those of `features` need their own joints. Where clips are not of all
        recordings, or of windows of them, all of these are the reference.
        """
        full = self._recorded_at_fps
        if set(self._recordings) != {(key, None) for key in self.sources}:
            full = MotionSample(self.seed)
            for source in self.sources.values():
                full.add(load_recording(source, self.fps))
        first, *others = self._clips
        joints = tuple(n for n in first.joints if all(n in clip.joints for clip in others))
        return SimpleNamespace(
            reference=full.motions,
            is_full=full is self._recorded_at_fps,
            model=self.features,
            windows=self.features and self.features.windows,
            joints=joints,
            kinetic=self.measure.variants.kinetic,
            seed=self.seed,
        )

    def _frechet(self, definition: Definition) -> dict[str, MetricResult]:
        """Return a Fréchet distance to the full set of recordings, or a diversity.

        A distance has an interval over motions if each has a take of its own. That of the clips'
        own recordings to the full set is the lower bound.
        """
        inputs, key, generated = self._frechet_inputs, definition.key, self._generated_at_fps
        ours = self._computed(definition, generated)
        is_distance = definition.of == "distance"
        if ours is None:  # it needs a feature extractor
            return {}
        own = None
        if not (is_distance and inputs.is_full):
            own = self._computed(definition, self._recorded_at_fps)
        if not is_distance:
            return self._result(key, ours, own)
        takes = Takes.of([self._clips[owner].pair for owner in generated.owners]).count
        known = takes >= INDEPENDENT * len(generated.owners) and not np.isnan(ours.low)
        low, high = (ours.low, ours.high) if known else (None, None)
        n, over = ours.n_generated, f"windows, against {ours.n_reference} of the recordings"
        interval, own = Interval(ours.value, low, high, n, n, over), own and own.value
        enough = n >= ENOUGH_WINDOWS
        return {key: MetricResult(key, interval, own, note=ours.note, informative=enough)}

    def _computed(self, definition: Definition, sample: MotionSample) -> Any | None:
        motions = SimpleNamespace(generated=sample.motions, motions=sample.motions)
        return compute(definition, motions, self._frechet_inputs)


def _thinned(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Concatenate arrays (N_i,); keep every k-th value if there are many."""
    return evenly(np.concatenate([np.empty(0), *parts]), _WRISTS)


def _shares(owners: np.ndarray, right: np.ndarray, drawn: np.ndarray) -> dict[int, float]:
    """Return {number of a clip: fraction of the draws of its windows (N,) that were right}."""
    total, good = (np.bincount(owners, weights=votes) for votes in (drawn, right))
    return {int(n): good[n] / total[n] for n in np.flatnonzero(total)}
