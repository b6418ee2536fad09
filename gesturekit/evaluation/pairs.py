"""Match generated clips with recordings and their sound, by name.

Names are compared by path below the folder without extension, then by stem. `STEM_s2` (a sample,
as `gesturekit render --samples` writes it) and `STEM_w003` (the fourth 10 s window of STEM) belong
to STEM.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from gesturekit.corpus.manifest import Item, Manifest
from gesturekit.errors import CorpusError, FormatError, MotionError
from gesturekit.formats.registry import MOTION_SUFFIXES
from gesturekit.formats.sources import SPEECH_SUFFIXES, load, visible_folders
from gesturekit.wording import counted, did_you_mean, listed

if TYPE_CHECKING:
    from audio_features import Wave
    from gesturekit.motion import Motion

_MOTION = tuple(sorted(MOTION_SUFFIXES, key=lambda suffix: suffix != ".npz"))
"""Motion formats, the preferred one first: npz stores every digit."""
SEMANTIC_SUFFIXES = (".npz", ".txt")
WINDOW_SECONDS = 10.0
"""Length of the windows that names ending in _w000, _w001 ... denote."""

_SAMPLE = re.compile(r"_s\d+$")
_CUT = re.compile(r"@\d+(\.\d+)?-\d+(\.\d+)?(_s\d+)?$")
_WINDOW = re.compile(r"_w(\d{3,})$")
Source = TypeVar("Source")
_Key = TypeVar("_Key")
Window = tuple[str, int | None]
"""A recording and the index of its 10 s window; None for the whole recording."""


@dataclass(frozen=True)
class Items:
    """Recordings given by a manifest, or by a folder.

    Attributes:
        path: the manifest, or the folder or file.
        split: the split of the manifest; all of its items are expected. "" for a folder.
        items: the recordings.
        aside: reason not to measure clips of other items of the manifest, by id: "no motion", or
            "split train".
        others: items with motion of the manifest's other splits.

    Examples:
        The recordings of a folder, by path without extension:

        >>> motion = gk.load("demo").generate(seconds=1)
        >>> motion.save(folder / "talk" / "a.bvh")
        >>> motion.save(folder / "talk" / "b.npz")
        >>> [item.id for item in Items.of_folder(folder / "talk").items]
        ['a', 'b']
    """

    path: Path
    split: str
    items: tuple[Item, ...]
    aside: Mapping[str, str] = field(default_factory=dict)
    others: tuple[Item, ...] = ()

    @classmethod
    def of_folder(cls, path: Path, reading: Mapping[str, Any] | None = None) -> Items:
        """Return the recordings of a folder or file.

        Args:
            path: the folder or file.
            reading: options of `gesturekit.formats.sources.load`.

        Raises:
            CorpusError: no recording was found.
        """
        files = motion_files(path).items()
        items = (BareItem(id=key, motion=file, reading=reading or {}) for key, file in files)
        return cls(path, "", tuple(items))

    @classmethod
    def of_manifest(cls, path: Path, split: str) -> Items:
        """Return the items of one split of a manifest.

        Raises:
            CorpusError: it cannot be read, or has no item of the split.
        """
        manifest = Manifest.load(path)
        items = manifest.in_split(split, str(path))
        aside = {item.id: f"split {item.split}" for item in manifest if item.split != split}
        aside |= {item.id: "no motion" for item in manifest if item.motion is None}
        others = [i for i in manifest if i.split != split and i.motion is not None]
        return cls(path, split, items, aside, tuple(others))

    @property
    def training(self) -> tuple[Item, ...]:
        """Items with motion of the manifest's training split, if `split` is another one."""
        return tuple(item for item in self.others if item.split == "train")

    def recordings(self, *, all_splits: bool = False) -> dict[str, Item]:
        """Return {id: item} of the items with motion; those of other splits come last, if asked.

        Raises:
            CorpusError: no item of the split has motion.
        """
        moving = [item for item in self.items if item.motion is not None]
        if not moving:
            raise CorpusError(f"{self}: no item has motion to compare with")
        moving.sort(key=lambda item: item.id)
        return {item.id: item for item in (*moving, *(self.others if all_splits else ()))}

    def __str__(self) -> str:
        return f"split {self.split} of {self.path}" if self.split else str(self.path)


@dataclass(frozen=True, kw_only=True)
class BareItem(Item):
    """Whole motion or sound without a manifest: of a file, or made when it is needed.

    Attributes:
        make: makes the motion; None reads the file.
    """

    audio: Path | None = None
    motion: Path | None = None
    duration: float = math.inf
    split: str = ""
    make: Callable[[], Motion] | None = None

    def __post_init__(self) -> None:
        """Accept a length, split and take that are not known."""

    def __str__(self) -> str:
        return str(self.motion or self.audio or self.id)

    def load_wave(self) -> Wave:
        """Read the whole sound."""
        from audio_features import Wave

        assert self.audio is not None
        return Wave.load(self.audio)

    def load_motion(self, parts: Mapping[str, str] | None = None) -> Motion:
        """Read or make the motion; errors name the file."""
        if self.make is not None:
            return self.make()
        assert self.motion is not None
        try:
            return load(self.motion, self.reading)
        except (FormatError, MotionError) as error:
            # The error of an invalid motion does not name its file.
            text = str(error)
            named = text if self.motion.name in text else f"{self.motion}: {text}"
            raise type(error)(named) from error


