"""Metrics of one clip: of its motion alone, and compared with its recording and its sound."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from audio_features import AudioFeaturesError
from gesturekit.errors import EvaluationError, GestureKitError
from gesturekit.evaluation.definitions import (
    DEFINITIONS,
    LIFE,
    MOVEMENT,
    PATCHES,
    SIMILARITY,
    SPEECH,
    Variants,
)
from gesturekit.evaluation.measuring.clips import (
    Clip,
    Sound,
    load_recording,
    load_sound,
)
from gesturekit.evaluation.metrics import physical, rhythm, similarity
from gesturekit.evaluation.metrics.distributions import SpeedHistogram, hellinger
from gesturekit.evaluation.metrics.hands import hand_figures
from gesturekit.evaluation.metrics.patches import intra_diversity, patch_features, patch_scores
from gesturekit.evaluation.metrics.physical import CUTOFF, JointLimits, joint_limit_share
from gesturekit.evaluation.metrics.sync import SyncResult, sync
from gesturekit.evaluation.pairs import Excluded, Pair, Stretch
from gesturekit.motion import Motion
from gesturekit.motion.body_size import body_scale
from gesturekit.motion.parts import body_joints

PATCH_PAIRS = 250_000_000
"""Largest number of frames of a clip times frames of its recording that is compared: 2 GB."""


@dataclass
class ReferenceStatistics:
    """Statistics of all recordings that clips are compared with.

    Attributes:
        recordings: {key: motion} at the frame rate of the evaluation.
        limits: the range of each joint; None without joints that can have one.
        mean_speed: {joint name: mean speed over the recordings, m/s}.
        excluded: recordings that cannot be read, or have another rig than the first.
    """

    recordings: dict[str, Motion] = field(default_factory=dict)
    limits: JointLimits | None = None
    mean_speed: dict[str, float] = field(default_factory=dict)
    excluded: list[Excluded] = field(default_factory=list)

    @classmethod
    def of(cls, recordings: Mapping[str, Path | Stretch], fps: float) -> ReferenceStatistics:
        """Compute the statistics of recordings; leave out rigs that differ from the first one."""
        statistics = cls()
        joints: tuple[str, ...] = ()
        sums: dict[str, tuple[float, int]] = {}
        for key, path in recordings.items():
            try:
                motion = load_recording(path, fps)
                joints = joints or body_joints(motion.skeleton)
                if not set(joints) <= set(motion.skeleton.names):
                    raise EvaluationError("its rig differs from that of the first recording")
                speed = rhythm.central_speed(motion, joints)
            except GestureKitError as error:
                statistics.excluded.append(Excluded(key, str(error), "the set of recordings"))
                continue
            statistics.recordings[key] = motion
            for name, column in zip(joints, speed.T, strict=True):
                total, count = sums.get(name, (0.0, 0))
                sums[name] = total + float(column.sum()), count + len(column)
        statistics.mean_speed = {name: total / count for name, (total, count) in sums.items()}
        kept = list(statistics.recordings.values())
        roots = _roots(kept)
        turning = [name for name in joints if name not in roots]
        if kept and turning:
            statistics.limits = JointLimits.fit(kept, turning)
        return statistics

    def digest(self) -> str:
        """Return a digest of the statistics, which are a part of every clip's measurement."""
        found = hashlib.sha256(repr(sorted(self.mean_speed.items())).encode())
        if self.limits is not None:
            found.update(repr(self.limits.joints).encode())
            for values in (self.limits.mean, self.limits.low, self.limits.high):
                found.update(np.ascontiguousarray(values))
        return found.hexdigest()


def _roots(motions: Iterable[Motion]) -> set[str]:
    """Return the root and all joints with a translation: they turn with the whole body."""
    roots: set[str] = set()
    for motion in motions:
        roots |= {motion.skeleton.names[0], *motion.joint_translations}
    return roots


Values = dict[str, float]
"""{key of `definitions`: value}"""
Problems = list[tuple[str, str]]
"""(key, reason) of metrics that could not be computed."""


