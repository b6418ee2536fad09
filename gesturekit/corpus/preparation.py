"""Prepare a corpus: pair, check, trim and split recordings, and write the manifest."""

from __future__ import annotations

import math
import os
import re
import statistics
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from audio_features.errors import check_values
from gesturekit.corpus import checks, splits
from gesturekit.corpus.alignment import corrections, shift_problems
from gesturekit.corpus.checks import Problem
from gesturekit.corpus.layouts import read_layout
from gesturekit.corpus.layouts.listing import Listing
from gesturekit.corpus.manifest import READING, Item, Manifest, absolute
from gesturekit.corpus.pairing import MediaFile, pair, recording_ids, scan, unread
from gesturekit.corpus.recording import Recording, examine, examine_each
from gesturekit.corpus.report import Report
from gesturekit.corpus.takes import compiled, name_takes, neighbours
from gesturekit.errors import CorpusError, MotionError, gesturekit_errors
from gesturekit.field_docs import build_options
from gesturekit.formats.registry import MOTION_SUFFIXES
from gesturekit.formats.sources import (
    OTHER_SPEECH_SUFFIXES,
    SPEECH_SUFFIXES,
    applicable_read_options,
    refuse_unused_options,
)
from gesturekit.motion.parts import find_parts
from gesturekit.wording import counted, did_you_mean, listed

MAX_SIZE_RATIO = 1.5
"""Largest ratio of body heights in a corpus without a warning."""

Folders = str | os.PathLike[str] | Iterable[str | os.PathLike[str]]
"""A folder, or several."""


@dataclass(frozen=True, kw_only=True)
class PrepareOptions:
    """Options of `prepare`.

    Raises:
        CorpusError: a value out of range, or an entry of `read` that a manifest cannot store.
    """

    layout: str | None = None
    """Public corpus in whose published form the folder is, one of `layouts.LAYOUTS`. Its splits,
    speakers, styles and side files are used."""
    unpaired: Folders = ()
    """Folders of speech to use alone. Files that are part of a pair stay in it."""
    unpaired_motion: Folders = ()
    """Folders of motion to use alone."""
    holdout: float = 0.1
    """Fraction of takes held out from training, 0 to below 1. At least one paired take is held
    out; with a single one, one of its recordings, or the last 20 % of its only one."""
    hold_out_seconds: str | Sequence[splits.Interval] = ()
    """Intervals of each paired recording to hold out as "test" instead: `"10-15,50-"` or
    `[(10, 15), (50, math.inf)]`."""
    hold_out_pattern: str | None = None
    """Regular expression to search for in each id: hold out the recordings that it matches, as
    "test", instead of a fraction or a published split."""
    hold_out_list: str | os.PathLike[str] | None = None
    """Text file with one id, or last part of an id, a line: hold out these recordings instead."""
    hold_out_speakers: str | Sequence[str] = ()
    """Speakers whose recordings to hold out instead."""
    seed: int = 0
    """Seed of the choice of recordings to hold out."""
    speaker: str | None = None
    """Name of the speaker of all recordings of `folders`."""
    style: str | None = None
    """Style label of all recordings."""
    style_pattern: str | None = None
    """Regular expression to search for in each id (the path within its folder, without
    extension); its groups named `style` and `speaker` give the labels."""
    take_pattern: str | None = None
    """Regular expression to search for in each id, for takes (recording sessions) that were cut
    into files: the take is its group named `take`, else its first group, else the whole match. By
    default each recording is a take of its own."""
    take_table: str | os.PathLike[str] | None = None
    """CSV table with the columns id and take, instead of a pattern or beside it."""
    tolerance: float = 1.0
    """Largest difference in length between the sound and the motion of a pair, seconds. The longer
    one is trimmed; a larger difference is an error."""
    trim: str | Sequence[str] = ()
    """Ids of pairs, `"day1/003,004"` or a list, whose sound and motion may differ by any length;
    the longer one is trimmed."""
    shift: float | str = 0.0
    """Seconds by which the motion of every pair comes later than its sound in the files (negative:
    earlier), which are taken back; "auto" estimates them, and reads the recordings twice. See
    `gesturekit.corpus.alignment`."""
    channel: int | None = None
    """Channel of every sound file to use, counted from 1; None for their mean."""
    parts: Mapping[str, str] | None = None
    """Body parts assigned by hand, such as {"left_elbow": "Joint12"}, for rigs on which they cannot
    be identified; see `gesturekit.motion.parts.find_parts`."""
    read: Mapping[str, Any] | None = None
    """Options for reading motion files that replace detection, see
    `gesturekit.formats.sources.load`; the manifest stores them."""
    workers: int = 1
    """Number of processes that check recordings; the manifest is the same for any number."""
    progress: Callable[[list[Any]], Iterable[Any]] = iter
    """Wraps the list of recordings while they are checked, as tqdm does."""

    def __post_init__(self) -> None:
        by_name = self.hold_out_pattern or self.hold_out_list or self.hold_out_speakers
        if by_name and self.hold_out_seconds:
            raise CorpusError("give either seconds or names of recordings to hold out, not both")
        splits.as_intervals(self.hold_out_seconds)
        if self.take_pattern is not None:
            compiled("take pattern", self.take_pattern)  # an error before files are read
        if self.take_table is not None and not Path(self.take_table).is_file():
            raise CorpusError(f"table of takes {self.take_table}: no such file")
        is_number = isinstance(self.shift, int | float) and math.isfinite(self.shift)
        read = self.read or {}
        model = read.get("body_model")
        is_there = model is None or Path(model).exists()
        values = (
            ("holdout", self.holdout, 0 <= self.holdout < 1, "a fraction from 0 to below 1"),
            ("seed", self.seed, self.seed >= 0, "a whole number from 0"),
            ("workers", self.workers, 1 <= self.workers <= 1024, "at least 1"),
            ("tolerance", self.tolerance, 0 <= self.tolerance < math.inf, "0 or more seconds"),
            ("shift", self.shift, is_number or self.shift == "auto", "seconds, or auto"),
            ("read", list(read), set(read) <= set(READING), f"options of {list(READING)}"),
            ("body model", model, is_there, "a file or folder"),
        )
        check_values(CorpusError, "", values)


