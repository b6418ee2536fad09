"""Motion files: found in folders, and read and written with the options of any format."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from audio_features.archive import open_archive
from gesturekit.errors import ConfigError, FormatError
from gesturekit.formats.easymocap import SUBFOLDERS
from gesturekit.formats.gltf.file import Gltf
from gesturekit.formats.registry import MOTION_SUFFIXES, READ_OPTIONS, WRITE_OPTIONS, format_of
from gesturekit.motion.motion import Motion
from gesturekit.wording import listed

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
    *(".fbx", ".c3d", ".trc", ".mot", ".asf", ".amc", ".vmd"),
    *(".usd", ".usda", ".usdc", ".usdz", ".dae", ".blend"),
    ".pkl",
)
"""Motion files that are not searched for; Blender and other programs convert most to BVH."""
_PICKLE = (
    "pkl is a pickle, which can run code, and is never read; of a file that you trust make an npz "
    "of its pose vectors, such as AIST++'s: python -c \"import pickle, numpy; "
    "d = pickle.load(open('x.pkl', 'rb')); numpy.savez('x.npz', poses=d['smpl_poses'], "
    "trans=d['smpl_trans'] / d['smpl_scaling'], mocap_frame_rate=60)\""
)
NO_MOTION = f"no motion in it; looked for {', '.join(MOTION_SUFFIXES)} and EasyMocap folders"
_GLTF = (".gltf", ".vrma", ".glb")
_SHOWN = 3
_GLANCE = 1 << 16


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
        yield from motions_here(here, folders, files)
    yield from trouble


def motions_here(here: Path, folders: list[str], files: Iterable[Path]) -> list[Path]:
    """Return the motions of one step of `visible_folders`: a folder that is a sequence, and files.

    The subfolders of a sequence that are parts of it are removed from `folders`.
    """
    motions = list(filter(is_motion, files))
    if is_sequence(here):
        motions.insert(0, here)
        folders[:] = [name for name in folders if name not in SUBFOLDERS]
    return motions


def motions_of(source: Path) -> list[Path]:
    """Return the motions of a path: itself, or all below a folder, without duplicates.

    Raises:
        ConfigError: a folder without motion.
    """
    if not source.is_dir() or is_sequence(source):
        return [source]
    motions = [path for path in motions_in(source) if not isinstance(path, OSError)]
    copies, _ = one_of_two_formats(motions)
    if not motions:
        raise ConfigError(f"{source}: {NO_MOTION}")
    return [path for path in motions if path not in copies]


def warn_unreadable(error: OSError) -> None:
    """Warn that a folder cannot be opened."""
    warnings.warn(f"{error.filename}: cannot open folder: {error.strerror}", stacklevel=2)


def visible_folders(
    folder: Path, unreadable: Callable[[OSError], None] = warn_unreadable
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
    if kind == "pkl":
        return _PICKLE
    if path.suffix.lower() in OTHER_MOTION_SUFFIXES:
        how = "from Blender" if kind != "fbx" else "by gesturekit convert x.fbx x.bvh, with Blender"
        return f"{kind} is not read; export it as bvh, for example {how}"
    return None


def is_sequence(path: Path) -> bool:
    """Return whether a folder, or its subfolder `smpl`, is an EasyMocap sequence."""
    return any(_has_frames(folder) for folder in (path, *(path / name for name in SUBFOLDERS)))


def is_motion(path: Path) -> bool:
    """Return whether a file is a motion, by its suffix and the content of an npz or glTF file."""
    suffix = path.suffix.lower()
    if suffix in _GLTF:
        try:
            return "animations" in Gltf(path).json  # no mere mesh or avatar
        except FormatError:
            return True  # the reader reports the error
    if suffix == ".npz":
        return not (is_feature_file(path) or is_body_model(path))
    return suffix in MOTION_SUFFIXES


def is_feature_file(path: Path) -> bool:
    """Return whether a file is an npz of speech features."""
    return _has_keys(path, "values", "times")


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


def one_of_two_formats(motions: Iterable[Path]) -> tuple[set[Path], list[str]]:
    """Return the motions that are duplicates, and lines about them.

    Of STEM.bvh and STEM.npz in one folder, the one with more data is read; of a glTF file and one
    of these, the other.
    """
    groups: dict[Path, dict[str, Path]] = {}
    for path in motions:
        groups.setdefault(path.with_suffix(""), {})[path.suffix.lower()] = path
    kept: dict[str, list[str]] = {".npz": [], ".bvh": []}
    copies = set()
    for group in groups.values():
        for suffix in _GLTF:
            if suffix in group and len(group) > 1:
                copies.add(group.pop(suffix))
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
    if others := sorted(str(path) for path in copies if path.suffix.lower() in _GLTF):
        lines.append(f"not read, for another file of the same name: {listed(others, _SHOWN)}")
    return copies, lines


_IN = {name: f"in-{name}" for name in ("unit", "up", "forward")}
"""Reader options that have another name on the command line."""
_OF_ANY_FORMAT = ("fps", "height")


def load(
    source: Path, options: Mapping[str, Any], parts: Mapping[str, str] | None = None
) -> Motion:
    """Read a motion of any format.

    Args:
        source: a file, or the folder of a sequence.
        options: options of the format's reader (others are ignored); `fps`, the true frame rate,
            which replaces that of the file; `height`, the body height in metres to scale to.
        parts: joints specified by hand, {"left_elbow": "Joint12"}, see `Skeleton.parts`.

    Raises:
        FormatError: it cannot be read.
        MotionError: `parts` names a joint that does not exist.
    """
    kind = format_of(source)
    if kind in OTHER_MOTION_SUFFIXES and kind not in READ_OPTIONS:
        raise FormatError(f"{source}: {unreadable_media(source)}")
    known = READ_OPTIONS.get(kind, ())
    motion = Motion.load(source, **{name: options[name] for name in options if name in known})
    motion = motion.with_parts(parts or {})
    if "height" in options:
        motion = motion.with_height(options["height"])
    return replace(motion, fps=options["fps"]) if "fps" in options else motion


def load_with_warnings(
    source: Path, options: Mapping[str, Any], parts: Mapping[str, str] | None = None
) -> tuple[Motion, list[str]]:
    """Read a motion as `load` does; return it with the warnings of its reader."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("ignore")
        warnings.simplefilter("always", UserWarning)
        motion = load(source, options, parts)
    return motion, [str(warning.message) for warning in caught]


