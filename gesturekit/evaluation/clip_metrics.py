"""The figures of one clip: its own, those beside its recording, and those beside its sound."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from audio_features import AudioFeaturesError, Wave
from gesturekit.errors import EvaluationError, GestureKitError
from gesturekit.evaluation.clips import Clip, load_recording, load_wave
from gesturekit.evaluation.definitions import (
    MOVEMENT,
    PATCHES,
    SIMILARITY,
    SPEECH,
    PatchOptions,
)
from gesturekit.evaluation.metrics import feet, physical, rhythm, similarity
from gesturekit.evaluation.metrics.derivatives import CUTOFF
from gesturekit.evaluation.metrics.distributions import SpeedHistogram, hellinger
from gesturekit.evaluation.metrics.joint_limits import JointLimits, joint_limit_share
from gesturekit.evaluation.metrics.patches import intra_diversity, patch_features, patch_scores
from gesturekit.evaluation.metrics.sync import SyncResult, sync
from gesturekit.evaluation.pairs import WINDOW_SECONDS, Excluded, Stretch
from gesturekit.motion import Motion
from gesturekit.motion.body_size import body_scale
from gesturekit.motion.parts import body_joints

PATCH_PAIRS = 250_000_000
"""Frames of a clip times frames of its recording that a report compares at most: 2 GB a table."""


@dataclass(frozen=True)
class Sound:
    """A recording's sound, with the beats that were found in it."""

    wave: Wave
    onsets: np.ndarray
    pulse: np.ndarray

    @classmethod
    def load(cls, path: Path | Stretch, window: int | None) -> Sound:
        """Read a sound, or one 10 s window of it.

        Raises:
            AudioError: it cannot be read.
        """
        wave = load_wave(path)
        if window is not None:
            wave = wave.slice(window * WINDOW_SECONDS, WINDOW_SECONDS)
        return cls(wave, rhythm.speech_onsets(wave), rhythm.music_beats(wave))


load_sound = functools.lru_cache(maxsize=16)(Sound.load)


@dataclass
class Known:
    """What is learned from all recordings before clips are measured.

    Attributes:
        recordings: key to motion, at the frame rate of the evaluation.
        limits: the range of each joint; None where there is no joint that could have one.
        mean_speed: joint name to m/s, the mean over the recordings.
        excluded: recordings that cannot be read, or are of another rig than the first.
    """

    recordings: dict[str, Motion] = field(default_factory=dict)
    limits: JointLimits | None = None
    mean_speed: dict[str, float] = field(default_factory=dict)
    excluded: list[Excluded] = field(default_factory=list)

    @classmethod
    def of(cls, recordings: Mapping[str, Path | Stretch], fps: float) -> Known:
        """Read all recordings; nothing is learned from those of another rig than the first."""
        known = cls()
        joints: tuple[str, ...] = ()
        sums: dict[str, tuple[float, int]] = {}
        for key, path in recordings.items():
            try:
                motion = load_recording(path, fps)
                joints = joints or body_joints(motion.skeleton)
                if not set(joints) <= set(motion.skeleton.names):
                    raise EvaluationError("another rig than the first recording's")
                speed = rhythm.central_speed(motion, joints)
            except GestureKitError as error:
                known.excluded.append(Excluded(key, str(error), "the set of recordings"))
                continue
            known.recordings[key] = motion
            for name, column in zip(joints, speed.T, strict=True):
                total, count = sums.get(name, (0.0, 0))
                sums[name] = total + float(column.sum()), count + len(column)
        known.mean_speed = {name: total / count for name, (total, count) in sums.items()}
        kept = list(known.recordings.values())
        roots = _roots(kept)
        turning = [name for name in joints if name not in roots]
        if kept and turning:
            known.limits = JointLimits.fit(kept, turning)
        return known


def _roots(motions: Iterable[Motion]) -> set[str]:
    """The root, and joints that are moved: they turn with the whole body."""
    roots: set[str] = set()
    for motion in motions:
        roots |= {motion.skeleton.names[0], *motion.joint_translations}
    return roots


Figures = dict[str, float]
Problems = list[tuple[str, str]]


