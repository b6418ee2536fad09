"""GENEA Challenge 2023: dyads of Talking With Hands; the main agent is modelled."""

from __future__ import annotations

from pathlib import Path

from gesturekit.corpus.layouts.listing import Listing, existing, root_with, rows
from gesturekit.corpus.recording import Recording

_SPLITS = {"trn": "train", "val": "valid", "tst": "test"}
_COLUMNS = ("speaker", "fingers", "partner", "partner_fingers")


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
    for name, split in _SPLITS.items():
        if (root / name).is_dir():
            _read_split(root / name, split, listing)
    absent = [name for name in ("trn", "val") if not (root / name).is_dir()]
    listing.missing("split", absent, root, "note")
    return listing


def _read_split(folder: Path, split: str, listing: Listing) -> None:
    agent, partner = folder / "main-agent", folder / "interloctr"
    about = _metadata(folder / "metadata.csv", listing)
    stems = {file.stem for file in (agent / "wav").glob("*.wav")}
    stems |= {file.stem for file in (agent / "bvh").glob("*.bvh")}
    stems |= {f"{name}_main-agent" for name in about}
    no_sound, no_motion, no_words, no_fingers = [], [], [], []
    for stem in sorted(stems):
        audio, motion = agent / "wav" / f"{stem}.wav", agent / "bvh" / f"{stem}.bvh"
        if not audio.is_file():
            no_sound.append(audio.name)
            continue
        if not motion.is_file() and split != "test":
            no_motion.append(motion.name)
            continue
        row = about.get(stem.removesuffix("_main-agent"), {})
        if row and row["fingers"] != "finger_incl":
            no_fingers.append(stem)
        if not (agent / "tsv" / f"{stem}.tsv").is_file():
            no_words.append(f"{stem}.tsv")
        other = stem.replace("main-agent", "interloctr")
        sides = {
            "words": agent / "tsv" / f"{stem}.tsv",
            "partner_audio": partner / "wav" / f"{other}.wav",
            "partner_motion": partner / "bvh" / f"{other}.bvh",
            "partner_words": partner / "tsv" / f"{other}.tsv",
        }
        listing.recordings.append(
            Recording(
                f"{folder.name}/{stem}",
                audio=audio,
                motion=motion if motion.is_file() else None,
                speaker=row.get("speaker"),
                split=split,
                conditions=existing(sides),
            )
        )
    listing.missing("wav file", no_sound, agent / "wav", "error")
    listing.missing("bvh file", no_motion, agent / "bvh", "error")
    listing.missing("tsv file", no_words, agent / "tsv", "note")
    listing.note("fingers were not recorded (metadata.csv)", no_fingers, folder)


def _metadata(file: Path, listing: Listing) -> dict[str, dict[str, str]]:
    """Return the five columns of metadata.csv by recording; their headings vary."""
    if not file.is_file():
        listing.missing("table", [file.name], file.parent, "warning")
        return {}
    found = {}
    for _, row in rows(file, (), others=True):
        name, *cells = row.values()
        found[name] = dict(zip(_COLUMNS, cells, strict=False))
        if len(cells) < len(_COLUMNS):
            found[name] |= dict.fromkeys(_COLUMNS[len(cells) :], "")
    return found
