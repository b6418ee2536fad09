"""ZeroEGGS (Ghorbani et al. 2023): one speaker in 19 styles, as published or cleaned."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from gesturekit.corpus.checks import Problem
from gesturekit.corpus.layouts.listing import Listing, root_with, rows
from gesturekit.corpus.recording import Recording
from gesturekit.errors import CorpusError

_SPEAKER = "zeggs"
_INFO = "info.csv"
_NAME = re.compile(
    r"(?P<take>\d+_(?P<style>[A-Za-z]+)_\d+)(?P<mirror>_mirror)?(?P<ratio>_x_\d+_\d+)?"
)
_CLOCK = re.compile(r"(\d+):(\d+):(\d+):(\d+)")
_MINUTES = re.compile(r"(\d+):(\d+)[.:](\d+)")
_SOUND_FPS, _MOTION_FPS = 30, 60  # of the time codes in info.csv
_TIMES = ("audio_start_time", "anim_start_time", "acting_start_time", "acting_end_time")


def read_zeggs(folder: Path) -> Listing:
    """Read the folder of ZeroEGGS, or of its files in `clean` or `original` alone.

    `clean` is used where it exists: sound and motion begin together and other voices are silent.
    Otherwise info.csv gives the offset of `original` and the part in which the actress acts, and
    the table beside each sound (#, Start, End) the intervals in which she speaks; the rest is
    muted. Validation takes of info.csv are "valid", there is no test split. Mirrored copies and
    changed tempos are left out.

    Raises:
        CorpusError: a table of the corpus is missing where it is needed, or invalid.
    """
    root = _root(folder)
    listing = Listing(fps=60.0)
    inside = next((root / n for n in ("clean", "original") if (root / n).is_dir()), root)
    info = _info(root, inside)
    files = {file.stem: file for file in sorted(inside.glob("*.bvh"))}
    original = not any("_x_" in stem for stem in files)
    copies, no_sound, done = [], [], set()
    for stem, motion in files.items():
        match = _NAME.fullmatch(stem)
        if match is None:
            listing.left_over.append(motion)
            continue
        done.add(match["take"])
        if match["mirror"] or match["ratio"] not in (None, "_x_1_0"):
            copies.append(motion.name)
            continue
        audio = motion.with_suffix(".wav")
        if not audio.is_file():
            no_sound.append(audio.name)
            continue
        row = info.get(match["take"])
        recording = Recording(
            stem, audio=audio, motion=motion, speaker=_SPEAKER, style=match["style"]
        )
        if row is not None:
            split = "valid" if row[1]["validation"].upper() == "TRUE" else "train"
            recording = replace(recording, style=row[1]["style"], split=split)
        try:
            listing.recordings.append(
                _trimmed(recording, row, root, listing) if original else recording
            )
        except CorpusError as error:
            listing.problems.append(Problem("error", motion, str(error)))
    listing.note("mirrored or of another tempo, left out", copies, inside)
    listing.missing("wav file", no_sound, inside, "error")
    if info:
        listing.missing("take of info.csv", info.keys() - done, root / _INFO, "error")
    else:
        text = "without info.csv there is no published split: recordings are held out as usual"
        listing.problems.append(Problem("note", root, text))
    listing.left_over += _unused(inside, copies, listing)
    return listing


def _unused(inside: Path, copies: list[str], listing: Listing) -> list[Path]:
    """Return the sounds that belong to no recording, copy or failed motion."""
    used = {recording.audio for recording in listing.recordings}
    used |= {(inside / name).with_suffix(".wav") for name in copies}
    failed = {problem.file for problem in listing.problems}
    return [
        file
        for file in sorted(inside.glob("*.wav"))
        if file not in used and file.with_suffix(".bvh") not in failed
    ]


def _root(folder: Path) -> Path:
    if folder.is_dir() and any(_NAME.fullmatch(file.stem) for file in folder.glob("*.bvh")):
        return folder
    return root_with(folder, ("clean", "original"), "ZeroEGGS")


def _info(root: Path, inside: Path) -> dict[str, tuple[str, Mapping[str, str]]]:
    """Return (place, row) of info.csv by take, without mirrored ones; {} without the file."""
    file = next((at / _INFO for at in (root, inside, root.parent) if (at / _INFO).is_file()), None)
    if file is None:
        return {}
    row_of = {}
    for where, row in rows(file, ("style", "anim_bvh", "validation", *_TIMES), others=True):
        stem = row["anim_bvh"].removesuffix(".bvh")
        if row["validation"].upper() not in ("TRUE", "FALSE"):
            raise CorpusError(f"{where}: validation is {row['validation']!r}; expected TRUE, FALSE")
        if not stem.endswith("_mirror"):
            row_of[stem] = where, row
    return row_of


def _trimmed(
    recording: Recording,
    row: tuple[str, Mapping[str, str]] | None,
    root: Path,
    listing: Listing,
) -> Recording:
    """Add offset, limits and audible intervals of an original recording.

    Raises:
        CorpusError: they are missing or invalid.
    """
    if row is None:
        raise CorpusError(f"no row in {root / _INFO} gives the offset of sound to motion")
    where, cells = row
    rates = dict(zip(_TIMES, (_SOUND_FPS, _MOTION_FPS, _MOTION_FPS, _MOTION_FPS), strict=True))
    sound, motion, first, last = (
        _time_code(where, name, cells[name], rate) for name, rate in rates.items()
    )
    if not motion - 1e-6 <= first < last:
        raise CorpusError(f"{where}: acting from {first - motion:.2f} to {last - motion:.2f} s")
    assert recording.audio is not None
    table, audible = recording.audio.with_suffix(".csv"), ()
    if table.is_file():
        audible = _turns(table)
    else:
        text = f"without {table.name} other voices in it cannot be muted"
        listing.problems.append(Problem("warning", recording.audio, text))
    return replace(
        recording,
        limits=(first - motion, last - motion),
        audio_offset=motion - sound,
        audible=audible,
    )


def _time_code(where: str, name: str, text: str, fps: int) -> float:
    match = _CLOCK.fullmatch(text.strip())
    if match is None:
        raise CorpusError(f"{where}: {name} is {text[:40]!r}; expected HH:MM:SS:FRAME")
    hours, minutes, seconds, frames = map(int, match.groups())
    return 3600.0 * hours + 60.0 * minutes + seconds + frames / fps


def _turns(table: Path) -> tuple[tuple[float, float], ...]:
    """Return the intervals whose mark holds an R: those in which the actress speaks."""
    turns = []
    for where, row in rows(table, ("#", "start", "end"), others=True):
        if "R" not in row["#"]:
            continue
        times = []
        for name in ("start", "end"):
            match = _MINUTES.fullmatch(row[name])
            if match is None:
                raise CorpusError(f"{where}: {name} is {row[name][:40]!r}; expected MM:SS.mmm")
            minutes, seconds, fraction = match.groups()
            times.append(60.0 * int(minutes) + float(f"{seconds}.{fraction}"))
        if not times[0] <= times[1] < math.inf:
            raise CorpusError(f"{where}: ends at {times[1]} s, before {times[0]} s")
        turns.append((times[0], times[1]))
    return tuple(turns)
