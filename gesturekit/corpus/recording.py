"""Recordings, and their examination: usable interval and problems, in one process or several."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from audio_features import AudioFeaturesError, Wave, load_words
from audio_features.words import words_beside
from gesturekit.corpus import checks
from gesturekit.corpus.alignment import Correlation, correlate
from gesturekit.corpus.checks import Problem
from gesturekit.corpus.manifest import CONDITIONS, muted
from gesturekit.errors import FormatError, GestureKitError, MotionError
from gesturekit.formats.conventions import plausibility_warnings
from gesturekit.formats.sources import load_with_warnings
from gesturekit.formats.tables import load_events, load_root_path, load_semantics
from gesturekit.motion import Motion, Skeleton, defects
from gesturekit.motion.parts.body_size import body_height
from gesturekit.wording import counted, listed
from gesturekit.workers import Failure, in_processes

MIN_DURATION = 0.5
"""Least length of a recording, seconds."""

_TIMES_SHOWN = 5


@dataclass(frozen=True)
class Recording:
    """The files of a recording, their used interval, and their properties.

    `start` and `stop` are seconds of the motion, without one of the sound; with motion, `start` is
    the time of a frame. `examine` fills in these and the properties of the files.

    Attributes:
        take: recording session; None if it is not known to be that of other recordings.
        original: id of the first recording with the same sound or motion; its own without copies.
        split: published split, or None.
        limits: interval to use, in the seconds of `start`.
        audio_offset: time in the sound file at which the motion file begins.
        audible: intervals of the sound file in which the recorded person speaks; () for all.
        correlation: of arm speed and speech energy; None if it says nothing.
    """

    id: str
    audio: Path | None = None
    motion: Path | None = None
    channel: int | None = None
    start: float = 0.0
    stop: float = 0.0
    sample_rate: int | None = None
    fps: float | None = None
    skeleton: Skeleton | None = None
    speaker: str | None = None
    style: str | None = None
    take: str | None = None
    original: str | None = None
    conditions: Mapping[str, Path] = field(default_factory=dict)
    reading: Mapping[str, Any] = field(default_factory=dict)
    split: str | None = None
    limits: tuple[float, float] = (0.0, math.inf)
    audio_offset: float = 0.0
    audible: tuple[tuple[float, float], ...] = ()
    correlation: Correlation | None = None

    def shifted(self, seconds: float) -> Recording:
        """Return the recording of which the motion comes so much later than the sound."""
        if self.audio is None or self.motion is None:
            return self
        return replace(self, audio_offset=self.audio_offset - seconds)

    @property
    def file(self) -> Path:
        """The file to report problems with."""
        file = self.motion or self.audio
        assert file is not None, self.id
        return file

    @cached_property
    def height(self) -> float | None:
        """Height of the body from sole to crown, metres; None without motion or bones."""
        try:
            return None if self.skeleton is None else body_height(self.skeleton)
        except MotionError:
            return None


Examined = tuple[Recording | None, list[Problem]]
"""A recording with its properties, None after an error; and its problems."""


def examine(
    recording: Recording,
    tolerance: float,
    parts: Mapping[str, str] | None = None,
    trim: Collection[str] = (),
) -> Examined:
    """Load a recording and check it.

    Args:
        recording: the recording with its files.
        tolerance: largest difference in length of sound and motion, seconds.
        parts: body parts assigned by hand, where they cannot be identified.
        trim: ids of recordings of which sound and motion may differ by any length.

    Returns:
        the recording with its used interval and properties, or None after an error; and the
        problems.
    """
    problems: list[Problem] = []
    wave, motion = _loaded(recording, parts or {}, problems)
    recording = replace(recording, conditions=_conditions(recording, problems))
    if any(problem.severity == "error" for problem in problems):
        return None, problems
    start, stop = 0.0, math.inf
    if wave is not None:
        stop = wave.duration - recording.audio_offset
        recording = replace(recording, sample_rate=wave.sample_rate)
        faults = [*wave.repairs, *wave.faults()]
        problems += [Problem("warning", recording.audio, fault) for fault in faults]
    if motion is not None:
        recording = replace(recording, fps=motion.fps, skeleton=motion.skeleton)
        if "unit" in motion.info.get("guessed", ()) and "height" not in recording.reading:
            text = f"read in {motion.info['unit']}, a guess; --in-unit or --height settles it"
            problems.append(Problem("note", recording.motion, text))
        faults = plausibility_warnings(motion, recording.reading)
        problems += [Problem("warning", recording.motion, fault) for fault in faults]
        if wave is not None and recording.limits == (0.0, math.inf):
            sounds = (wave.duration, wave.duration - recording.audio_offset)
            sound = min(sounds, key=lambda seconds: abs(seconds - motion.duration))
            most = math.inf if recording.id in trim else tolerance
            problems += (apart := _length_problems(sound, motion, recording, most))
            if any(problem.severity == "error" for problem in apart):
                return None, problems
        stop = min(stop, motion.duration)
    if motion is not None and stop >= MIN_DURATION:
        first, end = _check_motion(motion, recording.file, problems)
        start, stop = first / motion.fps, min(stop, end / motion.fps)
    start, stop = _limited(recording, start, stop)
    if stop - start < MIN_DURATION:
        usable = f"{max(stop - start, 0.0):.2f} s can be used"
        text = f"too short: {usable}; at least {MIN_DURATION:g} s are needed"
        return None, [*problems, Problem("error", recording.file, text)]
    correlation = None
    if wave is not None and motion is not None:
        correlation = _correlation(recording, wave, motion, (start, stop))
    return replace(recording, start=start, stop=stop, correlation=correlation), problems


def _correlation(
    recording: Recording, wave: Wave, motion: Motion, used: tuple[float, float]
) -> Correlation | None:
    """Correlate sound and motion over the used interval, in seconds of the motion."""
    first, stop = (round(seconds * motion.fps) for seconds in used)
    if recording.audible:
        wave = muted(wave, recording.audible)
    sound = wave.slice(max(0.0, used[0] + recording.audio_offset), used[1] - used[0])
    return correlate(motion[first:stop], sound)


def _limited(recording: Recording, start: float, stop: float) -> tuple[float, float]:
    """Return the part of an interval that lies within the limits, from the time of a frame."""
    first = max(start, recording.limits[0])
    if recording.audio is not None:
        first = max(first, -recording.audio_offset)
    if recording.fps is not None:
        first = math.ceil(first * recording.fps - 1e-6) / recording.fps
    return first, min(stop, recording.limits[1])


def _loaded(
    recording: Recording, parts: Mapping[str, str], problems: list[Problem]
) -> tuple[Wave | None, Motion | None]:
    wave = motion = None
    if recording.audio is not None:
        try:
            wave = Wave.load(recording.audio, channel=recording.channel)
        except AudioFeaturesError as error:
            problems.append(Problem("error", recording.audio, str(error)))
    if recording.motion is not None:
        try:
            motion, warnings = load_with_warnings(recording.motion, recording.reading, parts)
            texts = [text.removeprefix(f"{recording.motion}: ") for text in warnings]
            problems += [Problem("warning", recording.motion, text) for text in texts]
        except GestureKitError as error:
            problems.append(Problem("error", recording.motion, str(error)))
    return wave, motion


def _conditions(recording: Recording, problems: list[Problem]) -> dict[str, Path]:
    """Return the side files of the recording: given ones, STEM.events.csv, STEM.path.csv, words.

    Broken words or semantics are a warning, and left out; other broken tables are an error.
    """
    files = [file for file in (recording.motion, recording.audio) if file is not None]
    conditions = dict(recording.conditions)
    for file in reversed(files):
        if "words" not in conditions and (words := words_beside(file)):
            conditions["words"] = words
        beside = {name: file.with_suffix(f".{name}.csv") for name in CONDITIONS}
        conditions |= {name: table for name, table in beside.items() if table.exists()}
    for name, table in list(conditions.items()):
        read, severity = _TABLES.get(name, (None, ""))
        try:
            if read is not None:
                read(table)
        except (FormatError, AudioFeaturesError) as error:
            problems.append(Problem(severity, table, str(error)))
            del conditions[name]
    return conditions


_TABLES: dict[str, tuple[Callable[[Path], Any], str]] = {
    "events": (load_events, "error"),
    "path": (load_root_path, "error"),
    "words": (load_words, "warning"),
    "semantics": (load_semantics, "warning"),
}
"""Readers of side files, and the severity of a problem with them."""


def _length_problems(
    sound: float, motion: Motion, recording: Recording, tolerance: float
) -> list[Problem]:
    """Return the problem of a sound of so many seconds that lasts longer or shorter."""
    apart = abs(sound - motion.duration)
    lengths = f"{sound:.2f} s of sound and {motion.duration:.2f} s of motion"
    if apart > tolerance:
        differ = f"{lengths} differ by {apart:.2f} s, more than {tolerance:g} s"
        text = f"{differ}: cut both alike, or use what they share with --trim {recording.id}"
        return [Problem("error", recording.motion, text)]
    text = f"{lengths}: trimmed to the shorter"
    return [Problem("warning", recording.motion, text)] if apart > 1.0 / motion.fps else []


def _check_motion(motion: Motion, file: Path, problems: list[Problem]) -> tuple[int, int]:
    """Return the frames [first, stop) to use; add their defects to `problems`."""

    def warn(text: str) -> None:
        problems.append(Problem("warning", file, text))

    lead, trail = checks.reference_pose(motion)
    if lead == motion.n_frames:
        text = "holds its T-pose or rest pose throughout, so that nothing is trimmed"
        warn(f"{text}: is it the right file?")
        lead = trail = 0
    for count, where in ((lead, "start"), (trail, "end")):
        if count:
            what = f"{counted(count, 'frame')} ({count / motion.fps:.2f} s) of T-pose or rest pose"
            warn(f"{what} at the {where} trimmed")
    first, stop = lead, motion.n_frames - trail
    if stop - first < 2:
        return first, stop
    used = motion[first:stop]

    def at(*frames: int) -> str:
        return " to ".join(f"{(first + frame) / motion.fps:.2f} s" for frame in frames)

    runs = defects.frozen_runs(used)
    frozen = sum(end - begin for begin, end in runs)
    if frozen == used.n_frames:
        warn(f"frozen: all {frozen} frames hold one and the same pose: is it the right file?")
    elif runs:
        times = listed([at(*run) for run in runs], _TIMES_SHOWN)
        warn(f"frozen (no joint moves at all) from {times}")
    jumps = defects.find_jumps(used)
    if jumps is not None:
        times = listed([at(frame) for frame in jumps.frames], _TIMES_SHOWN)
        most = f"{jumps.joint!r} with {defects.format_speed(jumps.speed)}"
        text = f"{len(jumps.frames)} of {used.n_frames} frames jump "
        text += f"({defects.speed_limit(jumps.limit)}) at {times}; fastest is {most}"
        if len(jumps.frames) > checks.MAX_JUMP_SHARE * used.n_frames:
            text += ": are its frame rate and its unit right (--in-fps, --in-unit, --height)?"
        warn(text)
    pops = defects.find_pops(used, jumps)
    if pops is not None:
        how = f"{pops.joint!r}" + (f" by {np.degrees(pops.angle):.0f}°" if pops.angle else "")
        times = listed([at(frame) for frame in pops.frames], _TIMES_SHOWN)
        warn(f"pops (a joint is elsewhere for one frame) at {times}; most of all {how}")
    jitter = defects.jitter_share(used)
    if jitter > checks.MAX_JITTER_SHARE:
        warn(f"jitters in {jitter:.0%} of its frames: joints go to and fro from frame to frame")
    return first, stop


def examine_each(
    recordings: list[Recording],
    check: Callable[[Recording], Examined],
    workers: int,
    progress: Callable[[list[Any]], Iterable[Any]],
) -> list[Examined]:
    """Examine recordings, and return the results in their order.

    Args:
        recordings: the recordings.
        check: `examine`, with its options.
        workers: number of processes; 1 works in this one.
        progress: wraps the list of recordings, as tqdm does.
    """
    if workers == 1:
        return [check(recording) for recording in progress(recordings)]
    steps = iter(progress(recordings))
    next(steps, None)
    results: dict[int, Examined] = {}
    for recording, result in in_processes(check, recordings, workers):
        if isinstance(result, Failure):
            result = None, [Problem("error", recording.file, str(result))]
        results[id(recording)] = result
        next(steps, None)
    return [results[id(recording)] for recording in recordings]
