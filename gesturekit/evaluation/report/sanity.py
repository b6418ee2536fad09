"""Evaluate known-bad motion made from recordings: which metrics notice it, and which are blind?"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from audio_features import AudioFeaturesError, Wave
from gesturekit.corpus import Item
from gesturekit.errors import EvaluationError, GestureKitError
from gesturekit.evaluation.comparison import evaluate
from gesturekit.evaluation.definitions import HEADLINE, Definition
from gesturekit.evaluation.measuring.made_motion import bad_motion
from gesturekit.evaluation.pairs import Items, file_of, files_by_key, motion_files
from gesturekit.evaluation.results import Evaluation, MetricResult, ModelResult
from gesturekit.evaluation.statistics.paired import distance
from gesturekit.formats.sources import SPEECH_SUFFIXES
from gesturekit.motion import Motion
from gesturekit.motion.parts import find_parts
from gesturekit.wording import listed

RECORDING = "recording"
"""Name of the recordings themselves among the models."""
PIECE = 8.0
"""Seconds of the pieces that a single held-out recording is cut into, at least."""
SHORTEST = 3.0
"""Seconds of the shortest recording that is used."""
LONGEST, TOTAL = 60.0, 120.0
"""Seconds used of one recording, and of all held-out recordings together, at most."""


def run_sanity(
    recordings: Path, audio: Path | None = None, **options: Any
) -> tuple[Evaluation, dict[str, str]]:
    """Evaluate known-bad motion made from recordings.

    Half of the recordings are held out, and bad motion is made from them; the others stand for
    training motion. A single recording is cut: its first half is the training motion, its second
    half is cut into held-out recordings.

    Args:
        recordings: folder or file of motion.
        audio: folder or file of sound; None for sound beside the motion, if there is any.
        options: of `evaluate`, such as `seed`, `workers` and `progress`.

    Returns:
        the evaluation of the recordings and of bad motion as models, and {file: reason} of
        recordings that were not used.

    Raises:
        CorpusError: no motion.
        EvaluationError: no recording is long enough.
    """
    sounds = _sounds(recordings, audio)
    left_out: dict[str, str] = {}
    items = []
    for key, path in motion_files(recordings).items():
        try:
            items.append(_item(key, path, file_of(key, sounds, audio)))
        except (GestureKitError, AudioFeaturesError) as error:
            left_out[key] = str(error)
    if not items:
        reasons = "; ".join(f"{key}: {reason}" for key, reason in list(left_out.items())[:2])
        raise EvaluationError(f"{recordings}: no recording can be used: {reasons}")
    held_out, training = _split(items)
    reference = Items(recordings, "test", tuple(held_out), others=tuple(training))
    with tempfile.TemporaryDirectory(prefix="gesturekit_sanity_") as folder:
        models = _write(Path(folder), held_out, training, options.get("seed", 0))
        return evaluate(models, reference, **options), left_out


def _sounds(recordings: Path, audio: Path | None) -> Mapping[str, Path]:
    """Return the sounds of recordings by key; those beside the motion may be missing."""
    try:
        beside = recordings if recordings.is_dir() else recordings.parent
        return files_by_key(audio or beside, SPEECH_SUFFIXES, "sound")
    except GestureKitError:
        if audio is not None:
            raise
        return {}


def _item(key: str, path: Path, sound: Path | None) -> Item:
    """Return the item of one recording, cut to the length of its sound.

    Raises:
        EvaluationError: it is too short.
        MotionError: arms and legs, which most bad motion needs, cannot be identified.
        AudioError: the sound cannot be read.
    """
    motion = Motion.load(path)
    find_parts(motion.skeleton)
    seconds = min(LONGEST, motion.duration)
    if sound is not None:
        seconds = min(seconds, Wave.load(sound).duration)
    if seconds < SHORTEST:
        raise EvaluationError(f"{path.name}: {seconds:.1f} s; at least {SHORTEST:g} s are needed")
    return Item(id=key, audio=sound and sound.absolute(), motion=path.absolute(), duration=seconds)


def _split(items: Sequence[Item]) -> tuple[list[Item], list[Item]]:
    """Return held-out items and training items."""
    held_out, training = list(items[::2]), list(items[1::2])
    if not training:
        training, held_out = [_cut(items[0], 2, 0, "start")], [_cut(items[0], 2, 1, "end")]
    if len(held_out) == 1:
        pieces = max(1, int(held_out[0].duration // PIECE))
        held_out = [_cut(held_out[0], pieces, n, f"{n + 1}") for n in range(pieces)]
    share = min(1.0, TOTAL / sum(item.duration for item in held_out))
    held_out = [replace(i, duration=max(SHORTEST, share * i.duration)) for i in held_out]
    return [replace(item, split="test") for item in held_out], training


def _cut(item: Item, pieces: int, at: int, name: str) -> Item:
    """Return one of several equal pieces of an item."""
    seconds = item.duration / pieces
    return replace(
        item,
        id=f"{item.id}_{name}",
        audio_start=item.audio_start + at * seconds,
        motion_start=item.motion_start + at * seconds,
        duration=seconds,
    )


def _write(
    root: Path, held_out: Sequence[Item], training: Sequence[Item], seed: int
) -> dict[str, Path]:
    """Write the recordings and the bad motions; return {name: folder}."""
    motions = [item.load_motion() for item in held_out]
    trained = [item.load_motion() for item in training]
    folders = {}
    for n, (item, motion) in enumerate(zip(held_out, motions, strict=True)):
        other = motions[(n + 1) % len(motions)]
        made = bad_motion(motion, other, trained[n % len(trained)], seed + n)
        for name, shown in {RECORDING: motion, **made}.items():
            folders[name] = root / name.replace(" ", "_")
            shown.save(folders[name] / f"{item.id}.npz")
    return folders


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


def marks(evaluation: Evaluation) -> dict[str, dict[str, str]]:
    """Return {key of `definitions`: {bad motion: mark}}."""
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
    goal = itself if own.recording is None else own.recording
    if key == "likeness":
        return value < itself - UNLIKE
    if key in ("novelty", "copying", "copying_low"):
        return value < NEAR * itself
    if key == "in_time" or key.endswith("_z"):
        return value < TIMED * itself
    if result.chance is not None and own.chance is not None:
        return value - result.chance < TIMED * (itself - own.chance)
    away = float(distance(key, value, goal))
    return key != "calm_lively_slope" and away > CHANGE * abs(goal) + 1e-9


def table_lines(evaluation: Evaluation) -> Iterator[str]:
    """Yield the table for a terminal: one row a metric, one numbered column a bad motion."""
    by_key, definitions = marks(evaluation), evaluation.definitions()
    names = [model.label for model in evaluation.models[1:]]
    yield "What each metric notices of known-bad motion"
    yield from (f"  {n}  {name}" for n, name in enumerate(names, 1))
    width = max(len(d.name) for d in definitions)
    yield f"{'':{width}}  {' '.join(f'{n:>2}' for n in range(1, len(names) + 1))}"
    for before, d in zip([None, *definitions], definitions):
        if before is None or d.group != before.group:
            yield f"{d.group}:"
        signs = " ".join(f"{by_key[d.key][name]:>2}" for name in names)
        yield f"{d.name:{width}}  {signs}".rstrip()
    yield LEGEND


def noticed_by(evaluation: Evaluation) -> dict[str, list[str]]:
    """Return {bad motion: keys of the headline metrics that notice it}."""
    by_key = marks(evaluation)
    keys = [d.key for d in evaluation.definitions() if d.group == HEADLINE]
    return {
        model.label: [key for key in keys if by_key[key][model.label] == NOTICED]
        for model in evaluation.models[1:]
    }


def conclusion(evaluation: Evaluation) -> str:
    """Return what the three headline metrics notice together, in one sentence."""
    noticed = noticed_by(evaluation)
    missed = [name for name, keys in noticed.items() if not keys]
    timed = evaluation.models[0].metrics.get("in_time")
    found = f"all {len(noticed)} bad motions."
    if missed:
        some = f"{len(noticed) - len(missed)} of {len(noticed)} bad motions"
        found = f"{some}, but not: {listed(missed, 5)}."
    if timed is None or not timed.informative:
        found += " (In time with the speech: cannot be answered on this corpus.)"
    return f"The three headline figures together notice {found}"
