"""Metrics of one clip: of its motion alone, and compared with its recording and its sound.

A metric is a function in `metrics` whose parameters are inputs by name.
"""

from __future__ import annotations

import functools
import inspect
import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from audio_features import AudioFeaturesError
from gesturekit.corpus.manifest import Item
from gesturekit.errors import EvaluationError, GestureKitError
from gesturekit.evaluation.definitions import (
    DEFINITIONS,
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
from gesturekit.evaluation.metrics.physical import JointLimits, standing_heights
from gesturekit.evaluation.metrics.sync import hardly_moves
from gesturekit.evaluation.pairs import BareItem, Excluded, Pair, grouped
from gesturekit.motion import Motion
from gesturekit.motion.contacts import foot_points
from gesturekit.motion.parts import body_joints, find_parts


@dataclass
class Values:
    """Metrics of one motion.

    Attributes:
        values: {key of `definitions`: value}, and KEY_chance and KEY_z of speech metrics.
        problems: (key, reason) of metrics that could not be computed.
    """

    values: dict[str, float] = field(default_factory=dict)
    problems: list[tuple[str, str]] = field(default_factory=list)

    def add(self, definition: Definition, *sources: object) -> Any | None:
        """Compute a metric, or several of one function, and return the function's result.

        An error becomes a problem, and the result None.

        Args:
            definition: of a metric with a function.
            sources: see `compute`.
        """
        try:
            result = compute(definition, *sources)
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
    def of(cls, recordings: Mapping[str, Item], fps: float) -> ReferenceStatistics:
        """Compute the statistics of recordings; leave out rigs that differ from the first one."""
        found, joints = cls(), tuple[str, ...]()
        sums, n_frames = np.zeros(1), 0
        roots: set[str] = set()  # they turn with the whole body

        def readable() -> Iterator[Motion]:  # each is in memory once: there may be hours of them
            nonlocal joints, sums, n_frames
            for key, item in recordings.items():
                try:
                    motion = load_recording(item, fps)
                    joints = joints or body_joints(motion.skeleton)
                    if not set(joints) <= set(motion.skeleton.names):
                        raise EvaluationError("its rig differs from that of the first recording")
                    speed = rhythm.central_speed(motion, joints)
                except GestureKitError as error:
                    found.excluded.append(Excluded(key, str(error), "the set of recordings"))
                    continue
                found.recordings.append(key)
                roots.update((motion.skeleton.names[0], *motion.joint_translations))
                sums = sums + [column.sum() for column in speed.T]
                n_frames += len(speed)
                yield motion

        motions = readable()
        if (first := next(motions, None)) is not None:
            limits = JointLimits.fit(itertools.chain([first], motions), joints)
            found.mean_speed = dict(zip(joints, (sums / n_frames).tolist()))
            found.limits = limits.without(roots) if set(joints) - roots else None
        return found


@dataclass(eq=False)
class ClipInputs:
    """Inputs of the metrics of one motion of a clip, computed when a metric names them.

    Attributes:
        motion: the motion that is measured: that of the clip, or its recording.
        clip: the clip; its fields are inputs as well.
        statistics: of all recordings; their fields are inputs as well.
        variants: variants of the metrics, by name.
    """

    motion: Motion
    clip: Clip
    statistics: ReferenceStatistics
    variants: Variants

    @property
    def sources(self) -> tuple[object, ...]:
        """Objects whose attributes are the inputs, the first that has one of a name."""
        return self, self.clip, self.statistics, self.variants, self.motion

    @property
    def mouth(self) -> np.ndarray | None:
        """Opening of the mouth (T,), or None."""
        return mouth_opening(self.motion)

    @property
    def recorded_mouth(self) -> np.ndarray | None:
        """Recorded opening of the mouth (T,), or None."""
        return mouth_opening(self.clip.recording)

    @property
    def frame_rate(self) -> float | None:
        """Frames per second, for the variant of beat alignment that counts frames."""
        return self.motion.fps if self.variants.bas == "bailando" else None

    @property
    def limits(self) -> JointLimits | None:
        """Limits of the joints that the clip has.

        Elbows and wrists of a retargeted motion have none: the twist of these bones is a guess.
        """
        limits = self.statistics.limits
        if limits is None:
            return None
        left_out: set[str | None] = {n for n in limits.joints if n not in self.clip.joints}
        if self.clip.is_retargeted:
            arms = find_parts(self.clip.recording.skeleton).arms.values()
            left_out |= {joint for arm in arms for joint in (arm.elbow, arm.wrist)}
        return limits.without(left_out)

    @property
    def upper_limits(self) -> JointLimits | None:
        """The same of the upper body: who sits among standing people is not broken."""
        limits = self.limits
        upper = upper_joints(self.clip.recording.skeleton)
        return limits and limits.without({*limits.joints} - {*upper})

    @functools.cached_property
    def heights(self) -> np.ndarray:
        """Standing heights (F,) of the foot points, metres: the recording's, of the same body.

        A rig without the ends of the recording's feet has fewer points, and a retargeted motion may
        have another floor: these take their own heights.
        """
        rigs = (self.motion.skeleton, self.clip.recording.skeleton)
        alike = self.clip.same_body and len({len(foot_points(rig)) for rig in rigs}) == 1
        return standing_heights(self.clip.recording if alike else self.motion)

    @functools.cached_property
    def beats(self) -> np.ndarray:
        """Beats (M,) of the motion, seconds."""
        return rhythm.motion_beats(self.motion, variant=self.variants.bas, joints=self.clip.joints)

    @functools.cached_property
    def beats_by_joint(self) -> list[np.ndarray]:
        """Beats (M,) of each joint of the upper body, seconds."""
        upper, mean_speed = upper_joints(self.clip.recording.skeleton), self.statistics.mean_speed
        joints = [name for name in self.clip.joints if name in upper]
        known = set(joints) <= set(mean_speed)
        usual = np.array([mean_speed[name] for name in joints]) if known else None
        return rhythm.joint_beats(self.motion, mean_speed=usual, joints=joints)


def compute(definition: Definition, *sources: object) -> Any | None:
    """Return the result of a metric's function; None if an input that it needs is missing.

    Args:
        definition: of a metric with a function.
        sources: objects whose attributes are the inputs.

    Raises:
        GestureKitError, AudioFeaturesError: the metric cannot be computed.
    """
    function, arguments = definition.load_function(), dict(definition.arguments)
    for name, parameter in inspect.signature(function).parameters.items():
        source = next((s for s in sources if name in vars(s) or hasattr(type(s), name)), None)
        if name not in definition.arguments and source is not None:
            arguments[name] = getattr(source, name)
        if parameter.default is parameter.empty and arguments.get(name) is None:
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

    def generated(self, clip: Clip) -> Values:
        """Compute all metrics of the generated motion."""
        inputs = self._inputs(clip, clip.generated)
        found = self._own(inputs)
        self._compare(found, inputs)
        return found

    def against(self, clip: Clip) -> dict[str, float]:
        """Compute the metrics that compare the motion of a clip with its recording."""
        found = Values()
        self._compare(found, self._inputs(clip, clip.generated))
        return found.values

    def recording(self, clip: Clip) -> dict[str, float]:
        """Compute the metrics of the recording itself: the goal, or the upper bound."""
        return self._own(self._inputs(clip, clip.recording)).values

    def mismatched_sound(self, clip: Clip, sounds: Sequence[RecordedSound]) -> dict[str, float]:
        """Average the speech metrics of the generated motion over other recordings' sounds."""
        inputs, every = self._inputs(clip, clip.generated), list[tuple[str, float]]()
        for sound in sounds:
            found = Values()
            self._speech(found, inputs, sound)
            found.values.pop("sync_lag", None)  # that of other sounds is no chance level
            every += found.values.items()
        return {key: float(np.mean(values)) for key, values in grouped(every).items()}

    def mismatched_motion(self, clip: Clip, other: Motion) -> dict[str, float]:
        """Compute the metrics that are also taken with another recording (CCA)."""
        found = Values()
        if set(clip.joints) <= set(other.skeleton.names):
            inputs = self._inputs(replace(clip, recording=other), clip.generated)
            for definition in self._chosen("comparison"):
                if definition.mismatched:
                    found.add(definition, *inputs.sources)
        return found.values

    def _inputs(self, clip: Clip, motion: Motion) -> ClipInputs:
        return ClipInputs(motion, clip, self.statistics, self.variants)

    def _chosen(self, of: str) -> list[Definition]:
        """Return the metrics of the groups, one for each function and its arguments."""
        chosen: dict[tuple[str, str], Definition] = {}
        for d in definitions_of(of):
            if d.taken_with in self.groups and (d.cheap or not self.cheap):
                chosen.setdefault((d.function, repr(d.arguments)), d)
        return list(chosen.values())

    def _own(self, inputs: ClipInputs) -> Values:
        """Compute the metrics of one motion, and of it with its sound."""
        found, pair = Values(), inputs.clip.pair
        for definition in self._chosen("motion"):
            found.add(definition, *inputs.sources)
        if SPEECH in self.groups and pair.audio is not None:
            try:
                self._speech(found, inputs, load_sound(pair.audio, pair.window))
            except AudioFeaturesError as error:
                found.problems.append(("speech", str(error)))
        return found

    def _compare(self, found: Values, inputs: ClipInputs) -> None:
        for definition in self._chosen("comparison"):
            found.add(definition, *inputs.sources)

    def _speech(self, found: Values, inputs: ClipInputs, sound: RecordedSound) -> None:
        sources = *inputs.sources, sound
        results = {d.key: found.add(d, *sources) for d in self._chosen("sound")}
        synced = results.get("sync")
        if synced is not None and not (synced.note and synced.r):  # else its chance is unknown
            found.values |= {"in_time": synced.r - synced.chance_mean, "sync_lag": synced.lag}
        elif synced is None and hardly_moves(inputs.motion, inputs.clip.recording):
            found.values["in_time"] = 0.0
        for key, result in results.items():
            if result is not None:
                found.values |= {f"{key}_chance": result.chance_mean, f"{key}_z": result.z}
                found.problems += [(key, result.note)] if result.note else []


_NAMELESS = Pair("clip", "clip", None, BareItem(id="clip"), BareItem(id="clip"))


def nameless_clip(motion: Motion, recording: Motion) -> Clip:
    """Return a clip of two motions of one rig, without files."""
    return Clip(_NAMELESS, motion, recording, body_joints(recording.skeleton), None, ())


def quick_metrics(generated: Sequence[Motion], recordings: Sequence[Motion]) -> dict[str, float]:
    """Return means over clips of the cheap metrics (`cheap` in `definitions`).

    A metric whose goal is the recording's value is given as its ratio to that value, `KEY_ratio`;
    1 equals the recording. A metric that fails for all clips is left out.

    Args:
        generated: motions of one rig.
        recordings: the same number of motions, of the same rig and frame rate.
    """
    measure = ClipMetrics(ReferenceStatistics(), (MOVEMENT,), Variants(), cheap=True)
    every: list[tuple[str, float]] = []
    for motion, recording in zip(generated, recordings, strict=True):
        clip = nameless_clip(motion, recording)
        own = measure.recording(clip)
        for key, value in measure.generated(clip).values.items():
            if DEFINITIONS[key].better != "reference":
                every.append((key, value))
            elif own.get(key):
                every.append((f"{key}_ratio", value / own[key]))
    return {key: float(np.mean(values)) for key, values in grouped(every).items()}