@gesturekit_errors()
def prepare(folders: Folders, out: str | os.PathLike[str] | None = None, **options: Any) -> Report:
    """Find, check and split recordings, and write the manifest if any are usable.

    Sound and motion of a pair begin together, up to `shift`; if their energy and arm speed show
    another shift, a warning names it. Tables beside a recording (STEM.events.csv, STEM.path.csv;
    see `formats.tables`) become its conditions. A problem with one recording is reported with its
    file, and one with an error is left out; the others go on.

    Args:
        folders: folders with speech and motion of equal names, see `pairing.pair`.
        out: path of the manifest; None writes nothing.
        options: the fields of `PrepareOptions`, such as `unpaired` and `holdout`.

    Raises:
        CorpusError: a folder does not exist, or an option is out of range.
        ConfigError: an option of `read` that applies to none of the motion files.
        UnknownOptionError: a keyword that is not an option.

    Examples:
        Of a single recording of 3 s, the last fifth is held out:

        >>> import soundfile
        >>> soundfile.write(folder / "a.wav", np.sin(np.arange(48000) * 0.1), 16000)
        >>> gk.load("demo").generate(seconds=3).save(folder / "a.bvh")
        >>> report = gk.prepare(folder, folder / "corpus.jsonl")
        >>> [(item.split, item.duration) for item in report.manifest]
        [('train', 2.4), ('test', 0.6)]
    """
    chosen = build_options(PrepareOptions, options, "prepare")
    pattern = _style_pattern(chosen.style_pattern)
    listing = _published(chosen, _several(folders))
    recordings, left_over, problems = _find([] if listing else _several(folders), chosen)
    if listing:
        recordings = listing.recordings + recordings
        left_over, problems = left_over + listing.left_over, problems + listing.problems
    recordings, examined = _in_time(recordings, chosen)
    recordings, unlabelled = _labelled(recordings, chosen.style, pattern)
    recordings, odd = _of_one_skeleton(recordings)
    left_out = {problem.file for problem in odd}
    problems += examined + unlabelled
    problems = [p for p in problems if p.file not in left_out or p.severity == "error"]
    problems += odd + _corpus_notes(recordings, listing)
    recordings, items, cut = _split(recordings, chosen, listing.copies if listing else "")
    report = Report(Manifest(items), tuple(recordings), (*problems, *cut), tuple(left_over))
    if out is not None and items:
        report.manifest.save(out)
    return report


