"""BEAT2, GENEA Challenge 2023 and Seamless Interaction: speech of many speakers, with motion.

BEAT2 (Liu et al. 2024) is SMPL-X motion, speech, words and semantic scores of 25 speakers; GENEA
Challenge 2023 dyads of Talking With Hands, of which the main agent is modelled; Seamless
Interaction (Agrawal et al. 2025) SMPL-H motion and speech of dyads.
"""

from __future__ import annotations

import re
from collections import defaultdict
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path

import numpy as np

from audio_features.archive import open_archive
from gesturekit.corpus.checks import Problem
from gesturekit.corpus.layouts.listing import Listing, root_with, rows
from gesturekit.corpus.recording import Recording
from gesturekit.errors import CorpusError, FormatError
from gesturekit.formats.amass import FPS

_BEAT_INDEX = "train_test_split.csv"
_BEAT_SPLITS = {"train": "train", "val": "valid", "test": "test"}
_BEAT_ID = re.compile(r"\d+_(?P<speaker>[^_/\\]+)_\d+_(?P<start>\d+)_\d+")
# Emotions by the number of the first sentence; the first 64 are neutral.
_EMOTIONS = (
    (65, 72, "happiness"),
    (73, 80, "anger"),
    (81, 86, "sadness"),
    (87, 94, "contempt"),
    (95, 102, "surprise"),
    (103, 110, "fear"),
    (111, 118, "disgust"),
)


def read_beat2(folder: Path) -> Listing:
    """Read a language's folder of BEAT2, such as beat_english_v2.0.0.

    The split of train_test_split.csv counts; its type `additional` is used by no split and left
    out. Style is the emotion, speaker the name in the id. Sound is often half a second longer than
    motion and is trimmed. Sounds of the test split need no motion to be rendered.

    Raises:
        CorpusError: train_test_split.csv is missing or invalid.
    """
    root = root_with(folder, [_BEAT_INDEX], "BEAT2")
    listing = Listing(fps=30.0)
    index = root / _BEAT_INDEX
    types = _types(index, listing)
    for name, split in types.items():
        match = _BEAT_ID.fullmatch(name)
        if match is None or split not in _BEAT_SPLITS:
            continue
        motion, audio = root / "smplxflame_30" / f"{name}.npz", root / "wave16k" / f"{name}.wav"
        words, semantics = root / "textgrid" / f"{name}.TextGrid", root / "sem" / f"{name}.txt"
        is_still = listing.lacks("npz file", motion, index)
        is_silent = listing.lacks("wav file", audio, index)
        listing.lacks("TextGrid", words, index, "note")
        listing.lacks("sem file", semantics, index, "note")
        if not is_silent and (split == "test" or not is_still):
            about = {"speaker": match["speaker"], "style": _emotion(int(match["start"]))}
            sides = {"words": words, "semantics": semantics}
            files = {"audio": audio, "motion": motion}
            listing.add(name, files, sides, split=_BEAT_SPLITS[split], **about)
    listing.report_missing()
    additional = [name for name, split in types.items() if split == "additional"]
    listing.note("of type additional, in no split and left out", additional, index)
    media = [*sorted(root.glob("smplxflame_30/*.npz")), *sorted(root.glob("wave16k/*.wav"))]
    listing.left_over = [file for file in media if file.stem not in types]
    return listing


def _types(index: Path, listing: Listing) -> dict[str, str]:
    types: dict[str, str] = {}
    for where, row in rows(index, ("id", "type")):
        if row["type"] not in (*_BEAT_SPLITS, "additional"):
            raise CorpusError(f"{where}: type is {row['type']!r}, not train, val, test, additional")
        if row["id"] in types:
            raise CorpusError(f"{where}: {row['id']!r} is listed twice; download the file again")
        if _BEAT_ID.fullmatch(row["id"]) is None:
            text = f"{where}: id {row['id'][:60]!r} is no SPEAKER_NAME_TYPE_START_END; left out"
            listing.problems.append(Problem("error", index, text))
        types[row["id"]] = row["type"]
    return types


def _emotion(sentence: int) -> str:
    return next((name for low, high, name in _EMOTIONS if low <= sentence <= high), "neutral")


_GENEA_SPLITS = {"trn": "train", "val": "valid", "tst": "test"}
_GENEA_COLUMNS = ("speaker", "fingers", "partner", "partner_fingers")


def read_genea2023(folder: Path) -> Listing:
    """Read the folder that holds trn and val, and tst where it was obtained.

    Items are the main agent's; conditions name the words and the interlocutor's sound, motion and
    words. The test split has no motion of the main agent. Masked speech is digital silence.
    Speakers are the numbers of metadata.csv; fingers are recorded where it says finger_incl.

    Raises:
        CorpusError: there is no such folder, or a metadata.csv is invalid.
    """
    root = root_with(folder, ("trn", "val"), "GENEA 2023")
    listing = Listing(fps=30.0)
    for name, split in _GENEA_SPLITS.items():
        if (root / name).is_dir():
            _read_genea_split(root / name, split, listing)
    listing.report_missing()
    absent = [name for name in ("trn", "val") if not (root / name).is_dir()]
    listing.missing("split", absent, root, "note")
    return listing


