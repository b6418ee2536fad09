"""Sources and targets of a conversion, determined and checked before the first file is read."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from audio_features.archive import open_archive
from gesturekit.errors import ConfigError, FormatError
from gesturekit.formats.smpl.easymocap import SUBFOLDERS
from gesturekit.jobs.targets import EXISTING, refuse_existing, refuse_leaving
from gesturekit.wording import listed

MOTION_SUFFIXES = (".bvh", ".npz")
"""Motion files searched for in folders, besides EasyMocap sequences."""
SPEECH_SUFFIXES = (
    *(".wav", ".flac", ".mp3", ".ogg", ".oga", ".opus"),
    *(".aiff", ".aif", ".aifc", ".au"),
)
VIDEO_SUFFIXES = (".mp4", ".m4v", ".mov", ".mkv", ".webm", ".avi", ".mpg", ".mpeg", ".3gp")
OTHER_SPEECH_SUFFIXES = (
    *(".m4a", ".aac", ".wma", ".amr", ".ac3", ".mp2", ".caf", ".w64", ".ape", ".wv"),
    *VIDEO_SUFFIXES,
)
"""Unsupported audio and video; ffmpeg converts them to wav."""
OTHER_MOTION_SUFFIXES = (
    *(".fbx", ".c3d", ".glb", ".gltf", ".trc", ".mot", ".asf", ".amc", ".vrma", ".vmd"),
    *(".usd", ".usda", ".usdc", ".usdz", ".dae", ".blend"),
)
"""Unsupported motion files; Blender and other programs convert most of them to BVH."""
WRITABLE = ("bvh", "npz", "html", "mp4", "png", "svg", "pdf", "obj")
_NO_MOTION = f"no motion in it; looked for {', '.join(MOTION_SUFFIXES)} and EasyMocap folders"
_SHOWN = 3
_GLANCE = 1 << 16


@dataclass(frozen=True)
class Job:
    """One motion to read and the files to write it to.

    Attributes:
        source: a file, or the folder of a sequence with one file per frame.
        targets: files to write.
        error: reason why the source cannot be read.
        name: path of the targets below the output folder, without suffix.
    """

    source: Path
    targets: tuple[Path, ...] = ()
    error: str | None = None
    name: str = ""


def plan(sources: Sequence[Path], out: Path, formats: Sequence[str] = ()) -> list[Job]:
    """Return the jobs of a conversion.

    `out` is a file if there is a single motion and `out` has the suffix of a format. Otherwise it
    is a folder for files of all `formats`; motions found in a folder keep their relative paths. If
    a folder has a motion as both STEM.bvh and STEM.npz, only one is read.

    Warns:
        UserWarning: which of these two is read, and why; unsupported motion files in a folder.

    Raises:
        ConfigError: nothing to read, an unknown format, two sources for one target, a target that
            is a source or outside `out`, or a folder without write permission.
    """
    if not sources:
        raise ConfigError("nothing to convert; name a motion file or a folder of them")
    unknown = [name for name in formats if name not in WRITABLE]
    if unknown:
        raise ConfigError(f"format {', '.join(unknown)}: known: {', '.join(WRITABLE)}")
    if is_file_name(out, sources, formats):
        if formats and list(formats) != [out.suffix.lower()[1:]]:
            raise ConfigError(
                f"{out} is written as {out.suffix.lower()[1:]}, not {', '.join(formats)}; "
                "give a folder to write several formats"
            )
        jobs = found = [Job(sources[0], (out,), name=out.stem)]
    else:
        found = _into_folder(sources, out, formats)
        jobs = _without_copies(found)
        refuse_leaving([target for job in jobs for target in job.targets], out)
    _refuse_clashes(jobs, {os.path.realpath(job.source) for job in found})
    _refuse_locked(jobs, out)
    return jobs


def motions_in(folder: Path, *, but: Path | None = None) -> Iterator[Path | OSError]:
    """Yield the motions below a folder, in order: files, and folders that are a sequence.

    Hidden files and folders, npz files of features and body models, and everything below `but` are
    skipped. Links to folders are followed once. A folder that cannot be opened yields its OSError.
    """
    trouble: list[OSError] = []
    for here, folders, files in visible_folders(folder, trouble.append):
        yield from trouble
        trouble.clear()
        if but is not None and os.path.realpath(here) == os.path.realpath(but):
            folders.clear()
            continue
        if is_sequence(here):
            yield here
            folders[:] = [name for name in folders if name not in SUBFOLDERS]
        yield from filter(is_motion, files)
    yield from trouble


def motions_of(source: Path) -> list[Path]:
    """Return the motions of a path: itself, or all below a folder, without duplicates.

    Raises:
        ConfigError: a folder without motion.
    """
    if not source.is_dir() or is_sequence(source):
        return [source]
    found = [path for path in motions_in(source) if not isinstance(path, OSError)]
    copies, _ = one_of_two_formats(found)
    if not found:
        raise ConfigError(f"{source}: {_NO_MOTION}")
    return [path for path in found if path not in copies]


def visible_folders(
    folder: Path, unreadable: Callable[[OSError], None]
) -> Iterator[tuple[Path, list[str], list[Path]]]:
    """Yield (folder, names of its folders, its files) for a folder and all below it, in order.

    Hidden ones are skipped. Links to folders are followed once. Names that the caller removes from
    the list of folders are not entered. `unreadable` is called for folders that cannot be opened.
    """
    visited: set[tuple[int, int]] = set()
    for base, folders, files in os.walk(folder, onerror=unreadable, followlinks=True):
        here = Path(base)
        status = here.stat()
        if (status.st_dev, status.st_ino) in visited:
            folders.clear()
            continue
        visited.add((status.st_dev, status.st_ino))
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        yield here, folders, [here / name for name in sorted(files) if not name.startswith(".")]


def unreadable_media(path: Path) -> str | None:
    """Return why an audio or motion file is not supported, and what to do; None for other files.

    The reason is the same for all files of one suffix, so that a listing can group them.
    """
    kind = path.suffix.lower()[1:]
    if path.suffix.lower() in OTHER_SPEECH_SUFFIXES:
        return f"{kind} is not read; make a wav of it: ffmpeg -i x.{kind} x.wav"
    if path.suffix.lower() in OTHER_MOTION_SUFFIXES:
        return f"{kind} is not read; export it as bvh, for example from Blender"
    return None


def is_sequence(path: Path) -> bool:
    """Return whether a folder, or its subfolder `smpl`, is an EasyMocap sequence."""
    return any(_has_frames(folder) for folder in (path, *(path / name for name in SUBFOLDERS)))


def is_motion(path: Path) -> bool:
    """Return whether a file is a motion, by its suffix and the keys of an npz."""
    suffix = path.suffix.lower()
    if suffix == ".npz":
        return not (is_feature_file(path) or is_body_model(path))
    return suffix in MOTION_SUFFIXES


def is_feature_file(path: Path) -> bool:
    """Return whether a file is an npz of speech features."""
    return _has_keys(path, "values", "times", "spec")


def is_body_model(path: Path) -> bool:
    """Return whether a file is the npz of a body model."""
    return _has_keys(path, "v_template", "kintree_table")


def _has_keys(path: Path, *keys: str) -> bool:
    try:
        with open_archive(path, FormatError) as archive:
            return all(key in archive for key in keys)
    except FormatError:
        return False  # the reader reports the error


def _has_frames(folder: Path) -> bool:
    """Return whether a folder has 000000.json, ..., and the first has keys of SMPL parameters.

    EasyMocap also writes keypoints to files of the same names.
    """
    try:
        frames = (path for path in folder.iterdir() if path.stem.isdecimal())
        first = min((path for path in frames if path.suffix == ".json"), default=None)
        if first is None or not first.is_file():
            return False
        with first.open("rb") as file:
            start = file.read(_GLANCE)
    except OSError:
        return False
    return b'"Rh"' in start or b'"poses"' in start


def is_file_name(out: Path, sources: Sequence[Path], formats: Sequence[str]) -> bool:
    """Return whether `out` is the file for a single motion, and not a folder.

    Raises:
        ConfigError: it can be neither.
    """
    suffix = out.suffix.lower()[1:]
    if out.is_dir():
        return False
    if len(sources) == 1 and (not sources[0].is_dir() or is_sequence(sources[0])):
        if suffix in WRITABLE:
            return True
        if suffix and not formats:
            raise ConfigError(
                f"{out}: cannot write motion as .{suffix}; known: {', '.join(WRITABLE)}"
            )
    elif suffix in WRITABLE:
        what = "a folder" if len(sources) == 1 else f"{len(sources)} inputs"
        raise ConfigError(f"{out} is a file name, but {what} cannot become one file; name a folder")
    if out.exists():
        raise ConfigError(
            f"{out} is a file; give a folder to fill, or a name ending in one of "
            f"{', '.join(WRITABLE)}"
        )
    return False


def _into_folder(sources: Sequence[Path], out: Path, formats: Sequence[str]) -> list[Job]:
    if not formats:
        raise ConfigError(
            f"{out} is a folder: say what to write into it, such as --format npz "
            f"(of {', '.join(WRITABLE)})"
        )
    jobs: dict[tuple[str, str], Job] = {}
    for source in sources:
        for path, key in _keyed(source, out):
            if isinstance(path, OSError):
                where = Path(path.filename or source)
                jobs[str(where), ""] = Job(where, error=f"{where}: {path.strerror}")
                continue
            targets = tuple(out / f"{key}.{kind}" for kind in formats)
            # A file that is named twice is converted once; a link to it beside it is not it.
            jobs.setdefault((os.path.realpath(path), key), Job(path, targets, name=key))
    _warn_of_unread(sources, jobs.values())
    if not jobs:
        raise ConfigError(f"{sources[0]}: {_NO_MOTION}")
    return list(jobs.values())


def _warn_of_unread(sources: Sequence[Path], jobs: Iterable[Job]) -> None:
    read = {job.source.with_suffix("") for job in jobs}
    unread: dict[str, list[str]] = {}
    for folder in filter(Path.is_dir, sources):
        for _, _, files in visible_folders(folder, lambda error: None):  # named already
            for path in files:
                if (
                    path.suffix.lower() in OTHER_MOTION_SUFFIXES
                    and path.with_suffix("") not in read
                ):
                    unread.setdefault(unreadable_media(path) or "", []).append(str(path))
    for reason, paths in unread.items():
        warnings.warn(f"{listed(paths, _SHOWN)}: {reason}", stacklevel=2)


def _keyed(source: Path, out: Path) -> Iterator[tuple[Path | OSError, str]]:
    """Yield the motions of a source, each with its path below `out`, without suffix."""
    if not source.is_dir():
        yield source, source.stem
        return
    if is_sequence(source):
        yield source, source.resolve().name
        return
    inside = out if os.path.realpath(out) != os.path.realpath(source) else None
    for path in motions_in(source, but=inside):
        if isinstance(path, OSError):
            yield path, ""
        elif path.is_dir():
            yield path, path.relative_to(source).as_posix()
        else:
            yield path, path.relative_to(source).with_suffix("").as_posix()


def one_of_two_formats(motions: Iterable[Path]) -> tuple[set[Path], list[str]]:
    """Return the motions that are duplicates, and lines about them.

    Of STEM.bvh and STEM.npz in one folder, the one with more data is read.
    """
    groups: dict[Path, dict[str, Path]] = {}
    for path in motions:
        groups.setdefault(path.with_suffix(""), {})[path.suffix.lower()] = path
    kept: dict[str, list[str]] = {".npz": [], ".bvh": []}
    copies = set()
    for group in groups.values():
        if not group.keys() >= kept.keys():
            continue
        suffix, other = ".bvh", ".npz"
        if _has_keys(group[".npz"], "gk_version"):
            suffix, other = other, suffix
        kept[suffix].append(str(group[suffix]))
        copies.add(group[other])
    lines = [
        f"of a bvh and an npz of one name, one is read: {listed(kept[suffix], _SHOWN)} ({why})"
        for suffix, why in (
            (".npz", "the npz is gesturekit's own and holds all of it, unrounded"),
            (".bvh", "the bvh has the rig that was recorded; the npz may have another"),
        )
        if kept[suffix]
    ]
    return copies, lines


def _without_copies(jobs: list[Job]) -> list[Job]:
    by_target: dict[tuple[Path, ...], list[Path]] = {}
    for job in jobs:
        by_target.setdefault(job.targets, []).append(job.source)
    # Only those with the same target: each duplicate can still be converted by its name.
    rivals = [path for sources in by_target.values() if len(sources) > 1 for path in sources]
    copies, lines = one_of_two_formats(rivals)
    for line in lines:
        warnings.warn(line, stacklevel=2)
    return [job for job in jobs if len(by_target[job.targets]) == 1 or job.source not in copies]


def _refuse_clashes(jobs: Sequence[Job], sources: set[str]) -> None:
    taken: dict[str, Path] = {}
    for job in jobs:
        for target in job.targets:
            where = os.path.realpath(target)
            if where in sources:
                raise ConfigError(f"{target} is one of the inputs; give another name or folder")
            if where in taken:
                raise ConfigError(
                    f"{taken[where]} and {job.source} would both be written as {target}; "
                    "convert them into different folders"
                )
            taken[where] = job.source


def _refuse_locked(jobs: Sequence[Job], out: Path) -> None:
    """Raise ConfigError if the nearest existing folder is not writable, before hours of reading."""
    if not any(job.targets for job in jobs):
        return
    folder = next(path for path in (out, *out.absolute().parents) if path.is_dir())
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ConfigError(f"{out}: {folder} cannot be written to; give another place")


def without_existing(targets: Sequence[Path], existing: str) -> tuple[Path, ...]:
    """Return the targets to write.

    Raises:
        ConfigError: one exists, and `existing` is "refuse"; or an unknown `existing`.
    """
    if existing not in EXISTING:
        raise ConfigError(f"existing is {existing!r}; expected {', '.join(EXISTING)}")
    there = [target for target in targets if os.path.lexists(target)]
    if there and existing == "refuse":
        refuse_existing(there)
    return tuple(target for target in targets if target not in there or existing == "replace")