class ClipMetrics:
    """Computes the metrics of clips.

    Args:
        statistics: of the recordings.
        groups: groups of `definitions` to compute.
        variants: variants of the metrics.
    """

    def __init__(
        self, statistics: ReferenceStatistics, groups: Sequence[str], variants: Variants
    ) -> None:
        self.statistics = statistics
        self.groups = groups
        self.variants = variants

    def generated(self, clip: Clip) -> tuple[Values, Problems]:
        """Compute all metrics of the generated motion."""
        out = _Collected()
        self._motion_metrics(out, clip, clip.generated)
        self._comparison(out, clip)
        if SPEECH in self.groups and clip.semantic is not None:
            out("srgr", lambda: self._srgr(clip))
        return out.figures, out.problems

    def against(self, clip: Clip) -> Values:
        """Compute the metrics that compare the motion of a clip with its recording."""
        out = _Collected()
        self._comparison(out, clip)
        return out.figures

    def _comparison(self, out: _Collected, clip: Clip) -> None:
        if MOVEMENT in self.groups:
            out("hellinger", lambda: _speed_distance(clip))
        if SIMILARITY in self.groups:
            out("cca", lambda: similarity.cca(*self.both(clip)))
        if PATCHES in self.groups:
            out("coverage", lambda: self._patches(clip))

    def recording(self, clip: Clip) -> tuple[Values, Problems]:
        """Compute the metrics of the recording itself: the goal, or the upper bound."""
        out = _Collected()
        self._motion_metrics(out, clip, clip.recording)
        return out.figures, out.problems

    def mismatched_sound(self, clip: Clip, sounds: Sequence[Sound]) -> Values:
        """Average the speech metrics of the generated motion over other recordings' sounds."""
        every: dict[str, list[float]] = {}
        beats = self._beats(clip, clip.generated)
        for sound in sounds:
            out = _Collected()
            self._speech(out, clip, beats, sound)
            for key, value in out.figures.items():
                every.setdefault(key, []).append(value)
        return {key: float(np.mean(values)) for key, values in every.items()}

    def mismatched_motion(self, clip: Clip, other: Motion) -> Values:
        """Compute the CCA of the generated motion with another recording's."""
        out = _Collected()
        if SIMILARITY in self.groups and set(clip.joints) <= set(other.skeleton.names):
            n = min(clip.generated.n_frames, other.n_frames)
            ours, theirs = (
                similarity.root_relative(m, clip.joints)[:n].reshape(n, -1)
                for m in (clip.generated, other)
            )
            out("cca", lambda: similarity.cca(ours, theirs))
        return out.figures

    def _motion_metrics(self, out: _Collected, clip: Clip, motion: Motion) -> None:
        if MOVEMENT in self.groups:
            self._movement(out, clip, motion)
        if SPEECH in self.groups and clip.pair.audio is not None:
            try:
                sound = load_sound(clip.pair.audio, clip.pair.window)
            except AudioFeaturesError as error:
                out.problems.append(("speech", str(error)))
            else:
                beats = self._beats(clip, motion)
                self._speech(out, clip, beats, sound)
        if LIFE in self.groups:
            _hands(out, motion)
        if PATCHES in self.groups:
            out("intra_diversity", lambda: self._intra(clip, motion))

    def _movement(self, out: _Collected, clip: Clip, motion: Motion) -> None:
        joints = clip.joints
        heights = functools.cache(
            lambda: physical.standing_heights(clip.recording if clip.same_body else motion)
        )
        out("arm_speed", lambda: physical.arm_speed(motion).mean())
        out("wrist_speed", lambda: physical.wrist_speed(motion).mean())
        out("acceleration", lambda: physical.acceleration(motion, cutoff=CUTOFF, joints=joints))
        out("jerk", lambda: physical.jerk(motion, cutoff=CUTOFF, joints=joints))
        out("acceleration_genea", lambda: physical.acceleration(motion, joints=joints))
        out("jerk_genea", lambda: physical.jerk(motion, joints=joints))
        out("foot_skate", lambda: physical.foot_skate(motion, heights()))
        out("floor_penetration", lambda: 1000.0 * physical.floor_penetration(motion, heights()))
        out("l1_diversity", lambda: similarity.l1_diversity(motion, joints))
        limits = self.statistics.limits
        if limits is not None:
            out("joint_limits", lambda: 100.0 * joint_limit_share(motion, limits))

    def _beats(self, clip: Clip, motion: Motion) -> MotionBeats:
        return MotionBeats(motion, clip, self.statistics.mean_speed, self.variants.bas)

    def _speech(self, out: _Collected, clip: Clip, beats: MotionBeats, sound: Sound) -> None:
        motion = beats.motion
        synced = out("sync", lambda: _sync(motion, clip, sound), lambda result: result.r)
        aligned = out("bas", lambda: beats.alignment(sound), _score)
        if synced is not None and not (synced.note and synced.r):  # else its chance is unknown
            out.figures["in_time"] = synced.r - synced.chance_mean
        elif synced is None and _hardly_moves(motion, clip):
            out.figures["in_time"] = 0.0
        consistent = out("bc", lambda: beats.consistency(sound), _score)
        for key, result in (("sync", synced), ("bas", aligned), ("bc", consistent)):
            if result is None:
                continue
            out.figures[f"{key}_chance"] = result.chance_mean
            out.figures[f"{key}_z"] = result.z
            if result.note:
                out.problems.append((key, result.note))

    def both(self, clip: Clip) -> tuple[np.ndarray, np.ndarray]:
        """Return the poses (T, 3 (J - 1)) of both motions over their common frames."""
        n = clip.n_frames
        both = (clip.generated, clip.recording)
        return tuple(similarity.root_relative(m, clip.joints)[:n].reshape(n, -1) for m in both)

    def _srgr(self, clip: Clip) -> float:
        n, fps = clip.n_frames, clip.generated.fps
        ours, theirs = (side.reshape(n, -1, 3) for side in self.both(clip))
        semantic = clip.semantic.to_rate(fps, n).values[:, 0]
        near = similarity.SRGR_THRESHOLD * body_scale(clip.recording.skeleton)
        return similarity.srgr(ours, theirs, semantic, threshold=near)

    def _features(self, clip: Clip, motion: Motion) -> np.ndarray:
        return patch_features(motion, self.variants.patches, joints=clip.joints)

    def _patches(self, clip: Clip) -> Values:
        _check_size(clip.generated, clip.recording)
        scores = patch_scores(
            self._features(clip, clip.generated),
            self._features(clip, clip.recording),
            30 if self.variants.has_coverage else None,
            threshold=self.variants.threshold,
            variant=self.variants.patches,
        )
        figures = {
            "coverage": 100.0 * scores.coverage,
            "global_diversity": scores.global_diversity,
            "local_diversity": scores.local_diversity,
        }
        return {key: value for key, value in figures.items() if np.isfinite(value)}

    def _intra(self, clip: Clip, motion: Motion) -> float:
        _check_size(motion, motion)
        return intra_diversity(self._features(clip, motion))


