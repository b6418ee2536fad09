"""Evaluate known-bad motion made from recordings: which metrics notice it, and which are blind?"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from audio_features import AudioFeaturesError
from gesturekit.corpus import Item, Manifest
from gesturekit.errors import EvaluationError, GestureKitError
from gesturekit.evaluation.comparison import evaluate
from gesturekit.evaluation.definitions import HEADLINE, Definition
from gesturekit.evaluation.pairs import file_of, files_by_key, motion_files
from gesturekit.evaluation.results import Evaluation, MetricResult, ModelResult
from gesturekit.formats.sources import SPEECH_SUFFIXES
from gesturekit.motion import Motion
from gesturekit.motion.parts import arm_joints, find_parts
from gesturekit.motion.parts.body_size import body_scale
from gesturekit.motion.rotations import (
    mean_quaternion,
    multiply_quaternions,
    quaternion_from_rotation_vector,
    slerp,
)
from gesturekit.wording import listed

NOISE, JITTER = 0.3, 0.05
"""Standard deviations of the rotations of every joint in every frame, rad."""
SWAY, SWAY_RATE = 0.2, 0.4
"""Amplitude of the foot slide on the reference body, metres, and its frequency, Hz."""


@dataclass(frozen=True)
class BadMotionInputs:
    """Recordings from which bad motion is made.

    Attributes:
        recording: the recording that a clip is evaluated with.
        other: another held-out recording.
        training: motion of the training set.
        seed: of noise.
    """

    recording: Motion
    other: Motion
    training: Motion
    seed: int


def frozen(inputs: BadMotionInputs) -> Motion:
    """Hold the pose in the middle of the recording."""
    motion = inputs.recording
    return _frames(motion, np.full(motion.n_frames, motion.n_frames // 2))


def mean_pose(inputs: BadMotionInputs) -> Motion:
    """Hold the mean pose of the recording."""
    motion = inputs.recording
    held = frozen(inputs)
    return replace(
        held,
        rotations=np.tile(_mean_rotations(motion), (motion.n_frames, 1, 1)),
        translation=np.tile(motion.translation.mean(axis=0), (motion.n_frames, 1)),
    )


def noise(inputs: BadMotionInputs) -> Motion:
    """Turn every joint of the mean pose at random in every frame."""
    return _shaken(mean_pose(inputs), NOISE, inputs.seed)


def jitter(inputs: BadMotionInputs) -> Motion:
    """Add noise to the rotations of the recording."""
    return _shaken(inputs.recording, JITTER, inputs.seed)


def another_utterance(inputs: BadMotionInputs) -> Motion:
    """Take the motion of another held-out recording."""
    return _cut(inputs.other, inputs.recording)


def backwards(inputs: BadMotionInputs) -> Motion:
    """Play the recording backwards."""
    motion = inputs.recording
    return _frames(motion, np.arange(motion.n_frames)[::-1])


def half_speed(inputs: BadMotionInputs) -> Motion:
    """Play the first half of the recording at half the speed."""
    motion = inputs.recording
    slow = replace(motion.resample(2.0 * motion.fps), fps=motion.fps)
    return _cut(slow, motion)


def half_reach(inputs: BadMotionInputs) -> Motion:
    """Halve the rotations of the arms about their mean."""
    motion = inputs.recording
    rotations = motion.rotations.copy()
    arms = [motion.skeleton.index(name) for name in arm_joints(motion.skeleton)]
    mean = np.broadcast_to(_mean_rotations(motion)[arms], rotations[:, arms].shape)
    rotations[:, arms] = slerp(mean, rotations[:, arms], np.full(mean.shape[:-1], 0.5))
    return replace(motion, rotations=rotations)


def foot_slide(inputs: BadMotionInputs) -> Motion:
    """Sway the whole body sideways, so that the feet slide."""
    motion = inputs.recording
    sway = SWAY * body_scale(motion.skeleton) * np.sin(2 * np.pi * SWAY_RATE * motion.times)
    return replace(motion, translation=motion.translation + sway[:, None] * (1.0, 0.0, 0.0))


def training_recording(inputs: BadMotionInputs) -> Motion:
    """Take motion of the training set."""
    return _cut(inputs.training, inputs.recording)


BAD_MOTION: Mapping[str, Callable[[BadMotionInputs], Motion]] = {
    "frozen": frozen,
    "mean pose": mean_pose,
    "noise": noise,
    "jitter": jitter,
    "another utterance": another_utterance,
    "reversed": backwards,
    "half speed": half_speed,
    "half reach": half_reach,
    "foot slide": foot_slide,
    "training recording": training_recording,
}
"""Functions that make bad motion, by name."""


def _frames(motion: Motion, frames: Sequence[int] | np.ndarray) -> Motion:
    """Return chosen frames of a motion, in that order."""
    return replace(
        motion,
        rotations=motion.rotations[frames],
        translation=motion.translation[frames],
        joint_translations={name: v[frames] for name, v in motion.joint_translations.items()},
    )


def _cut(motion: Motion, length: Motion) -> Motion:
    return motion[: length.n_frames]


def _mean_rotations(motion: Motion) -> np.ndarray:
    """Return (J, 4) mean quaternions."""
    return np.stack(
        [mean_quaternion(motion.rotations[:, j]) for j in range(motion.skeleton.n_joints)]
    )


def _shaken(motion: Motion, deviation: float, seed: int) -> Motion:
    rng = np.random.default_rng(seed)
    vectors = rng.normal(0.0, deviation, (*motion.rotations.shape[:2], 3))
    shaken = multiply_quaternions(motion.rotations, quaternion_from_rotation_vector(vectors))
    return replace(motion, rotations=shaken)


RECORDING = "recording"
"""Name of the recordings themselves among the models."""
PIECE = 8.0
"""Seconds of the pieces that a single held-out recording is cut into, at least."""
SHORTEST = 3.0
"""Seconds of the shortest recording that is used."""
LONGEST, TOTAL = 60.0, 120.0
"""Seconds used of one recording, and of all held-out recordings together, at most."""


@dataclass
class Sanity:
    """Result of `run_sanity`.

    Attributes:
        evaluation: the recordings and the bad motions as models.
        left_out: {file: reason} of recordings that were not used.
    """

    evaluation: Evaluation
    left_out: dict[str, str] = field(default_factory=dict)


def run_sanity(recordings: Path, audio: Path | None = None, **options: Any) -> Sanity:
    """Evaluate known-bad motion made from recordings.

    Half of the recordings are held out, and bad motion is made from them; the others stand for
    training motion. A single recording is cut: its first half is the training motion, its second
    half is cut into held-out recordings.

    Args:
        recordings: folder or file of motion.
        audio: folder or file of sound; None for sound beside the motion, if there is any.
        options: of `evaluate`, such as `seed`, `workers` and `progress`.

    Raises:
        CorpusError: no motion.
        EvaluationError: no recording is long enough.
    """
    sounds = _sounds(recordings, audio)
    result: dict[str, str] = {}
    items = []
    for key, path in motion_files(recordings).items():
        try:
            items.append(_item(key, path, file_of(key, sounds, audio), Motion.load(path)))
        except (GestureKitError, AudioFeaturesError) as error:
            result[key] = str(error)
    if not items:
        reasons = "; ".join(f"{key}: {reason}" for key, reason in list(result.items())[:2])
        raise EvaluationError(f"{recordings}: no recording can be used: {reasons}")
    held_out, training = _split(items)
    with tempfile.TemporaryDirectory(prefix="gesturekit_sanity_") as folder:
        root = Path(folder)
        Manifest([*held_out, *training]).save(root / "corpus.jsonl")
        models = _write(root, held_out, training, options.get("seed", 0))
        found = evaluate(models, root / "corpus.jsonl", split="test", **options)
    return Sanity(replace(found, reference=recordings), result)


def _sounds(recordings: Path, audio: Path | None) -> Mapping[str, Path]:
    if audio is not None:
        return files_by_key(audio, SPEECH_SUFFIXES, "sound")
    try:
        return files_by_key(recordings if recordings.is_dir() else recordings.parent,
                            SPEECH_SUFFIXES, "sound")  # fmt: skip
    except GestureKitError:
        return {}


def _item(key: str, path: Path, sound: Path | None, motion: Motion) -> Item:
    """Return the item of one recording, cut to the length of its sound.

    Raises:
        EvaluationError: it is too short.
        MotionError: arms and legs, which most bad motion needs, cannot be identified.
        AudioError: the sound cannot be read.
    """
    from audio_features import Wave

    find_parts(motion.skeleton)
    seconds = min(LONGEST, motion.duration)
    if sound is not None:
        seconds = min(seconds, Wave.load(sound).duration)
    if seconds < SHORTEST:
        raise EvaluationError(f"{path.name}: {seconds:.1f} s; at least {SHORTEST:g} s are needed")
    return Item(id=key, audio=sound and sound.absolute(), motion=path.absolute(), duration=seconds)


def _split(items: Sequence[Item]) -> tuple[list[Item], list[Item]]:
    """Return held-out items and training items."""
    if len(items) == 1:
        (whole,) = items
        half = whole.duration / 2
        held_out, training = [_part(whole, half, half, "end")], [_part(whole, 0.0, half, "start")]
    else:
        held_out, training = list(items[::2]), list(items[1::2])
    if len(held_out) == 1:
        (one,) = held_out
        pieces = max(1, int(one.duration // PIECE))
        seconds = one.duration / pieces
        held_out = [_part(one, n * seconds, seconds, f"{n + 1}") for n in range(pieces)]
    share = min(1.0, TOTAL / sum(item.duration for item in held_out))
    held_out = [replace(i, duration=max(SHORTEST, share * i.duration)) for i in held_out]
    return [replace(item, split="test") for item in held_out], training


def _part(item: Item, start: float, seconds: float, name: str) -> Item:
    return replace(
        item,
        id=f"{item.id}_{name}",
        audio_start=item.audio_start + start,
        motion_start=item.motion_start + start,
        duration=seconds,
    )


def _write(
    root: Path, held_out: Sequence[Item], training: Sequence[Item], seed: int
) -> dict[str, Path]:
    """Write the recordings and the bad motions; return {name: folder}."""
    motions = [item.load_motion() for item in held_out]
    trained = [item.load_motion() for item in training]
    models = {RECORDING: root / RECORDING}
    models |= {name: root / name.replace(" ", "_") for name in BAD_MOTION}
    for n, (item, motion) in enumerate(zip(held_out, motions, strict=True)):
        other = motions[(n + 1) % len(motions)]
        inputs = BadMotionInputs(motion, other, trained[n % len(trained)], seed + n)
        for name, folder in models.items():
            made = motion if name == RECORDING else BAD_MOTION[name](inputs)
            made.save(folder / f"{item.id}.npz")
    return models


NOTICED, BLIND, FOOLED, SILENT = "+", ".", "!", " "
"""Marks: noticed; blind; rated better than the recording itself; nothing measured or to say."""
LEGEND = (
    "+ notices it, . is blind to it, ! rates it better than the recording itself (as the metric is "
    "published); blank: not measured, or not informative on these recordings"
)
CHANGE = 0.2
"""A metric detects bad motion if its value differs from the recordings' own by more than this
ratio."""
TIMED = 0.5
"""A speech metric detects bad motion below this share of the recordings' own value above chance."""
UNLIKE, NEAR = 0.05, 0.8
"""Loss of likeness, and ratio of distances to training motion, that count as detection."""