def _split(
    recordings: list[Recording], options: PrepareOptions, copies: str
) -> tuple[list[Recording], list[Item], list[Problem]]:
    """Return the recordings with their takes, the items made of them, and problems."""
    named, problems = name_takes(recordings, options.take_pattern, options.take_table)
    speakers = _names(options.hold_out_speakers)
    pattern, file = options.hold_out_pattern, options.hold_out_list
    named = splits.hold_out(named, pattern, file, speakers, copies)
    intervals = splits.as_intervals(options.hold_out_seconds)
    items, cut = splits.split_items(named, options.holdout, intervals, options.seed)
    beside = neighbours(items)
    return named, items, problems + cut + ([Problem("note", None, beside)] if beside else [])


def _in_time(
    recordings: list[Recording], options: PrepareOptions
) -> tuple[list[Recording], list[Problem]]:
    """Examine the recordings, with the shift between their sound and motion taken back."""
    taken_back = 0.0 if isinstance(options.shift, str) else options.shift
    named = [recording.shifted(taken_back) for recording in recordings]
    examined, problems = _examined(named, options)
    if options.shift == "auto":
        lags = corrections([recording.correlation for recording in examined])
        shifts = {r.id: lag for r, lag in zip(examined, lags, strict=True) if lag}
        if shifts:
            named = [recording.shifted(shifts.get(recording.id, 0.0)) for recording in named]
            examined, problems = _examined(named, options)
        for recording in examined:
            if recording.id in shifts:
                text = f"shifted: the motion came {shifts[recording.id]:+.2f} s after the sound"
                problems.append(Problem("note", recording.motion, text))
    known = [(r.file, r.correlation) for r in examined if r.correlation is not None]
    return examined, problems + shift_problems(known, taken_back)


def _examined(
    recordings: list[Recording], options: PrepareOptions
) -> tuple[list[Recording], list[Problem]]:
    """Load and check the recordings; return the usable ones and all problems."""
    read = options.read or {}
    refuse_unused_options(read, [r.motion for r in recordings if r.motion])
    trim = set(_names(options.trim))
    known = [recording.id for recording in recordings]
    if unknown := sorted(trim - set(known)):
        hint = did_you_mean(unknown[0], known, "; did you mean {}?")
        raise CorpusError(f"trim: no recording {unknown[0]!r}{hint}")
    tasks = []
    for recording in recordings:
        reading = applicable_read_options(recording.motion, read) if recording.motion else {}
        if options.parts and "height" in reading:  # the height depends on the parts
            reading["parts"] = dict(options.parts)
        tasks.append(replace(recording, channel=options.channel, reading=reading))
    check = partial(examine, tolerance=options.tolerance, parts=options.parts, trim=trim)
    results = examine_each(tasks, check, options.workers, options.progress)
    problems = [problem for _, of_one in results for problem in of_one]
    return [recording for recording, _ in results if recording is not None], problems


def _names(given: str | Sequence[str]) -> list[str]:
    """Return names from a list, or from text with commas."""
    names = given.split(",") if isinstance(given, str) else given
    return [name.strip() for name in names if name.strip()]