def _hands(out: _Collected, motion: Motion) -> None:
    """Add the hand movement of one clip; the pooled metric says what is missing, and why."""
    try:
        found = hand_figures(motion)
    except GestureKitError:
        return
    out.figures |= {key: value for key, value in found.items() if np.isfinite(value)}


def _check_size(one: Motion, other: Motion) -> None:
    if one.n_frames * other.n_frames > PATCH_PAIRS:
        raise EvaluationError(
            f"{one.n_frames} × {other.n_frames} frames are too many to compare patch by patch; "
            "cut the clips"
        )


def _sync(motion: Motion, clip: Clip, sound: Sound) -> SyncResult:
    result = sync(motion, sound.wave)
    if not result.note and _hardly_moves(motion, clip):
        raise EvaluationError(
            f"not informative: the arms move at less than {100 * physical.HARDLY_MOVING:.0f} % of "
            "the recording's speed"
        )
    return result


def _hardly_moves(motion: Motion, clip: Clip) -> bool:
    """True if the arms move far less than the recording's; False without arms."""
    try:
        ours, own = (physical.arm_speed(m).mean() for m in (motion, clip.recording))
    except GestureKitError:
        return False
    return bool(ours < physical.HARDLY_MOVING * own)


def _speed_distance(clip: Clip) -> float:
    return hellinger(
        *(
            SpeedHistogram.of([physical.relative_speed(motion, clip.joints)])
            for motion in (clip.generated, clip.recording)
        )
    )