@dataclass(frozen=True)
class Pair:
    """A generated clip, its recording, and the sound and semantic track of the recording.

    Attributes:
        name: the generated clip's key: its path within the folder, without extension.
        stem: the key of its recording.
        window: index of the 10 s window of the recording; None for the whole.
        generated: its motion: of a file, or made by a baseline.
        reference: the recording's motion.
        audio: the recording's sound, or None.
        semantic: the recording's semantic track, or None.
        take: recording session; by default that of a manifest's item, else the recording itself.
    """

    name: str
    stem: str
    window: int | None
    generated: Item
    reference: Item
    audio: Item | None = None
    semantic: Path | None = None
    take: str = ""

    def __post_init__(self) -> None:
        if not self.take:
            object.__setattr__(self, "take", self.reference.take or self.stem)

    @property
    def of(self) -> Window:
        """The recording, or the window of it, that the clip was generated for."""
        return self.stem, self.window

    @property
    def speaker(self) -> str | None:
        """The speaker of the recording, if known."""
        return self.reference.speaker

    @property
    def style(self) -> str | None:
        """The style of the recording, if known."""
        return self.reference.style


@dataclass(frozen=True)
class Excluded:
    """A clip that is left out, and why; `what` is "clip" or the metric that is left out."""

    name: str
    reason: str
    what: str = "clip"


@dataclass
class Pairs:
    """Clips matched with their recordings.

    Attributes:
        pairs: in order of stem and name.
        excluded: clips without a recording, and why.
        notes: clips that are deliberately not measured.
    """

    pairs: list[Pair] = field(default_factory=list)
    excluded: list[Excluded] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def find_pairs(
    generated: Path,
    reference: Items,
    *,
    audio: Path | None = None,
    semantic: Path | None = None,
) -> Pairs:
    """Match generated clips with recordings and their sounds.

    Args:
        generated: folder or file of motion (npz, BVH).
        reference: the recordings. A single file is the reference of every clip; every item of a
            manifest's split is expected to have one.
        audio: folder or file of the recordings' sound; items of a manifest have their own.
        semantic: folder or file of semantic tracks: feature files (npz) or BEAT's (txt).

    Raises:
        CorpusError: a missing or empty folder, or no clip that has a recording.
    """
    made, recorded = motion_files(generated), reference.recordings()
    sounds = files_by_key(audio, SPEECH_SUFFIXES, "sound") if audio else {}
    tracks = files_by_key(semantic, SEMANTIC_SUFFIXES, "semantic track") if semantic else {}
    found = Pairs()
    for name, stem, window in _matched(made, recorded, reference, found):
        recording, track = recorded[stem], file_of(stem, tracks, semantic)
        sound = recording if recording.audio is not None else None
        if audio is not None and (file := file_of(stem, sounds, audio)) is not None:
            sound = BareItem(id=str(file), audio=file)
        motion = BareItem(id=name, motion=made[name])
        found.pairs.append(Pair(name, stem, window, motion, recording, sound, track))
    problem = "" if found.pairs else _no_pair(generated, made, reference, recorded, found)
    if found.pairs and sounds and not any(pair.audio for pair in found.pairs):
        names = f"({listed([*sounds], 3)}) has the name of a recording ({listed([*recorded], 3)})"
        problem = f"{audio}: none of its sounds {names}"
    if problem:
        raise CorpusError(problem)
    found.pairs.sort(key=lambda pair: (pair.stem, pair.name))
    stems = dict.fromkeys(pair.stem for pair in found.pairs)
    if reference.split:
        missing = sorted(set(recorded) - set(stems))
        found.excluded += [Excluded(key, f"{generated} has no clip of it") for key in missing]
        return found
    for files, folder, metric, kind in (
        (sounds, audio, "speech", "sound"),
        (tracks, semantic, "srgr", "semantic track"),
    ):
        found.excluded += [
            Excluded(stem, f"{folder} has no {kind}, or several, of its name", metric)
            for stem in stems
            if files and file_of(stem, files, folder) is None
        ]
    return found


