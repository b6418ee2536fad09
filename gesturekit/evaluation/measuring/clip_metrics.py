"""Metrics of one clip: of its motion alone, and compared with its recording and its sound."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from audio_features import AudioFeaturesError
from gesturekit.errors import GestureKitError
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
from gesturekit.evaluation.measuring.clips import Clip, RecordedSound, load_sound
from gesturekit.evaluation.measuring.inputs import ClipInputs, ReferenceStatistics, compute
from gesturekit.evaluation.metrics.sync import hardly_moves
from gesturekit.evaluation.pairs import Pair
from gesturekit.motion import Motion
from gesturekit.motion.parts import body_joints

Values = dict[str, float]
"""{key of `definitions`: value}"""
Problems = list[tuple[str, str]]
"""(key, reason) of metrics that could not be computed."""


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
