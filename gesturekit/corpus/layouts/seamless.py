"""Seamless Interaction (Agrawal et al. 2025): SMPL-H motion and speech of dyads."""

from __future__ import annotations

import re
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np

from audio_features.archive import open_archive
from gesturekit.corpus.checks import Problem
from gesturekit.corpus.layouts.listing import Listing, existing, root_with
from gesturekit.corpus.recording import Recording
from gesturekit.errors import FormatError
from gesturekit.formats.amass import FPS

_KINDS = ("improvised", "naturalistic")
_SPLITS = {"train": "train", "dev": "valid", "test": "test"}
_NAME = re.compile(r"(?P<session>V\d+_S\d+_I\d+)_(?P<person>P\w+)")
_LEAST_SECONDS = 1.0


def read_seamless(folder: Path) -> Listing:
    """Read the folder that holds improvised or naturalistic.

    Speakers are the participants, styles the two kinds of interaction. Frames that are marked
    invalid are left out: each run of valid frames of at least a second is a recording. Conditions
    name the transcript and the partner's files.

    Raises:
        CorpusError: there is no such folder.
    """
    root = root_with(folder, _KINDS, "Seamless Interaction")
    listing = Listing(fps=FPS)
    for kind in _KINDS:
        for name, split in _SPLITS.items():
            if (root / kind / name).is_dir():
                _read_split(root, kind, name, split, listing)
    return listing


def _read_split(root: Path, kind: str, name: str, split: str, listing: Listing) -> None:
    sessions: dict[str, dict[str, Path]] = defaultdict(dict)
    absent: list[str] = []
    for motion in sorted((root / kind / name).rglob("*.npz")):
        if match := _NAME.fullmatch(motion.stem):
            sessions[match["session"]][match["person"]] = motion
        else:
            listing.left_over.append(motion)
    for people in sessions.values():
        for person, motion in people.items():
            audio = motion.with_suffix(".wav")
            if not audio.is_file():
                absent.append(audio.name)
                continue
            partner = next((file for other, file in people.items() if other != person), None)
            sides = {"words": motion.with_suffix(".json")}
            if partner is not None:
                sides |= {
                    "partner_motion": partner,
                    "partner_audio": partner.with_suffix(".wav"),
                    "partner_words": partner.with_suffix(".json"),
                }
            recording = Recording(
                motion.relative_to(root).with_suffix("").as_posix(),
                audio=audio,
                motion=motion,
                speaker=person,
                take=motion.stem.split("_I")[0],
                style=kind,
                split=split,
                conditions=existing(sides),
            )
            listing.recordings += _valid_runs(recording, listing)
    sounds = [file for file in (root / kind / name).rglob("*.wav") if _NAME.fullmatch(file.stem)]
    still = [file.stem + ".npz" for file in sounds if not file.with_suffix(".npz").is_file()]
    listing.missing("wav file", absent, root / kind / name, "error")
    listing.missing("npz file", still, root / kind / name, "error")


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
