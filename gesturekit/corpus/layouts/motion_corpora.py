"""Motorica dance, 100STYLE, Trinity and ZeroEGGS: BVH files of few people."""

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

_DANCE = re.compile(r".+_(?P<style>g[A-Za-z]+)_s[^_]+_[^_]+_(?P<dancer>d\d+)_.+")
_GAITS = ("BR", "BW", "FR", "FW", "ID", "SR", "SW", "TR1", "TR2", "TR3")
_STYLE_FPS = 60
_TRINITY = re.compile(r"Recording_\d+")
_TRINITY_TEST = "Recording_008"


def read_motorica(folder: Path) -> Listing:
    """Read Motorica's dances: style is the genre (gLO …), speaker the dancer (d02 …).

    Sounds of some dances are not published; these dances are motion alone. The corpus has no split;
    the released code of Alexanderson et al. 2023 lists its test files, for `hold_out_list`. They
    are shifted copies of a dance, NAME_00 and NAME_01, which stand for NAME.

    Raises:
        CorpusError: no file has a name of this corpus.
    """
    if not folder.is_dir():
        root_with(folder, (), "Motorica")
    listing = Listing(fps=120.0, copies=r"_\d\d(_mirrored)?")
    sounds = {file.stem: file for file in sorted(folder.rglob("*.wav"))}
    silent = []
    for motion in sorted(folder.rglob("*.bvh")):
        match = _DANCE.fullmatch(motion.stem)
        if match is None:
            listing.left_over.append(motion)
            continue
        files, dance = {"motion": motion}, {"speaker": match["dancer"], "style": match["style"]}
        if motion.stem in sounds:
            files["audio"] = sounds.pop(motion.stem)
        else:
            silent.append(f"{motion.stem}.wav")
        listing.add(motion.stem, files, {}, **dance)
    _check_found(listing, folder, "Motorica", "kthstreet_gLO_sFM_cAll_d02_mLO_ch01_NAME.bvh")
    listing.missing("wav file (motion alone)", silent, folder, "note")
    listing.left_over += sounds.values()
    return listing


def read_100style(folder: Path) -> Listing:
    """Read 100STYLE: motion alone, cut as Frame_Cuts.csv says. There is no published split.

    Raises:
        CorpusError: Frame_Cuts.csv is missing or invalid.
    """
    root = root_with(folder, ["Frame_Cuts.csv"], "100STYLE")
    listing = Listing(fps=60.0)
    cuts, uncut, listed_files = root / "Frame_Cuts.csv", [], set()
    ends = [f"{gait.lower()}_{end}" for gait in _GAITS for end in ("start", "stop")]
    for where, row in rows(cuts, ("style_name", *ends), others=True):
        style = row["style_name"]
        for gait in _GAITS:
            file = root / style / f"{style}_{gait}.bvh"
            cut = _cut(where, row, gait)
            listed_files.add(file)
            if cut is None and file.is_file():
                uncut.append(file.name)
            elif cut is not None and not listing.lacks("bvh file", file, cuts):
                name = f"{style}/{file.stem}"
                listing.add(name, {"motion": file}, {}, style=style, limits=cut)
    listing.report_missing()
    listing.note("without a cut in Frame_Cuts.csv, left out", uncut, root)
    listing.left_over = [f for f in sorted(root.glob("*/*.bvh")) if f not in listed_files]
    return listing


def _cut(where: str, row: Mapping[str, str], gait: str) -> tuple[float, float] | None:
    """Return the seconds to use of a gait; None where the cells are empty."""
    cells = [row[f"{gait.lower()}_{end}"] for end in ("start", "stop")]
    if all(cell.upper() in ("", "N/A", "NAN") for cell in cells):
        return None
    try:
        start, stop = (float(cell) for cell in cells)
    except ValueError:
        start = stop = math.nan
    if not 0 <= start < stop:
        raise CorpusError(f"{where}: {gait}_START, {gait}_STOP are {cells}; expected two frames")
    return start / _STYLE_FPS, stop / _STYLE_FPS


def read_trinity(folder: Path) -> Listing:
    """Read Trinity Speech-Gesture as GENEA 2020 published it: source/{bvh,audio}/Recording_001.

    Recording_008 becomes the test split.

    Raises:
        CorpusError: another form of the corpus, or none.
    """
    if folder.is_dir() and any(folder.rglob("NaturalTalking_*.bvh")):
        raise CorpusError(f"{folder}: Trinity's raw form; get GENEA 2020's (source/bvh, audio)")
    root = root_with(folder, ["source", "bvh"], "Trinity")
    root = root / "source" if (root / "source").is_dir() else root
    listing, sounds = Listing(fps=60.0), set((root / "audio").glob("*.wav"))
    for motion in sorted((root / "bvh").glob("*.bvh")):
        audio = root / "audio" / f"{motion.stem}.wav"
        if _TRINITY.fullmatch(motion.stem) is None:
            listing.left_over.append(motion)
        elif not listing.lacks("wav file", audio, root / "audio"):
            split = "test" if motion.stem == _TRINITY_TEST else "train"
            files = {"audio": audio, "motion": motion}
            listing.add(motion.stem, files, {}, speaker="trinity", split=split)
    _check_found(listing, root, "Trinity", "bvh/Recording_001.bvh")
    listing.report_missing()
    listing.left_over += sorted(sounds - {recording.audio for recording in listing.recordings})
    return listing


def _check_found(listing: Listing, folder: Path, layout: str, example: str) -> None:
    if not listing.recordings:
        raise CorpusError(f"{folder}: no recording of {layout}; its files are named {example}")


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
    """Read ZeroEGGS (Ghorbani et al. 2023), or its files in `clean` or `original` alone.

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
    copies, done = [], set()
    for stem, motion in files.items():
        match = _NAME.fullmatch(stem)
        if match is None:
            listing.left_over.append(motion)
            continue
        done.add(match["take"])
        audio, row = motion.with_suffix(".wav"), info.get(match["take"])
        if match["mirror"] or match["ratio"] not in (None, "_x_1_0"):
            copies.append(motion.name)
        elif not listing.lacks("wav file", audio, inside):
            recording = Recording(stem, audio, motion, speaker=_SPEAKER, style=match["style"])
            if row is not None:
                split = "valid" if row[1]["validation"].upper() == "TRUE" else "train"
                recording = replace(recording, style=row[1]["style"], split=split)
            try:
                cut = _trimmed(recording, row, root, listing) if original else recording
                listing.recordings.append(cut)
            except CorpusError as error:
                listing.problems.append(Problem("error", motion, str(error)))
    listing.note("mirrored or of another tempo, left out", copies, inside)
    listing.report_missing()
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
    recording: Recording, row: tuple[str, Mapping[str, str]] | None, root: Path, listing: Listing
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
            minutes, seconds, fraction = match.groups() if match else ("nan", "0", "0")
            times.append(60.0 * float(minutes) + float(f"{seconds}.{fraction}"))
        if not times[0] <= times[1] < math.inf:
            held = [row[name][:40] for name in ("start", "end")]
            raise CorpusError(f"{where}: start and end are {held}; expected two times MM:SS.mmm")
        turns.append((times[0], times[1]))
    return tuple(turns)
