"""Inputs of metrics, by the names of the parameters of the functions in `metrics`."""

from __future__ import annotations

import functools
import hashlib
import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gesturekit.errors import EvaluationError, GestureKitError
from gesturekit.evaluation.definitions import Definition, Variants
from gesturekit.evaluation.measuring.clips import Clip, load_recording
from gesturekit.evaluation.metrics import rhythm
from gesturekit.evaluation.metrics.hands import upper_joints
from gesturekit.evaluation.metrics.physical import JointLimits, LimitsFit, standing_heights
from gesturekit.evaluation.pairs import Excluded, ItemInterval
from gesturekit.motion import Motion
from gesturekit.motion.contacts import foot_points
from gesturekit.motion.parts import body_joints

if TYPE_CHECKING:
    from gesturekit.evaluation.metrics.frechet.feature_model import Extractor
    from gesturekit.evaluation.metrics.frechet.poses import PoseWindows


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


@dataclass(frozen=True, eq=False)
class SetInputs:
    """Inputs of the metrics of a set of motions.

    Attributes:
        generated: all motion of a model.
        reference: all recordings.
        model: the feature extractor of FGD, or None.
        joints: names of the joints that all of them have; None for all body joints.
        seed: of intervals.
        kinetic: variant of the kinetic features.
    """

    generated: Sequence[Motion]
    reference: Sequence[Motion]
    model: Extractor | None
    joints: tuple[str, ...] | None
    seed: int
    kinetic: str

    @property
    def motions(self) -> Sequence[Motion]:
        """The motion whose diversity is measured: `generated`."""
        return self.generated

    @property
    def windows(self) -> PoseWindows | None:
        """The windows of the feature extractor, or None."""
        return None if self.model is None else self.model.windows


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