class Measurer:
    """Takes the figures of clips.

    Args:
        known: from the recordings.
        groups: of `definitions`, which to take.
        patches: how patches are compared.
    """

    def __init__(self, known: Known, groups: Sequence[str], patches: PatchOptions) -> None:
        self.known = known
        self.groups = groups
        self.patches = patches

    def figures(self, clip: Clip) -> tuple[Figures, Problems]:
        """Every figure of the generated motion; those that cannot be had, with the reason."""
        taken = _Taken()
        self._own(taken, clip, clip.generated)
        if MOVEMENT in self.groups:
            taken("hellinger", lambda: _speed_distance(clip))
        if SIMILARITY in self.groups:
            taken("cca", lambda: similarity.cca(*self.both(clip)))
        if SPEECH in self.groups and clip.semantic is not None:
            taken("srgr", lambda: self._srgr(clip))
        if PATCHES in self.groups:
            taken("coverage", lambda: self._patches(clip))
        return taken.figures, taken.problems

    def recording(self, clip: Clip) -> tuple[Figures, Problems]:
        """The figures that the recording reaches itself: the goal, or the ceiling."""
        taken = _Taken()
        self._own(taken, clip, clip.recording)
        return taken.figures, taken.problems

    def mismatched(self, clip: Clip, sounds: Sequence[Sound]) -> Figures:
        """Mean figures of the generated motion beside the sounds of other recordings."""
        every: dict[str, list[float]] = {}
        for sound in sounds:
            taken = _Taken()
            self._heard(taken, clip, clip.generated, sound)
            for key, value in taken.figures.items():
                every.setdefault(key, []).append(value)
        return {key: float(np.mean(values)) for key, values in every.items()}

    def unlike(self, clip: Clip, other: Motion) -> Figures:
        """CCA of the generated motion with another recording's."""
        taken = _Taken()
        if SIMILARITY in self.groups and set(clip.joints) <= set(other.skeleton.names):
            n = min(clip.generated.n_frames, other.n_frames)
            ours, theirs = (
                similarity.root_relative(m, clip.joints)[:n].reshape(n, -1)
                for m in (clip.generated, other)
            )
            taken("cca", lambda: similarity.cca(ours, theirs))
        return taken.figures

    def _own(self, taken: _Taken, clip: Clip, motion: Motion) -> None:
        if MOVEMENT in self.groups:
            self._movement(taken, clip, motion)
        if SPEECH in self.groups and clip.pair.audio is not None:
            try:
                sound = load_sound(clip.pair.audio, clip.pair.window)
            except AudioFeaturesError as error:
                taken.problems.append(("speech", str(error)))
            else:
                self._heard(taken, clip, motion, sound)
        if PATCHES in self.groups:
            taken("intra_diversity", lambda: self._intra(clip, motion))

    def _movement(self, taken: _Taken, clip: Clip, motion: Motion) -> None:
        joints = clip.joints
        heights = functools.cache(
            lambda: feet.standing_heights(clip.recording if clip.same_body else motion)
        )
        taken("arm_speed", lambda: physical.arm_speed(motion).mean())
        taken("wrist_speed", lambda: physical.wrist_speed(motion).mean())
        taken("acceleration", lambda: physical.acceleration(motion, cutoff=CUTOFF, joints=joints))
        taken("jerk", lambda: physical.jerk(motion, cutoff=CUTOFF, joints=joints))
        taken("acceleration_genea", lambda: physical.acceleration(motion, joints=joints))
        taken("jerk_genea", lambda: physical.jerk(motion, joints=joints))
        taken("foot_skate", lambda: feet.foot_skate(motion, heights()))
        taken("floor_penetration", lambda: 1000.0 * feet.floor_penetration(motion, heights()))
        taken("l1_diversity", lambda: similarity.l1_diversity(motion, joints))
        limits = self.known.limits
        if limits is not None:
            taken("joint_limits", lambda: 100.0 * joint_limit_share(motion, limits))

    def _heard(self, taken: _Taken, clip: Clip, motion: Motion, sound: Sound) -> None:
        heard = taken("sync", lambda: _sync(motion, clip, sound), lambda result: result.r)
        aligned = taken(
            "bas",
            lambda: rhythm.beat_alignment(motion, sound.pulse, joints=clip.joints),
            _score,
        )
        consistent = taken("bc", lambda: self._consistency(clip, motion, sound), _score)
        for key, result in (("sync", heard), ("bas", aligned), ("bc", consistent)):
            if result is None:
                continue
            taken.figures[f"{key}_chance"] = result.chance_mean
            taken.figures[f"{key}_z"] = result.z
            if result.note:
                taken.problems.append((key, result.note))

    def _consistency(self, clip: Clip, motion: Motion, sound: Sound) -> rhythm.BeatResult:
        upper = set(rhythm.upper_body_joints(clip.recording))
        joints = [name for name in clip.joints if name in upper]
        speeds = self.known.mean_speed
        usual = [speeds[name] for name in joints] if set(joints) <= set(speeds) else None
        return rhythm.beat_consistency(
            motion,
            sound.onsets,
            joints=joints,
            mean_speed=None if usual is None else np.array(usual),
        )

    def both(self, clip: Clip) -> tuple[np.ndarray, np.ndarray]:
        """Poses of both (T, 3 (J - 1)) over the frames that both have."""
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
        return patch_features(motion, self.patches.variant, joints=clip.joints)

    def _patches(self, clip: Clip) -> Figures:
        _check_size(clip.generated, clip.recording)
        scores = patch_scores(
            self._features(clip, clip.generated),
            self._features(clip, clip.recording),
            30 if self.patches.has_coverage else None,
            threshold=self.patches.threshold,
            variant=self.patches.variant,
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


def _check_size(one: Motion, other: Motion) -> None:
    if one.n_frames * other.n_frames > PATCH_PAIRS:
        raise EvaluationError(
            f"{one.n_frames} × {other.n_frames} frames are too many to compare patch by patch; "
            "cut the clips"
        )


def _sync(motion: Motion, clip: Clip, sound: Sound) -> SyncResult:
    result = sync(motion, sound.wave)
    own = physical.arm_speed(clip.recording).mean()
    if not result.note and physical.arm_speed(motion).mean() < physical.HARDLY_MOVING * own:
        raise EvaluationError(
            f"not informative: the arms move at less than {100 * physical.HARDLY_MOVING:.0f} % of "
            "the recording's speed"
        )
    return result


def _speed_distance(clip: Clip) -> float:
    return hellinger(
        *(
            SpeedHistogram.of([physical.relative_speed(motion, clip.joints)])
            for motion in (clip.generated, clip.recording)
        )
    )


def _score(result: rhythm.BeatResult) -> float:
    return result.score


class _Taken:
    """Figures taken so far, and why others could not be."""

    def __init__(self) -> None:
        self.figures: Figures = {}
        self.problems: Problems = []

    def __call__(
        self,
        key: str,
        take: Callable[[], object],
        value: Callable[[object], float] | None = None,
    ) -> object | None:
        """Take a figure, or a dictionary of figures; an error becomes a problem."""
        try:
            result = take()
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