def _no_pair(
    generated: Path,
    made: Mapping[str, Path],
    reference: Items,
    recorded: Mapping[str, Item],
    found: Pairs,
) -> str:
    """Return the error for clips of which none has a recording."""
    if found.notes and not found.excluded:
        return f"{generated}: nothing to measure: {'; '.join(found.notes)}"
    are_items = not reference.split and any(map(_CUT.search, made))
    advice = "; names with @START-END are items of a manifest: --corpus" if are_items else ""
    return (
        f"{generated}: of {counted(len(made), 'clip')} ({listed([*made], 3)}) none has a recording "
        f"of its name in {reference} ({listed([*recorded], 3)}); give them the same names, with "
        f"_s1, _s2 ... for samples{advice}"
    )


def _matched(
    made: Mapping[str, Path], recorded: Mapping[str, Item], reference: Items, found: Pairs
) -> Iterator[tuple[str, str, int | None]]:
    """Yield (clip, its recording, window) of each clip; add the other clips to `found`."""
    reasons, path = reference.aside, reference.path
    if path.is_file() and path.suffix.lower() in _MOTION:
        yield from ((name, next(iter(recorded)), None) for name in made)
        return
    by_stem, not_measured = _by_stem(recorded), _by_stem(reasons)
    aside: list[tuple[str, str]] = []
    for name in made:
        stem, window, reason = _recording_of(name, recorded, by_stem)
        if stem is not None:
            yield name, stem, window
        elif (item := _recording_of(name, reasons, not_measured)[0]) is not None:
            aside.append((reasons[item], name))
        else:
            found.excluded.append(Excluded(name, reason))
    for reason, names in sorted(grouped(aside).items()):
        what = "whose items have no motion" if reason == "no motion" else f"of {reason}"
        found.notes.append(
            f"{counted(len(names), 'clip')} {what} in {path}, not measured: {listed(names, 3)}"
        )


def motion_files(path: Path) -> dict[str, Path]:
    """Return {key: file} of all motion below a folder, or of one file.

    Raises:
        CorpusError: no motion was found.
    """
    return files_by_key(path, _MOTION, "motion")


def files_by_key(path: Path, suffixes: tuple[str, ...], what: str) -> dict[str, Path]:
    """Return {relative path without extension: file}, sorted; earlier suffixes take precedence.

    Hidden files and folders are skipped, links to folders followed once. A folder that cannot be
    opened gives a warning.

    Raises:
        CorpusError: no such folder or file, one of another kind, or none inside.
    """
    root, files = path.parent, [path] if path.is_file() else []
    if path.is_dir():
        root, files = path, [file for _, _, below in visible_folders(path) for file in below]
    files = [file for file in files if file.suffix.lower() in suffixes]
    files.sort(key=lambda file: -suffixes.index(file.suffix.lower()))  # the last one counts
    found = {file.relative_to(root).with_suffix("").as_posix(): file for file in files}
    if not found:
        kinds = ", ".join(suffixes)
        problem = f"no such file or folder; give a folder of {what} files"
        if path.is_file():
            problem = f"no {what} file; expected {kinds}"
        elif path.is_dir():
            problem = f"no {what} files ({kinds}) in this folder; is it the right one?"
        raise CorpusError(f"{path}: {problem}")
    return dict(sorted(found.items()))


def grouped(pairs: Iterable[tuple[_Key, Source]]) -> dict[_Key, list[Source]]:
    """Return {key: its values, in order} of (key, value)."""
    groups: dict[_Key, list[Source]] = {}
    for key, value in pairs:
        groups.setdefault(key, []).append(value)
    return groups


def _by_stem(keys: Iterable[str]) -> dict[str, list[str]]:
    """Return {last part of a key: the keys that end in it}."""
    return grouped((key.rpartition("/")[2], key) for key in keys)


def _recording_of(
    name: str, recorded: Collection[str], by_stem: Mapping[str, Sequence[str]]
) -> tuple[str | None, int | None, str]:
    """Return (key of a clip's recording or None, window, reason why none was found)."""
    sample = _SAMPLE.sub("", name)
    window = _WINDOW.search(sample)
    names: list[tuple[str, int | None]] = [(name, None), (sample, None)]
    if window:
        names.append((sample[: window.start()], int(window[1])))
    for key, index in names:
        fitting = [key] if key in recorded else by_stem.get(key.rpartition("/")[2], [])
        if len(fitting) == 1:
            return fitting[0], index, ""
        if fitting:
            return None, None, f"several recordings fit it: {', '.join(fitting)}"
    hint = did_you_mean(sample, recorded, "; did you mean {}?")
    return None, None, f"no recording of its name{hint}"


def file_of(stem: str, files: Mapping[str, Source], given: Path | None) -> Source | Path | None:
    """Return the file of a recording by its key, else by its stem; None if there is none."""
    if given is not None and given.is_file():
        return given
    if stem in files:
        return files[stem]
    last = stem.rpartition("/")[2]
    fitting = [path for key, path in files.items() if key.rpartition("/")[2] == last]
    return fitting[0] if len(fitting) == 1 else None
