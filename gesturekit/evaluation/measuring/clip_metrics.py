"""Metrics of one clip: of its motion alone, and compared with its recording and its sound.

A metric is a function in `metrics` whose parameters are inputs by name.
"""

from __future__ import annotations

import functools
import hashlib
import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from audio_features import AudioFeaturesError
from gesturekit.errors import EvaluationError, GestureKitError
from gesturekit.evaluation.definitions import (
    DEFINITIONS,
    GROUPS,
    MOVEMENT,
    POOLED,
    SPEECH,
    Definition,
    Variants,
    definitions_of,
)
from gesturekit.evaluation.measuring.clips import (
    Clip,
    RecordedSound,
    load_recording,
    load_sound,
)
from gesturekit.evaluation.metrics import rhythm
from gesturekit.evaluation.metrics.hands import upper_joints
from gesturekit.evaluation.metrics.mouth import mouth_opening
from gesturekit.evaluation.metrics.physical import JointLimits, LimitsFit, standing_heights
from gesturekit.evaluation.metrics.sync import hardly_moves
from gesturekit.evaluation.pairs import Excluded, ItemInterval, Pair
from gesturekit.motion import Motion
from gesturekit.motion.contacts import foot_points
from gesturekit.motion.parts import body_joints

Values = dict[str, float]
"""{key of `definitions`: value}"""
Problems = list[tuple[str, str]]
"""(key, reason) of metrics that could not be computed."""


@dataclass
class ReferenceStatistics:
    """Statistics of all recordings that clips are compared with.

    Attributes:
        recordings: keys of the recordings that can be read.
        limits: the range of each joint; None without joints that can have one.
        mean_speed: {joint name: mean speed over the recordings, m/s}.
        excluded: recordings that cannot be read, or have another rig than the first.
    """

    recordings: list[str] = field(default_factory=list)
    limits: JointLimits | None = None
    mean_speed: dict[str, float] = field(default_factory=dict)
    excluded: list[Excluded] = field(default_factory=list)

    @classmethod
    def of(cls, recordings: Mapping[str, Path | ItemInterval], fps: float) -> ReferenceStatistics:
        """Compute the statistics of recordings; leave out rigs that differ from the first one."""
        statistics = cls()
        joints: tuple[str, ...] = ()
        sums: dict[str, tuple[float, int]] = {}
        roots: set[str] = set()  # they turn with the whole body
        limits = LimitsFit()
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
            statistics.recordings.append(key)
            roots |= {motion.skeleton.names[0], *motion.joint_translations}
            limits.add(motion, joints)
            for name, column in zip(joints, speed.T, strict=True):
                total, count = sums.get(name, (0.0, 0))
                sums[name] = total + float(column.sum()), count + len(column)
        statistics.mean_speed = {name: total / count for name, (total, count) in sums.items()}
        turning = [name for name in joints if name not in roots]
        if statistics.recordings and turning:
            statistics.limits = limits.result().of_joints(turning)
        return statistics

    def digest(self) -> str:
        """Return a digest of the statistics, which are a part of every clip's measurement."""
        found = hashlib.sha256(repr(sorted(self.mean_speed.items())).encode())
        if self.limits is not None:
            found.update(repr(self.limits.joints).encode())
            for values in (self.limits.mean, self.limits.low, self.limits.high):
                found.update(np.ascontiguousarray(values).data)
        return found.hexdigest()


