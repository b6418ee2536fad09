"""From folders of recordings to a manifest: pair, check, trim, split."""

from __future__ import annotations

import math
import os
import re
import statistics
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from gesturekit.corpus import checks, splits
from gesturekit.corpus.manifest import READING, Item, Manifest, absolute
from gesturekit.corpus.pairing import Found, pair, recording_ids, scan, unread
from gesturekit.corpus.problem import Problem
from gesturekit.corpus.recording import MIN_DURATION, Recording, examine
from gesturekit.corpus.report import Report
from gesturekit.errors import CorpusError, MotionError, gesturekit_errors
from gesturekit.formats.conversion import applicable_read_options, refuse_unused_read_options
from gesturekit.formats.sources import MOTION_SUFFIXES, OTHER_SPEECH_SUFFIXES, SPEECH_SUFFIXES
from gesturekit.motion.parts import find_parts
from gesturekit.wording import counted, listed

MAX_SIZE_RATIO = 1.5
"""Bodies of one corpus that differ in height by more are warned about."""

Folders = str | os.PathLike[str] | Iterable[str | os.PathLike[str]]
"""A folder, or several."""


@gesturekit_errors()
def prepare(
    folders: Folders,
    out: str | os.PathLike[str] | None = None,
    *,
    unpaired: Folders = (),
    unpaired_motion: Folders = (),
    holdout: float = 0.1,
    hold_out_seconds: str | Sequence[splits.Interval] = (),
    seed: int = 0,
    speaker: str | None = None,
    style: str | None = None,
    style_pattern: str | None = None,
    tolerance: float = 1.0,
    channel: int | None = None,
    parts: Mapping[str, str] | None = None,
    read: Mapping[str, Any] | None = None,
    progress: Callable[[list[Any]], Iterable[Any]] = iter,
) -> Report:
    """Find, check and split recordings, and write the manifest where any are usable.

    Sound and motion of a pair are taken to begin together. Tables beside a recording become its
    conditions: STEM.events.csv (`gesturekit.formats.tables.events`) and STEM.path.csv
    (`formats.tables.root_path`). A problem of one recording never stops the others: it is
    reported with its file, and errors leave that recording out.

    Args:
        folders: folders with speech and motion of equal names, see `pairing.pair`.
        out: where to write the manifest; None writes nothing.
        unpaired: folders of speech to be used alone. Files that are part of a pair stay there.
        unpaired_motion: folders of motion to be used alone.
        holdout: fraction of recordings that training never sees, 0 to below 1. Of paired
            recordings at least one is held out; of a single one, its last 20 %.
        hold_out_seconds: intervals to hold out of each paired recording as "test" instead:
            `"10-15,50-"` or `[(10, 15), (50, math.inf)]`.
        seed: chooses the recordings held out.
        speaker: name of the speaker of all recordings of `folders`.
        style: label of all recordings.
        style_pattern: regular expression searched for in each id (the path within its folder,
            without extension); its groups named `style` and `speaker` give the labels.
        tolerance: seconds by which sound and motion of a pair may differ in length. Less is
            trimmed to the shorter, more is an error.
        channel: which channel of every sound file to hear, counted from 1; None for their mean.
        parts: parts of the body named by hand, such as {"left_elbow": "Joint12"}, for rigs whose
            names and shape do not tell them; see `gesturekit.motion.parts.find_parts`.
        read: how motion files are read where that is not left to detection, see
            `gesturekit.formats.conversion.load`; the manifest keeps it.
        progress: wraps the list of recordings while they are checked, as tqdm does.

    Raises:
        CorpusError: a folder does not exist, or an argument is out of range.
        ConfigError: an option of `read` that no motion found here has a use for.
    """
    folders, unpaired, unpaired_motion = map(_several, (folders, unpaired, unpaired_motion))
    intervals = splits.as_intervals(hold_out_seconds)
    if not 0 <= holdout < 1:
        raise CorpusError(f"holdout is {holdout}; it must be a fraction from 0 to below 1")
    if not (math.isfinite(tolerance) and tolerance >= 0):
        raise CorpusError(f"tolerance is {tolerance}; it must be 0 or more seconds")
    label = _labeller(style, style_pattern)

    tasks, left_over, problems = _find(folders, unpaired, unpaired_motion)
    if unknown := sorted(set(read or {}) - set(READING)):
        raise CorpusError(f"{unknown[0]!r} is nothing a manifest keeps; read has {list(READING)}")
    refuse_unused_read_options(
        read or {}, {task.motion.suffix.lower() for task, _ in tasks if task.motion}
    )
    recordings: list[Recording] = []
    unmatched = 0
    for recording, is_alone in progress(tasks):
        recording = replace(recording, channel=channel)
        if recording.motion is not None:
            reading = applicable_read_options(recording.motion, read or {})
            if parts and "height" in reading:  # which depends on them
                reading["parts"] = dict(parts)
            recording = replace(recording, reading=reading)
        checked, found = examine(recording, tolerance, parts)
        if checked is not None:
            checked, unlabelled = label(checked, None if is_alone else speaker)
            recordings.append(checked)
            found += unlabelled
            unmatched += len(unlabelled)
        problems += found
    if style_pattern and recordings and unmatched == len(recordings):
        text = (
            f"style pattern {style_pattern} matches none of "
            f"{counted(len(recordings), 'recording')}, such as {recordings[0].id}"
        )
        problems.append(Problem("warning", None, text))
    recordings, odd = _of_one_skeleton(recordings)
    left_out = {problem.file for problem in odd}
    problems = [one for one in problems if one.file not in left_out or one.severity == "error"]
    problems += odd + _notes(recordings)

    items, cut = _items(recordings, holdout, intervals, seed)
    report = Report(Manifest(items), tuple(recordings), tuple(problems + cut), tuple(left_over))
    if out is not None and items:
        report.manifest.save(out)
    return report


