"""Motorica dance, 100STYLE and Trinity: corpora whose file names say almost everything."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path

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
        audio = sounds.pop(motion.stem, None)
        if audio is None:
            silent.append(f"{motion.stem}.wav")
        listing.recordings.append(
            Recording(
                motion.stem,
                audio=audio,
                motion=motion,
                speaker=match["dancer"],
                style=match["style"],
            )
        )
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
    absent, uncut, listed_files = [], [], set()
    ends = [f"{gait.lower()}_{end}" for gait in _GAITS for end in ("start", "stop")]
    for where, row in rows(root / "Frame_Cuts.csv", ("style_name", *ends), others=True):
        style = row["style_name"]
        for gait in _GAITS:
            file = root / style / f"{style}_{gait}.bvh"
            cut = _cut(where, row, gait)
            listed_files.add(file)
            if cut is None and file.is_file():
                uncut.append(file.name)
            elif cut is not None and not file.is_file():
                absent.append(file.name)
            elif cut is not None:
                listing.recordings.append(
                    Recording(f"{style}/{file.stem}", motion=file, style=style, limits=cut)
                )
    listing.missing("bvh file", absent, root / "Frame_Cuts.csv", "error")
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
        raise CorpusError(
            f"{folder}: NaturalTalking files are Trinity's raw form, whose sound and motion do not "
            "begin together; get the GENEA 2020 form (source/bvh, source/audio, Recording_001 …)"
        )
    root = root_with(folder, ["source", "bvh"], "Trinity")
    root = root / "source" if (root / "source").is_dir() else root
    listing = Listing(fps=60.0)
    absent = []
    audio_of = {file.stem: file for file in sorted((root / "audio").glob("*.wav"))}
    for motion in sorted((root / "bvh").glob("*.bvh")):
        if _TRINITY.fullmatch(motion.stem) is None:
            listing.left_over.append(motion)
            continue
        audio = audio_of.pop(motion.stem, None)
        if audio is None:
            absent.append(f"{motion.stem}.wav")
            continue
        split = "test" if motion.stem == _TRINITY_TEST else "train"
        listing.recordings.append(
            Recording(motion.stem, audio=audio, motion=motion, speaker="trinity", split=split)
        )
    _check_found(listing, root, "Trinity", "bvh/Recording_001.bvh")
    listing.missing("wav file", absent, root / "audio", "error")
    listing.left_over += audio_of.values()
    return listing


def _check_found(listing: Listing, folder: Path, layout: str, example: str) -> None:
    if not listing.recordings:
        raise CorpusError(f"{folder}: no recording of {layout}; its files are named {example}")
