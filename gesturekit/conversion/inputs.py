"""Sources and targets of a conversion, determined and checked before the first file is read."""

from __future__ import annotations

import os
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from gesturekit.errors import ConfigError
from gesturekit.formats.registry import WRITABLE
from gesturekit.formats.sources import (
    NO_MOTION,
    OTHER_MOTION_SUFFIXES,
    is_sequence,
    motions_in,
    one_of_two_formats,
    unreadable_media,
    visible_folders,
)
from gesturekit.jobs.result import Task
from gesturekit.wording import listed

_SHOWN = 3
_KNOWN = ", ".join(WRITABLE)


def find_tasks(sources: Sequence[Path], out: Path, formats: Sequence[str] = ()) -> list[Task]:
    """Return the tasks of a conversion: each a file, or the folder of a sequence of frames.

    `out` is a file if there is a single motion and `out` has the suffix of a format. Otherwise it
    is a folder for files of all `formats`; motions found in a folder keep their relative paths. If
    a folder has a motion as both STEM.bvh and STEM.npz, only one is read.

    Warns:
        UserWarning: which of these two is read, and why; unsupported motion files in a folder.

    Raises:
        ConfigError: nothing to read, an unknown format, two sources for one target, a target that
            is a source, or a folder without write permission.
    """
    if not sources:
        raise ConfigError("nothing to convert; name a motion file or a folder of them")
    if unknown := [name for name in formats if name not in WRITABLE]:
        raise ConfigError(f"format {', '.join(unknown)}: known: {_KNOWN}")
    if is_file_name(out, sources, formats):
        kind = out.suffix.lower()[1:]
        if formats and list(formats) != [kind]:
            raise ConfigError(
                f"{out} is written as {kind}, not {', '.join(formats)}; "
                "give a folder to write several formats"
            )
        tasks = every = [Task(out.stem, sources[0])]
        targets = [(out, tasks[0])]
    else:
        every = _into_folder(sources, out, formats)
        tasks = _without_copies(every)
        targets = [
            (out / f"{task.id}.{kind}", task)
            for task in tasks
            if task.error is None
            for kind in formats
        ]
    _refuse_clashes(targets, {os.path.realpath(task.file) for task in every})
    # The nearest existing folder must be writable, which hours of reading would show too late.
    folder = next(path for path in (out, *out.absolute().parents) if path.is_dir())
    if targets and not os.access(folder, os.W_OK | os.X_OK):
        raise ConfigError(f"{out}: {folder} cannot be written to; give another place")
    return tasks


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
            raise ConfigError(f"{out}: cannot write motion as .{suffix}; known: {_KNOWN}")
    elif suffix in WRITABLE:
        what = "a folder" if len(sources) == 1 else f"{len(sources)} inputs"
        raise ConfigError(f"{out} is a file name, but {what} cannot become one file; name a folder")
    if out.exists():
        raise ConfigError(
            f"{out} is a file; give a folder to fill, or a name ending in one of {_KNOWN}"
        )
    return False


def _into_folder(sources: Sequence[Path], out: Path, formats: Sequence[str]) -> list[Task]:
    if not formats:
        raise ConfigError(
            f"{out} is a folder: say what to write into it, such as --format npz (of {_KNOWN})"
        )
    tasks: dict[tuple[str, str], Task] = {}
    for source in sources:
        for path, key in _keyed(source, out):
            if isinstance(path, OSError):
                where = Path(path.filename or source)
                tasks[str(where), ""] = Task("", where, error=f"{where}: {path.strerror}")
                continue
            # A file that is named twice is converted once; a link to it beside it is not it.
            tasks.setdefault((os.path.realpath(path), key), Task(key, path))
    _warn_of_unread(sources, {task.file.with_suffix("") for task in tasks.values()})
    if not tasks:
        raise ConfigError(f"{sources[0]}: {NO_MOTION}")
    return list(tasks.values())


def _warn_of_unread(sources: Sequence[Path], read: set[Path]) -> None:
    """Warn of unsupported motion files, except those beside a file of the same stem in `read`."""
    unread: dict[str, list[str]] = {}
    for folder in filter(Path.is_dir, sources):
        for _, _, files in visible_folders(folder, lambda error: None):  # named already
            for path in files:
                is_other = path.suffix.lower() in OTHER_MOTION_SUFFIXES
                if is_other and path.with_suffix("") not in read:
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
        else:
            within = path.relative_to(source)
            yield path, (within if path.is_dir() else within.with_suffix("")).as_posix()


def _without_copies(tasks: list[Task]) -> list[Task]:
    counts = Counter(task.id for task in tasks)
    # Only those with the same targets: each duplicate can still be converted by its name.
    rivals = [task.file for task in tasks if counts[task.id] > 1]
    copies, lines = one_of_two_formats(rivals)
    for line in lines:
        warnings.warn(line, stacklevel=2)
    return [task for task in tasks if counts[task.id] == 1 or task.path not in copies]


def _refuse_clashes(targets: Sequence[tuple[Path, Task]], sources: set[str]) -> None:
    taken: dict[str, Task] = {}
    for target, task in targets:
        where = os.path.realpath(target)
        if where in sources:
            raise ConfigError(f"{target} is one of the inputs; give another name or folder")
        if where in taken:
            raise ConfigError(
                f"{taken[where].source} and {task.source} would both be written as {target}; "
                "convert them into different folders"
            )
        taken[where] = task