def applicable_read_options(source: Path, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the `options` of `load` that have an effect on this source."""
    known = (*_OF_ANY_FORMAT, *READ_OPTIONS.get(format_of(source), ()))
    return {name: value for name, value in options.items() if name in known}


def applicable_write_options(kind: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the `options` of writers that the writer of a format ("bvh") has."""
    known = WRITE_OPTIONS.get(f".{kind.lower()}", ())
    return {name: value for name, value in options.items() if name in known}


def writer_options(formats: Sequence[str], options: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return, for each format, the options that its writer has: {"bvh": {"unit": "m"}}.

    Raises:
        ConfigError: an option that none of the formats has.
    """
    _refuse_unused(options, "written", (WRITE_OPTIONS, {f".{name}" for name in formats}))
    return {kind: applicable_write_options(kind, options) for kind in formats}


def refuse_unused_options(
    read: Mapping[str, Any],
    sources: Iterable[Path],
    write: Mapping[str, Any] = MappingProxyType({}),
    formats: Iterable[str] = (),
    body_model: str | os.PathLike[str] | None = None,
) -> None:
    """Refuse options that no reader of the sources and no writer of the formats has.

    Raises:
        ConfigError: an option would have no effect.
    """
    reads = READ_OPTIONS, {format_of(path) for path in sources}
    writes = WRITE_OPTIONS, {f".{name}" for name in formats}
    _refuse_unused([name for name in read if name not in _OF_ANY_FORMAT], "read", reads)
    _refuse_unused(write, "written", writes)
    if body_model is not None:
        _refuse_unused(["body_model"], "converted", reads, writes)


def _refuse_unused(
    options: Iterable[str], verb: str, *uses: tuple[Mapping[str, Collection[str]], set[str]]
) -> None:
    """Raise ConfigError for an option that none of the formats has.

    Args:
        options: their names.
        verb: what is done with the formats: "read", "written" or "converted".
        uses: pairs of a table of options by format, and the formats that are read or written.
    """
    formats = {form for _, used in uses for form in used}
    for name in options if formats else ():
        fitting = [form for table, _ in uses for form, known in table.items() if name in known]
        if not any(name in table.get(form, ()) for table, used in uses for form in used):
            option = f"--{_IN.get(name, name) if verb == 'read' else name}".replace("_", "-")
            of, only = ", ".join(dict.fromkeys(fitting)), ", ".join(sorted(formats))
            raise ConfigError(f"{option} is an option of {of}; only {only} is {verb}")


def describe_axes(info: Mapping[str, Any], guessed: str) -> list[str]:
    """Return unit and axes of a motion's file; `guessed` is appended to guesses."""
    words = []
    for key, text in (("unit", "{}"), ("up", "{} up"), ("forward", "{} forward")):
        if key in info:
            value = info[key] if key == "unit" else info[key].upper()
            words.append(text.format(value) + (guessed if key in info.get("guessed", ()) else ""))
    return words