@dataclass(eq=False)
class ClipInputs:
    """Inputs of the metrics of one motion of a clip, computed when a metric names them.

    Fields of the clip, the statistics and the variants are inputs as well.

    Attributes:
        motion: the motion that is measured: that of the clip, or its recording.
        clip: the clip.
        statistics: of all recordings.
        variants: variants of the metrics.
    """

    motion: Motion
    clip: Clip
    statistics: ReferenceStatistics
    variants: Variants

    @property
    def duration(self) -> float:
        """Length of the motion, seconds."""
        return self.motion.duration

    @property
    def fps(self) -> float:
        """Frames per second of the motion and the recording."""
        return self.motion.fps

    @property
    def mouth(self) -> np.ndarray | None:
        """Opening of the mouth (T,), or None."""
        return mouth_opening(self.motion)

    @property
    def recorded_mouth(self) -> np.ndarray | None:
        """Recorded opening of the mouth (T,), or None."""
        return mouth_opening(self.clip.recording)

    @property
    def sources(self) -> tuple[object, ...]:
        """Objects whose attributes are the inputs, the first that has one of a name."""
        return self, self.clip, self.statistics, self.variants

    @functools.cached_property
    def heights(self) -> np.ndarray:
        """Standing heights (F,) of the foot points, metres: the recording's, of the same body.

        A rig without the ends of the recording's feet has fewer points: it takes its own heights.
        """
        rigs = (self.motion.skeleton, self.clip.recording.skeleton)
        alike = self.clip.same_body and len({len(foot_points(rig)) for rig in rigs}) == 1
        return standing_heights(self.clip.recording if alike else self.motion)

    @property
    def frame_rate(self) -> float | None:
        """Frames per second, for the variant of beat alignment that counts frames."""
        return self.motion.fps if self.variants.bas == "bailando" else None

    @functools.cached_property
    def beats(self) -> np.ndarray:
        """Beats (M,) of the motion, seconds."""
        return rhythm.motion_beats(self.motion, variant=self.variants.bas, joints=self.clip.joints)

    @functools.cached_property
    def beats_by_joint(self) -> list[np.ndarray]:
        """Beats (M,) of each joint of the upper body, seconds."""
        upper = upper_joints(self.clip.recording.skeleton)
        joints = [name for name in self.clip.joints if name in upper]
        mean_speed, usual = self.statistics.mean_speed, None
        if set(joints) <= set(mean_speed):
            usual = np.array([mean_speed[name] for name in joints])
        return rhythm.joint_beats(self.motion, mean_speed=usual, joints=joints)


def compute(definition: Definition, *sources: object) -> Any | None:
    """Return the result of a metric's function; None if an input that it needs is missing.

    Args:
        definition: of a metric with a function.
        sources: objects whose attributes are the inputs.

    Raises:
        GestureKitError, AudioFeaturesError: the metric cannot be computed.
    """
    function = definition.load_function()
    parameters = inspect.signature(function).parameters
    arguments = dict(definition.arguments)
    for name, parameter in parameters.items():
        source = next((s for s in sources if name in vars(s) or hasattr(type(s), name)), None)
        needed = parameter.default is parameter.empty
        if name in arguments or (source is None and not needed):
            continue
        arguments[name] = getattr(source, name)
        if arguments[name] is None and needed:
            return None
    return function(**arguments)