def _several(folders: Folders) -> list[str | os.PathLike[str]]:
    return [folders] if isinstance(folders, str | os.PathLike) else list(folders)


def _find(
    folders: list[Any], unpaired: list[Any], unpaired_motion: list[Any]
) -> tuple[list[tuple[Recording, bool]], list[Path], list[Problem]]:
    """Recordings to check (with whether each is alone), files left over, problems."""
    problems: list[Problem] = []
    seen: set[Path] = set()

    def new_files(folder: Any) -> list[Found]:
        found, trouble = scan(folder)
        if not (found or trouble or unread(folder)):
            sought = (
                f"sound ({', '.join(SPEECH_SUFFIXES)}) nor motion ({', '.join(MOTION_SUFFIXES)})"
            )
            trouble.append(Problem("warning", Path(folder), f"neither {sought} in it"))
        problems.extend(problem for problem in trouble if problem not in problems)
        fresh = [file for file in found if absolute(file.path) not in seen]
        seen.update(absolute(file.path) for file in fresh)
        return fresh

    pairing = pair([new_files(folder) for folder in folders])
    problems += pairing.problems
    # A folder may be given both ways: what it has left after pairing is then used alone.
    seen -= {absolute(file.path) for file in [*pairing.speech, *pairing.motion]}
    speech = [file for folder in unpaired for file in new_files(folder)]
    seen -= {absolute(file.path) for file in speech if not file.is_speech}
    speech = [file for file in speech if file.is_speech]
    motion = [file for folder in unpaired_motion for file in new_files(folder)]
    motion = [file for file in motion if not file.is_speech]

    named = [speech_file for speech_file, _ in pairing.pairs] + speech + motion
    ids = iter(recording_ids(named))
    tasks = [
        (Recording(next(ids), audio=sound.path, motion=moves.path), False)
        for sound, moves in pairing.pairs
    ]
    tasks += [(Recording(next(ids), audio=file.path), True) for file in speech]
    tasks += [(Recording(next(ids), motion=file.path), True) for file in motion]
    used = {absolute(file.path) for file in [*speech, *motion]}
    left_over = [
        file.path for file in [*pairing.speech, *pairing.motion] if absolute(file.path) not in used
    ]
    every = [*folders, *unpaired, *unpaired_motion]
    sounds = {task.audio.with_suffix("") for task, _ in tasks if task.audio}
    motions = {task.motion.with_suffix("") for task, _ in tasks if task.motion}
    for path in {absolute(path): path for folder in every for path in unread(folder)}.values():
        is_sound = path.suffix.lower() in OTHER_SPEECH_SUFFIXES
        if path.with_suffix("") in (sounds if is_sound else motions):
            text = f"{path.suffix.lower()[1:]} is not read; a file of the same name is"
            problems.append(Problem("note", path, text))
        else:
            left_over.append(path)
    return tasks, left_over, problems