def marks(sanity: Sanity) -> dict[str, dict[str, str]]:
    """Return {key of `definitions`: {bad motion: mark}}."""
    evaluation = sanity.evaluation
    recording, *bad = evaluation.models
    return {
        d.key: {m.label: mark(d, m.metrics.get(d.key), recording) for m in bad}
        for d in evaluation.definitions()
    }


def mark(definition: Definition, result: MetricResult | None, recording: ModelResult) -> str:
    """Return the mark of one metric for one bad motion.

    Args:
        definition: of the metric.
        result: the bad motion's result, or None.
        recording: the results of the recordings themselves.
    """
    own = recording.metrics.get(definition.key)
    if result is None or own is None or not result.informative:
        return SILENT
    if own.recording is None and definition.enough:
        return SILENT
    value, itself = result.interval.value, own.interval.value
    sign = {"higher": 1.0, "lower": -1.0, "reference": 0.0}[definition.better]
    if sign * (value - itself) > CHANGE * abs(itself) + 1e-6:
        return FOOLED
    return NOTICED if _notices(definition, result, own) else BLIND


def _notices(definition: Definition, result: MetricResult, own: MetricResult) -> bool:
    key = definition.key
    value, itself = result.interval.value, own.interval.value
    if key == "likeness":
        return value < itself - UNLIKE
    if key in ("novelty", "copying", "copying_low"):
        return value < NEAR * itself
    if key == "in_time" or key.endswith("_z"):
        return value < TIMED * itself
    if result.chance is not None and own.chance is not None:
        return value - result.chance < TIMED * (itself - own.chance)
    goal = itself if own.recording is None else own.recording
    if definition.enough == "at least":
        return value < (1.0 - CHANGE) * goal
    if definition.enough == "at most":
        return value > (1.0 + CHANGE) * goal
    return key not in ("calm_lively_slope",) and abs(value - goal) > CHANGE * abs(goal) + 1e-9