def _read_genea_split(folder: Path, split: str, listing: Listing) -> None:
    agent, partner = folder / "main-agent", folder / "interloctr"
    about = _genea_metadata(folder / "metadata.csv", listing)
    stems = {file.stem for file in (agent / "wav").glob("*.wav")}
    stems |= {file.stem for file in (agent / "bvh").glob("*.bvh")}
    stems |= {f"{name}_main-agent" for name in about}
    no_fingers = []
    for stem in sorted(stems):
        other = stem.replace("main-agent", "interloctr")
        files = {"audio": agent / "wav" / f"{stem}.wav", "motion": agent / "bvh" / f"{stem}.bvh"}
        sides = {
            "words": agent / "tsv" / f"{stem}.tsv",
            "partner_audio": partner / "wav" / f"{other}.wav",
            "partner_motion": partner / "bvh" / f"{other}.bvh",
            "partner_words": partner / "tsv" / f"{other}.tsv",
        }
        if listing.lacks("wav file", files["audio"], agent / "wav") or (
            split != "test" and listing.lacks("bvh file", files["motion"], agent / "bvh")
        ):
            continue
        listing.lacks("tsv file", sides["words"], agent / "tsv", "note")
        row = about.get(stem.removesuffix("_main-agent"), {})
        if row and row["fingers"] != "finger_incl":
            no_fingers.append(stem)
        name, speaker = f"{folder.name}/{stem}", row.get("speaker")
        listing.add(name, files, sides, speaker=speaker, split=split)
    listing.note("fingers were not recorded (metadata.csv)", no_fingers, folder)


def _genea_metadata(file: Path, listing: Listing) -> dict[str, dict[str, str]]:
    """Return the five columns of metadata.csv by recording; their headings vary."""
    if not file.is_file():
        listing.missing("table", [file.name], file.parent, "warning")
        return {}
    about = {}
    for _, row in rows(file, (), others=True):
        name, *cells = row.values()
        about[name] = dict(zip_longest(_GENEA_COLUMNS, cells[: len(_GENEA_COLUMNS)], fillvalue=""))
    return about


_SEAMLESS_KINDS = ("improvised", "naturalistic")
_SEAMLESS_SPLITS = {"train": "train", "dev": "valid", "test": "test"}
_SEAMLESS_NAME = re.compile(r"(?P<session>V\d+_S\d+_I\d+)_(?P<person>P\w+)")
_LEAST_SECONDS = 1.0


def read_seamless(folder: Path) -> Listing:
    """Read the folder that holds improvised or naturalistic.

    Speakers are the participants, styles the two kinds of interaction. Frames that are marked
    invalid are left out: each run of valid frames of at least a second is a recording. Conditions
    name the transcript and the partner's files.

    Raises:
        CorpusError: there is no such folder.
    """
    root = root_with(folder, _SEAMLESS_KINDS, "Seamless Interaction")
    listing = Listing(fps=FPS)
    for kind in _SEAMLESS_KINDS:
        for name, split in _SEAMLESS_SPLITS.items():
            if (root / kind / name).is_dir():
                _read_seamless_split(root, kind, name, split, listing)
    listing.report_missing()
    return listing


def _read_seamless_split(root: Path, kind: str, name: str, split: str, listing: Listing) -> None:
    sessions: dict[str, dict[str, Path]] = defaultdict(dict)
    for motion in sorted((root / kind / name).rglob("*.npz")):
        if match := _SEAMLESS_NAME.fullmatch(motion.stem):
            sessions[match["session"]][match["person"]] = motion
        else:
            listing.left_over.append(motion)
    for people in sessions.values():
        for person, motion in people.items():
            audio = motion.with_suffix(".wav")
            if listing.lacks("wav file", audio, root / kind / name):
                continue
            partner = next((file for other, file in people.items() if other != person), None)
            sides = {"words": motion.with_suffix(".json")}
            if partner is not None:
                suffixes = {"motion": ".npz", "audio": ".wav", "words": ".json"}
                sides |= {f"partner_{k}": partner.with_suffix(end) for k, end in suffixes.items()}
            about = {"speaker": person, "take": motion.stem.split("_I")[0], "style": kind}
            stem = motion.relative_to(root).with_suffix("").as_posix()
            listing.add(stem, {"audio": audio, "motion": motion}, sides, split=split, **about)
            listing.recordings += _valid_runs(listing.recordings.pop(), listing)
    for file in (root / kind / name).rglob("*.wav"):
        if _SEAMLESS_NAME.fullmatch(file.stem):
            listing.lacks("npz file", file.with_suffix(".npz"), root / kind / name)


def _valid_runs(recording: Recording, listing: Listing) -> list[Recording]:
    """Return a recording for each run of valid frames."""
    try:
        with open_archive(recording.file, FormatError) as archive:
            if "smplh:is_valid" not in archive:
                return [recording]
            valid = archive["smplh:is_valid"].reshape(-1) != 0
    except FormatError:
        return [recording]  # which the examination reports
    if valid.all():
        return [recording]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], valid, [0]])))
    runs = [
        (start / FPS, stop / FPS)
        for start, stop in zip(edges[::2], edges[1::2], strict=True)
        if stop - start >= _LEAST_SECONDS * FPS
    ]
    text = f"{int((~valid).sum())} of {len(valid)} frames are marked invalid and left out"
    severity = "note" if runs else "error"
    listing.problems.append(Problem(severity, recording.motion, text))
    return [
        replace(recording, id=f"{recording.id}@{start:.2f}-{stop:.2f}", limits=(start, stop))
        for start, stop in runs
    ]