def _published(options: PrepareOptions, folders: list[Any]) -> Listing | None:
    """Read the folder of a public corpus; None without a layout."""
    if options.layout is None:
        return None
    if len(folders) != 1:
        raise CorpusError(f"layout {options.layout}: {len(folders)} folders; give the corpus's one")
    listing = read_layout(options.layout, Path(folders[0]))
    if options.speaker:
        listing.recordings = [replace(r, speaker=options.speaker) for r in listing.recordings]
    return listing


def _several(folders: Folders) -> list[str | os.PathLike[str]]:
    return [folders] if isinstance(folders, str | os.PathLike) else list(folders)


def _find(
    folders: list[Any], options: PrepareOptions
) -> tuple[list[Recording], list[Path], list[Problem]]:
    """Return the recordings to check, files left over, and problems."""
    unpaired, unpaired_motion = _several(options.unpaired), _several(options.unpaired_motion)
    problems: list[Problem] = []
    seen: set[Path] = set()

    def files_in(folder: Any) -> list[MediaFile]:
        files, trouble = scan(folder)
        if not (files or trouble or unread(folder)):
            sounds, motions = ", ".join(SPEECH_SUFFIXES), ", ".join(MOTION_SUFFIXES)
            text = f"neither sound ({sounds}) nor motion ({motions}) in it"
            trouble.append(Problem("warning", Path(folder), text))
        problems.extend(problem for problem in trouble if problem not in problems)
        return files

    def unseen(files: Iterable[MediaFile]) -> list[MediaFile]:
        new = {absolute(file.path): file for file in files}
        new = {path: file for path, file in new.items() if path not in seen}
        seen.update(new)
        return list(new.values())

    pairing = pair([unseen(files_in(folder)) for folder in folders])
    problems += pairing.problems
    # A folder may be given both ways: its files left after pairing are then used alone.
    seen -= {absolute(file.path) for file in [*pairing.speech, *pairing.motion]}
    speech = unseen(f for folder in unpaired for f in files_in(folder) if f.is_speech)
    motion = unseen(f for folder in unpaired_motion for f in files_in(folder) if not f.is_speech)
    ids = iter(recording_ids([*(sound for sound, _ in pairing.pairs), *speech, *motion]))
    recordings = [
        Recording(next(ids), sound.path, moves.path, speaker=options.speaker)
        for sound, moves in pairing.pairs
    ]
    recordings += [Recording(next(ids), audio=file.path) for file in speech]
    recordings += [Recording(next(ids), motion=file.path) for file in motion]
    used = {absolute(file.path) for file in [*speech, *motion]}
    alone = [file.path for file in [*pairing.speech, *pairing.motion]]
    left_over = [path for path in alone if absolute(path) not in used]
    every = [*folders, *unpaired, *unpaired_motion]
    sounds = {recording.audio.with_suffix("") for recording in recordings if recording.audio}
    motions = {recording.motion.with_suffix("") for recording in recordings if recording.motion}
    for path in {absolute(path): path for folder in every for path in unread(folder)}.values():
        is_sound = path.suffix.lower() in OTHER_SPEECH_SUFFIXES
        if path.with_suffix("") in (sounds if is_sound else motions):
            text = f"{path.suffix.lower()[1:]} is not read; a file of the same name is"
            problems.append(Problem("note", path, text))
        else:
            left_over.append(path)
    return recordings, left_over, problems


def _style_pattern(pattern: str | None) -> re.Pattern[str] | None:
    """Return the compiled pattern of styles and speakers.

    Raises:
        CorpusError: not a regular expression, or one without these groups.
    """
    if pattern is None:
        return None
    expression = compiled("style pattern", pattern)
    if not {"style", "speaker"} & set(expression.groupindex):
        raise CorpusError(f"style pattern {pattern}: no group style or speaker: (?P<style>…)")
    return expression


