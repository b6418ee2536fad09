"""Sources and targets of a conversion, determined and checked before the first file is read."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from gesturekit.errors import ConfigError
from gesturekit.formats.sources import (
    NO_MOTION,
    OTHER_MOTION_SUFFIXES,
    WRITABLE,
    is_sequence,
    motions_in,
    one_of_two_formats,
    unreadable_media,
    visible_folders,
)
from gesturekit.jobs.targets import EXISTING, refuse_existing, refuse_leaving
from gesturekit.wording import listed

_SHOWN = 3


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
        raise ConfigError(f"{sources[0]}: {NO_MOTION}")
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
