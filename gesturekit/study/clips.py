"""Clips of a study: one of each system for each speech segment."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from gesturekit.corpus.pairing import scan
from gesturekit.errors import ConfigError
from gesturekit.evaluation.pairs import grouped
from gesturekit.formats.sources import visible_folders
from gesturekit.study.config import StudyConfig
from gesturekit.wording import counted, listed

VIDEOS = (".mp4", ".webm", ".m4v")
_WORD = re.compile(r"[^\W_]+")


@dataclass(frozen=True, eq=False)
class Segment:
    """A speech segment with the clip of every system.

    Attributes:
        name: path of its clips without suffix; `input_code` in the answers.
        clips: {system: file}.
        sound: the speech, for motions; None if silent.
        style: the style in its question; "" in other designs.
    """

    name: str
    clips: dict[str, Path]
    sound: Path | None
    style: str

    @property
    def speaker(self) -> str:
        """Folder of the clips: mismatched motion is of the same folder."""
        return self.name.rpartition("/")[0]

    @property
    def is_video(self) -> bool:
        """True if the clips, of all segments, are videos; else they are motions."""
        return next(iter(self.clips.values())).suffix.lower() in VIDEOS


def find_clips(config: StudyConfig) -> tuple[Segment, ...]:
    """Find the clips of a study.

    Warns:
        UserWarning: segments that not all systems have, or without sound or style.

    Raises:
        ConfigError: a missing folder, videos and motions mixed, no common segment.
    """
    clips = {name: _in_folder(name, Path(folder)) for name, folder in config.systems.items()}
    kinds = {
        name: "videos" if next(iter(found.values())).suffix.lower() in VIDEOS else "motions"
        for name, found in clips.items()
    }
    if len(set(kinds.values())) > 1:
        mixed = ", ".join(f"{name}: {kind}" for name, kind in kinds.items())
        raise ConfigError(f"systems: all need clips of one kind, videos or motions ({mixed})")
    if not set.intersection(*map(set, clips.values())):
        clips = {name: _by_stem(found) for name, found in clips.items()}
    common = sorted(set.intersection(*map(set, clips.values())))
    if not common:
        some = {name: next(iter(found), "none") for name, found in clips.items()}
        raise ConfigError(f"systems: no clip of the same name in all folders; found {some}")
    for name, found in clips.items():
        _warn(f"{name}: left out, as other systems lack them:", set(found) - set(common))
    sounds = {} if "videos" in kinds.values() else _sounds(config, common)
    styles = {key: _style_of(key, config.styles) for key in common}
    if config.styles:
        nameless = [key for key in common if not styles[key]]
        _warn("left out, as their names hold none of the styles:", nameless)
    segments = [
        Segment(key, {name: clips[name][key] for name in clips}, sounds.get(key), styles[key])
        for key in common
        if (not sounds or key in sounds) and (styles[key] or not config.styles)
    ]
    if not segments:
        raise ConfigError("no segment is left for the study")
    return tuple(segments)


def _in_folder(system: str, folder: Path) -> dict[str, Path]:
    """Return {relative path without suffix: clip}; videos if there are any, else motions."""
    if not folder.is_dir():
        raise ConfigError(f"systems: {system}: {folder} is not a folder")
    files = [path for _, _, inside in visible_folders(folder) for path in inside]
    found = [path for path in files if path.suffix.lower() in VIDEOS]
    if not found:
        found = [item.path for item in scan(folder)[0] if not item.is_speech]
    if not found:
        raise ConfigError(f"systems: {system}: {folder} has no mp4, webm, bvh or npz")
    return {path.relative_to(folder).with_suffix("").as_posix(): path for path in found}


def _by_stem(clips: dict[str, Path]) -> dict[str, Path]:
    """Return clips by their unique stems, given by relative path."""
    stems = grouped((key.rpartition("/")[2], path) for key, path in clips.items())
    return {stem: paths[0] for stem, paths in stems.items() if len(paths) == 1}


def _sounds(config: StudyConfig, keys: Iterable[str]) -> dict[str, Path]:
    """Return {segment: sound}; empty where the study is silent."""
    if config.is_silent:
        return {}
    if config.audio is None:
        if config.design == "mismatch":
            raise ConfigError("audio: the design mismatch needs a folder of speech for motions")
        return {}
    speech = {item.key: item.path for item in scan(config.audio)[0] if item.is_speech}
    stems = _by_stem(speech)
    found = {key: speech.get(key) or stems.get(key.rpartition("/")[2]) for key in keys}
    missing = [key for key, path in found.items() if path is None]
    if len(missing) == len(found):
        raise ConfigError(
            f"audio: {config.audio} has no sound named like the clips, such as {missing[0]}.wav: "
            "give the folder of wavs that the clips were rendered from; clips rendered with "
            "--corpus from parts of recordings (NAME@START-END) have none"
        )
    _warn(f"left out, as {config.audio} has no sound of them:", missing)
    return {key: path for key, path in found.items() if path is not None}


def _style_of(key: str, styles: Iterable[str]) -> str:
    """Return the style that the longest name in a path tells; "" for none."""
    named = [style for style in styles if _words(style) in _words(key)]
    return max(named, key=len, default="")


def _words(text: str) -> str:
    """Return the words of a name in lower case, with a space before and after each."""
    return f" {' '.join(_WORD.findall(text.lower()))} "


def _warn(what: str, keys: Iterable[str]) -> None:
    keys = sorted(keys)
    if keys:
        warnings.warn(f"{counted(len(keys), 'clip')} {what} {listed(keys)}", stacklevel=3)