def _labelled(
    recordings: list[Recording], style_of_all: str | None, pattern: re.Pattern[str] | None
) -> tuple[list[Recording], list[Problem]]:
    """Return the recordings with styles and speakers, by the pattern where it matches."""
    labelled, problems = [], []
    for recording in recordings:
        match = pattern.search(recording.id) if pattern else None
        groups = match.groupdict() if match else {}
        style = groups.get("style") or style_of_all or recording.style
        speaker = groups.get("speaker") or recording.speaker
        labelled.append(replace(recording, style=style, speaker=speaker))
        if pattern and not match:
            text = f"name does not match style pattern {pattern.pattern}"
            problems.append(Problem("note", recording.file, text))
    if pattern and recordings and len(problems) == len(recordings):
        held = f"{counted(len(recordings), 'recording')}, such as {recordings[0].id}"
        text = f"style pattern {pattern.pattern} matches none of {held}"
        problems.append(Problem("warning", None, text))
    return labelled, problems


def _of_one_skeleton(recordings: list[Recording]) -> tuple[list[Recording], list[Problem]]:
    """Drop recordings whose joints differ from those of most others."""
    skeletons = [recording.skeleton for recording in recordings if recording.skeleton is not None]
    usual = checks.usual_skeleton(skeletons) if skeletons else None
    kept, problems = [], []
    for recording in recordings:
        rig = recording.skeleton
        if rig and usual and (difference := checks.first_difference(rig, usual)):
            text = f"another skeleton than most: {difference}; prepare each rig on its own"
            problems.append(Problem("error", recording.motion, text))
        else:
            kept.append(recording)
    return kept, problems


def _corpus_notes(recordings: list[Recording], listing: Listing | None) -> list[Problem]:
    """Return problems of the corpus as a whole, and other frame rates than the published one."""
    notes = _missing_parts(recordings) + _differing_sizes(recordings)
    moving = [(r.fps, r.motion) for r in recordings if r.fps is not None]
    by_fps = Counter(f"{fps:.6g}" for fps, _ in moving)
    if len(by_fps) > 1:
        by_rate = sorted(by_fps.items(), key=lambda entry: float(entry[0]))
        rates = ", ".join(f"{fps} ({count})" for fps, count in by_rate)
        text = f"frame rates differ: {rates}; training resamples them to one"
        notes.append(Problem("note", None, text))
    usual = listing.fps if listing else math.nan
    return notes + [
        Problem("note", motion, f"{fps:.6g} fps; published at {usual:g} fps")
        for fps, motion in moving
        if abs(fps - usual) > 0.01 * usual
    ]


def _missing_parts(recordings: list[Recording]) -> list[Problem]:
    """Note once that body parts cannot be identified or are not there, and the consequences."""
    first = next((r for r in recordings if r.skeleton is not None), None)
    if first is None or first.skeleton is None:
        return []
    text = "the rig has no legs: foot contacts, foot locking and foot metrics are left out"
    try:
        if find_parts(first.skeleton).legs:
            return []
    except MotionError as error:
        text = f"{error}. Without them training leaves out what needs these parts"
        if any(recording.audio and recording.motion for recording in recordings):
            text += ", and in multires speech moves all joints"
    return [Problem("note", first.motion, text)]


def _differing_sizes(recordings: list[Recording]) -> list[Problem]:
    """Warn if bodies differ so much in height that the unit of a file is probably wrong."""
    heights = {r.file: r.height for r in recordings if r.height is not None}
    ends = min(heights.values(), default=1.0), max(heights.values(), default=1.0)
    ratio = ends[1] / ends[0]
    if ratio <= MAX_SIZE_RATIO:
        return []
    usual = statistics.median_low(heights.values())
    far = {file: max(h / usual, usual / h) > MAX_SIZE_RATIO for file, h in heights.items()}
    odd = [file for file in heights if far[file]]
    odd = odd or [min(heights, key=heights.__getitem__), max(heights, key=heights.__getitem__)]
    shown = listed([f"{file} ({heights[file]:.3g} m)" for file in odd], 3)
    differ = f"body heights differ by a factor of {ratio:.3g}; the usual is {usual:.3g} m"
    how = "is a unit wrong? prepare these files on their own with --in-unit, or all with --height"
    return [Problem("warning", None, f"{differ}, but not of {shown}; {how}")]