def _labeller(
    style: str | None, pattern: str | None
) -> Callable[[Recording, str | None], tuple[Recording, list[Problem]]]:
    """What gives a recording its labels, from the pattern where it fits, else as they are."""
    if pattern is None:
        return lambda recording, speaker: (replace(recording, speaker=speaker, style=style), [])
    try:
        compiled = re.compile(pattern)
    except re.error as error:
        raise CorpusError(f"style pattern {pattern} is no regular expression: {error}") from error
    if not {"style", "speaker"} & set(compiled.groupindex):
        raise CorpusError(
            f"style pattern {pattern} has no group named style or speaker; "
            "write (?P<style>…) around what names the style"
        )

    def label(recording: Recording, speaker: str | None) -> tuple[Recording, list[Problem]]:
        match = compiled.search(recording.id)
        groups = match.groupdict() if match else {}
        labelled = replace(
            recording,
            style=groups.get("style") or style,
            speaker=groups.get("speaker") or speaker,
        )
        if match:
            return labelled, []
        return labelled, [
            Problem("note", recording.file, f"name does not match style pattern {pattern}")
        ]

    return label


def _of_one_skeleton(
    recordings: list[Recording],
) -> tuple[list[Recording], list[Problem]]:
    """Drop recordings whose joints are not those of most others."""
    skeletons = [recording.skeleton for recording in recordings if recording.skeleton is not None]
    if not skeletons:
        return recordings, []
    usual = checks.usual_skeleton(skeletons)
    kept, problems = [], []
    for recording in recordings:
        difference = recording.skeleton and checks.first_difference(recording.skeleton, usual)
        if difference:
            text = f"another skeleton than most: {difference}; prepare each rig on its own"
            problems.append(Problem("error", recording.motion, text))
        else:
            kept.append(recording)
    return kept, problems


def _notes(recordings: list[Recording]) -> list[Problem]:
    """What is true of the corpus as a whole."""
    notes = _missing_parts(recordings) + _differing_sizes(recordings)
    by_fps: dict[str, int] = defaultdict(int)
    for recording in recordings:
        if recording.fps is not None:
            by_fps[f"{recording.fps:.6g}"] += 1
    if len(by_fps) < 2:
        return notes
    rates = ", ".join(f"{fps} ({count})" for fps, count in sorted(by_fps.items(), key=_number))
    text = f"frame rates differ: {rates}; training resamples them to one"
    return [*notes, Problem("note", None, text)]


def _missing_parts(recordings: list[Recording]) -> list[Problem]:
    """Say once what a rig whose parts cannot be identified is trained without."""
    first = next((one for one in recordings if one.skeleton is not None), None)
    if first is None:
        return []
    try:
        find_parts(first.skeleton)
    except MotionError as error:
        heard = any(one.audio and one.motion for one in recordings)
        what = "training leaves out what needs these parts"
        if heard:
            what += "; multires by speech needs them, or network.modulate=all"
        return [Problem("note", first.motion, f"{error}. Without them {what}")]
    return []