@dataclass(frozen=True)
class ClipMetrics:
    """Computes the metrics of clips.

    Attributes:
        statistics: of the recordings.
        groups: groups of `definitions` to compute.
        variants: variants of the metrics.
        cheap: compute the cheap ones alone.
    """

    statistics: ReferenceStatistics
    groups: Sequence[str]
    variants: Variants
    cheap: bool = False

    def generated(self, clip: Clip) -> tuple[Values, Problems]:
        """Compute all metrics of the generated motion."""
        out = _Collected()
        inputs = self._inputs(clip, clip.generated)
        self._own(out, inputs)
        self._comparison(out, inputs)
        return out.values, out.problems

    def against(self, clip: Clip) -> Values:
        """Compute the metrics that compare the motion of a clip with its recording."""
        out = _Collected()
        self._comparison(out, self._inputs(clip, clip.generated))
        return out.values

    def recording(self, clip: Clip) -> tuple[Values, Problems]:
        """Compute the metrics of the recording itself: the goal, or the upper bound."""
        out = _Collected()
        self._own(out, self._inputs(clip, clip.recording))
        return out.values, out.problems

    def mismatched_sound(self, clip: Clip, sounds: Sequence[RecordedSound]) -> Values:
        """Average the speech metrics of the generated motion over other recordings' sounds."""
        every: dict[str, list[float]] = {}
        inputs = self._inputs(clip, clip.generated)
        for sound in sounds:
            out = _Collected()
            self._speech(out, inputs, sound)
            for key, value in out.values.items():
                every.setdefault(key, []).append(value)
        return {key: float(np.mean(values)) for key, values in every.items()}

    def mismatched_motion(self, clip: Clip, other: Motion) -> Values:
        """Compute the metrics that are also taken with another recording (CCA)."""
        out = _Collected()
        if set(clip.joints) <= set(other.skeleton.names):
            inputs = self._inputs(replace(clip, recording=other), clip.generated)
            for definition in self._chosen("comparison"):
                if definition.mismatched:
                    out(definition, inputs)
        return out.values

    def _inputs(self, clip: Clip, motion: Motion) -> ClipInputs:
        return ClipInputs(motion, clip, self.statistics, self.variants)

    def _chosen(self, of: str) -> list[Definition]:
        """Return the metrics of the groups, one for each function and its arguments."""
        chosen: dict[tuple[str, str], Definition] = {}
        for d in definitions_of(of):
            if d.taken_with in self.groups and (d.cheap or not self.cheap):
                chosen.setdefault((d.function, repr(d.arguments)), d)
        return list(chosen.values())

    def _own(self, out: _Collected, inputs: ClipInputs) -> None:
        """Compute the metrics of one motion, and of it with its sound."""
        for group in (MOVEMENT, *(group for group in GROUPS if group != MOVEMENT)):
            for definition in self._chosen("motion"):
                if definition.taken_with == group:
                    out(definition, inputs)
            if group == SPEECH and SPEECH in self.groups and inputs.clip.pair.audio is not None:
                try:
                    sound = load_sound(inputs.clip.pair.audio, inputs.clip.pair.window)
                except AudioFeaturesError as error:
                    out.problems.append(("speech", str(error)))
                else:
                    self._speech(out, inputs, sound)

    def _comparison(self, out: _Collected, inputs: ClipInputs) -> None:
        # The metric of speech, SRGR, is last: few recordings have its track.
        for definition in sorted(self._chosen("comparison"), key=lambda d: d.group == SPEECH):
            out(definition, inputs)

    def _speech(self, out: _Collected, inputs: ClipInputs, sound: RecordedSound) -> None:
        results = {d.key: out(d, inputs, sound) for d in self._chosen("sound")}
        synced = results.get("sync")
        if synced is not None and not (synced.note and synced.r):  # else its chance is unknown
            out.values["in_time"] = synced.r - synced.chance_mean
        elif synced is None and hardly_moves(inputs.motion, inputs.clip.recording):
            out.values["in_time"] = 0.0
        for key, result in results.items():
            if result is None:
                continue
            out.values[f"{key}_chance"] = result.chance_mean
            out.values[f"{key}_z"] = result.z
            if result.note:
                out.problems.append((key, result.note))


class _Collected:
    """Metrics computed so far, and the reasons for those that failed."""

    def __init__(self) -> None:
        self.values: Values = {}
        self.problems: Problems = []

    def __call__(
        self, definition: Definition, inputs: ClipInputs, *sound: RecordedSound
    ) -> Any | None:
        """Compute a metric, or several of one function; turn an error into a problem."""
        try:
            result = compute(definition, *inputs.sources, *sound)
        except (GestureKitError, AudioFeaturesError) as error:
            if definition.group != POOLED:  # the pooled metric says what is missing, and why
                self.problems.append((definition.key, str(error)))
            return None
        if isinstance(result, Mapping):
            self.values |= {key: float(v) for key, v in result.items() if np.isfinite(v)}
        elif result is not None:
            value = definition.factor * float(np.mean(getattr(result, "value", result)))
            if np.isfinite(value):
                self.values[definition.key] = value
            else:
                self.problems.append((definition.key, "came out as no number"))
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
    measure = ClipMetrics(ReferenceStatistics(), (MOVEMENT,), Variants(), cheap=True)
    every: dict[str, list[float]] = {}
    for motion, recording in zip(generated, recordings, strict=True):
        clip = Clip(_NAMELESS, motion, recording, body_joints(recording.skeleton), None, ())
        own = measure.recording(clip)[0]
        for key, value in measure.generated(clip)[0].items():
            if DEFINITIONS[key].better != "reference":
                every.setdefault(key, []).append(value)
            elif own.get(key):
                every.setdefault(f"{key}_ratio", []).append(value / own[key])
    return {key: float(np.mean(values)) for key, values in every.items()}