def table_lines(sanity: Sanity) -> Iterator[str]:
    """Yield the table for a terminal: one row a metric, one numbered column a bad motion."""
    evaluation = sanity.evaluation
    names = [model.label for model in evaluation.models if model.label != RECORDING]
    found = marks(sanity)
    yield "What each metric notices of known-bad motion"
    yield from (f"  {n}  {name}" for n, name in enumerate(names, 1))
    width = max(len(d.name) for d in evaluation.definitions())
    yield f"{'':{width}}  {' '.join(f'{n:>2}' for n in range(1, len(names) + 1))}"
    group = ""
    for d in evaluation.definitions():
        if d.group != group:
            group = d.group
            yield f"{group}:"
        signs = " ".join(f"{found[d.key][name]:>2}" for name in names)
        yield f"{d.name:{width}}  {signs}".rstrip()
    yield LEGEND


def noticed_by(sanity: Sanity) -> dict[str, list[str]]:
    """Return {bad motion: keys of the headline metrics that notice it}."""
    found = marks(sanity)
    keys = [d.key for d in sanity.evaluation.definitions() if d.group == HEADLINE]
    return {
        model.label: [key for key in keys if found[key][model.label] == NOTICED]
        for model in sanity.evaluation.models
        if model.label != RECORDING
    }


def conclusion(sanity: Sanity) -> str:
    """Return what the three headline metrics notice together, in one sentence."""
    found = noticed_by(sanity)
    missed = [name for name, keys in found.items() if not keys]
    timed = sanity.evaluation.models[0].metrics.get("in_time")
    why = "" if timed is not None and timed.informative else (
        " (In time with the speech: cannot be answered on this corpus.)"
    )  # fmt: skip
    if not missed:
        return f"The three headline figures together notice all {len(found)} bad motions.{why}"
    return (
        f"The three headline figures together notice {len(found) - len(missed)} of {len(found)} "
        f"bad motions, but not: {listed(missed, 5)}.{why}"
    )