def _differing_sizes(recordings: list[Recording]) -> list[Problem]:
    """Warn once of bodies so different in size that a file was probably read in a wrong unit."""
    heights = {one.motion: one.height for one in recordings if one.height is not None}
    if not heights or max(heights.values()) <= MAX_SIZE_RATIO * min(heights.values()):
        return []
    usual = statistics.median_low(heights.values())
    odd = [
        f"{file} ({height:.3g} m)"
        for file, height in heights.items()
        if max(height / usual, usual / height) > MAX_SIZE_RATIO
    ]
    if not odd:
        ends = min(heights, key=heights.get), max(heights, key=heights.get)
        odd = [f"{file} ({heights[file]:.3g} m)" for file in ends]
    text = (
        f"body heights differ by a factor of {max(heights.values()) / min(heights.values()):.3g}; "
        f"the usual is {usual:.3g} m, but not of {listed(odd, 3)}. If a unit was read wrongly, "
        "prepare those files on their own with --in-unit, or all with --height"
    )
    return [Problem("warning", None, text)]


def _number(entry: tuple[str, int]) -> float:
    return float(entry[0])


def _items(
    recordings: list[Recording],
    holdout: float,
    intervals: Sequence[splits.Interval],
    seed: int,
) -> tuple[list[Item], list[Problem]]:
    """Recordings as items, split; and the problems met in cutting them."""
    paired = [recording for recording in recordings if recording.audio and recording.motion]
    alone = [recording for recording in recordings if not (recording.audio and recording.motion)]
    if holdout > 0 and not intervals and len(paired) == 1:
        only = paired[0]
        intervals = [(only.stop - splits.TAIL * (only.stop - only.start), math.inf)]
    items: list[Item] = []
    problems: list[Problem] = []
    if intervals:
        for recording in paired:
            parts = _parts(recording, intervals)
            if not any(split == "test" for split, _ in parts):
                text = f"nothing of it lies in the seconds held out ({recording.stop:.1f} s long)"
                problems.append(Problem("warning", recording.motion, text))
            for split, (start, stop) in parts:
                if stop - start < MIN_DURATION:
                    text = f"{start:.2f} to {stop:.2f} s left out: too short a piece"
                    problems.append(Problem("note", recording.motion, text))
                    continue
                part = replace(recording, start=start, stop=stop)
                if len(parts) > 1:
                    part = replace(part, id=f"{recording.id}@{start:.2f}-{stop:.2f}")
                items.append(_item(part, split))
    else:
        chosen = splits.held_out((r.id for r in paired), holdout, seed, at_least=1)
        items += [_item(recording, chosen[recording.id]) for recording in paired]
    for group in (
        [recording for recording in alone if recording.audio],
        [recording for recording in alone if recording.motion],
    ):
        chosen = splits.held_out((r.id for r in group), holdout, seed)
        items += [_item(recording, chosen[recording.id]) for recording in group]
    return items, problems


def _parts(
    recording: Recording, intervals: Sequence[splits.Interval]
) -> list[tuple[str, splits.Interval]]:
    """The recording cut at motion frames, so that sound and motion of a part begin together."""

    def on_frame(seconds: float) -> float:
        if math.isinf(seconds):
            return seconds
        return math.floor(seconds * recording.fps + 0.5) / recording.fps

    snapped = [(on_frame(start), on_frame(stop)) for start, stop in intervals]
    return splits.cut(recording.start, recording.stop, snapped)


def _item(recording: Recording, split: str) -> Item:
    start = round(recording.start, 6)
    return Item(
        id=recording.id,
        audio=recording.audio and absolute(recording.audio),
        motion=recording.motion and absolute(recording.motion),
        audio_start=start if recording.audio else 0.0,
        motion_start=start if recording.motion else 0.0,
        # Rounded down: an item never reaches past the end of its files.
        duration=math.floor((recording.stop - start) * 1e6 + 1e-3) / 1e6,
        speaker=recording.speaker,
        style=recording.style,
        split=split,
        channel=recording.channel if recording.audio else None,
        conditions={name: absolute(file) for name, file in recording.conditions.items()},
        reading=recording.reading,
    )