def _score(result: rhythm.BeatResult) -> float:
    return result.score


@dataclass(frozen=True, eq=False)
class MotionBeats:
    """Beats of a motion, compared with those of sounds.

    Attributes:
        motion: generated or recorded motion of the clip.
        clip: the clip.
        mean_speed: {joint name: mean speed over the recordings, m/s}.
        variant: of the beat alignment.
    """

    motion: Motion
    clip: Clip
    mean_speed: Mapping[str, float]
    variant: Literal["seconds", "bailando"]

    def alignment(self, sound: Sound) -> rhythm.BeatResult:
        """Return the beat alignment with a sound, see `rhythm.beat_alignment`."""
        return rhythm.beat_result([self._whole], sound.pulse, self.motion.duration, rhythm.KERNEL)

    def consistency(self, sound: Sound) -> rhythm.BeatResult:
        """Return the beat consistency with a sound, see `rhythm.beat_consistency`."""
        kernel = rhythm.CONSISTENCY_KERNEL
        return rhythm.beat_result(self._by_joint, sound.onsets, self.motion.duration, kernel)

    @functools.cached_property
    def _whole(self) -> np.ndarray:
        return rhythm.motion_beats(self.motion, variant=self.variant, joints=self.clip.joints)

    @functools.cached_property
    def _by_joint(self) -> list[np.ndarray]:
        upper = set(rhythm.upper_body_joints(self.clip.recording))
        joints = [name for name in self.clip.joints if name in upper]
        usual = None
        if set(joints) <= set(self.mean_speed):
            usual = np.array([self.mean_speed[name] for name in joints])
        return rhythm.joint_beats(self.motion, mean_speed=usual, joints=joints)


class _Collected:
    """Metrics computed so far, and the reasons for those that failed."""

    def __init__(self) -> None:
        self.figures: Values = {}
        self.problems: Problems = []

    def __call__(
        self,
        key: str,
        compute: Callable[[], object],
        value: Callable[[object], float] | None = None,
    ) -> object | None:
        """Compute a metric, or a dictionary of metrics; turn an error into a problem."""
        try:
            result = compute()
        except (GestureKitError, AudioFeaturesError) as error:
            self.problems.append((key, str(error)))
            return None
        found = result if isinstance(result, dict) else {key: value(result) if value else result}
        for name, number in found.items():
            if not np.isfinite(number):
                self.problems.append((name, "came out as no number"))
                continue
            self.figures[name] = float(number)
        return result


_NAMELESS = Pair("clip", "clip", None, Path("clip"), Path("clip"))


def quick_metrics(generated: Sequence[Motion], recordings: Sequence[Motion]) -> dict[str, float]:
    """Return means over clips of the cheap metrics (`cheap` in `definitions`).

    A metric whose goal is the recording's value is given as its ratio to that value, `KEY_ratio`;
    1 equals the recording. A metric that fails for all clips is left out.

    Args:
        generated: motions of one rig.
        recordings: the same number of motions, of the same rig and frame rate.
    """
    measure = ClipMetrics(ReferenceStatistics(), (MOVEMENT,), Variants())
    every: dict[str, list[float]] = {}
    for motion, recording in zip(generated, recordings, strict=True):
        clip = Clip(_NAMELESS, motion, recording, body_joints(recording.skeleton), None, ())
        own = measure.recording(clip)[0]
        for key, value in measure.generated(clip)[0].items():
            if not DEFINITIONS[key].cheap:
                continue
            if DEFINITIONS[key].better != "reference":
                every.setdefault(key, []).append(value)
            elif own.get(key):
                every.setdefault(f"{key}_ratio", []).append(value / own[key])
    return {key: float(np.mean(values)) for key, values in every.items()}
