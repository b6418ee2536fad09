"""Summaries of motion, sound, features, models, corpora and runs, on one screen."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from gesturekit.corpus.pairing import scan
from gesturekit.errors import ConfigError, FormatError
from gesturekit.formats.registry import (
    A_JSON_FILE,
    MOTION_SUFFIXES,
    REPORT_IN_WORDS,
    is_report,
    kind_by_content,
)
from gesturekit.formats.sources import (
    SPEECH_SUFFIXES,
    is_body_model,
    is_feature_file,
    is_sequence,
    unreadable_media,
)
from gesturekit.inspection.sound import feature_files, inspect_audio, inspect_features
from gesturekit.inspection.summary import Summary
from gesturekit.systems import bundled_models, model_folder
from gesturekit.training.config import read_yaml
from gesturekit.training.recipes import is_copy
from gesturekit.training.run_folder import unfinished

__all__ = ["Summary", "inspect"]


_KNOWN = (
    "motion (.bvh, .npz, .glb, EasyMocap folders), avatars (.vrm), sound (.wav, .flac, ...), "
    "feature files (.npz, .npy) and folders of them, manifests (.jsonl), model, run and corpus "
    "folders"
)
_GLANCE = 4096  # bytes
_OUR_PAGE = b'<meta name="generator" content="gesturekit">'
_JSON = {".json": "motion", ".jsonl": "corpus"}


def inspect(
    path: str | Path,
    *,
    parts: Mapping[str, str] | None = None,
    read: Mapping[str, Any] | None = None,
    progress: Callable[[list[Any]], Iterable[Any]] = iter,
) -> Summary:
    """Summarise a file, a folder, or a bundled model.

    Args:
        path: motion, avatar, sound, features, model (folder or bundled name), corpus (manifest or
            folder of recordings), or run.
        parts: for motion: body parts assigned by hand, {"left_elbow": "Joint12"}.
        read: for motion: options of its reader, such as `up`.
        progress: wraps the list of a folder's recordings while they are read, as tqdm does.

    Raises:
        GestureKitError: it is none of these, or broken.
        AudioFeaturesError: a sound or feature file that is broken.
    """
    path = model_folder(path) if str(path) in bundled_models() else Path(path)
    kind = _kind_of(path)
    if kind == "motion":
        from gesturekit.inspection.motion import inspect_motion

        return inspect_motion(path, parts=parts, **dict(read or {}))
    if kind == "corpus":
        from gesturekit.inspection.corpus import inspect_manifest, inspect_recordings

        if path.is_dir():
            return inspect_recordings(path, parts=parts, read=read, progress=progress)
    if parts or read:
        raise ConfigError(f"{path}: {kind}; only motion has parts, axes, a unit and a height")
    if kind == "corpus":
        return inspect_manifest(path)
    if kind in ("model", "run"):
        from gesturekit.inspection.model import inspect_model, inspect_run

        return inspect_model(path) if kind == "model" else inspect_run(path)
    if kind == "audio":
        return inspect_audio(path)
    if kind == "features":
        return inspect_features(path)
    return Summary("other", f"{path}: {kind}", {"path": str(path), "what": kind}, {})


def _kind_of(path: Path) -> str:
    """Return motion, audio, features, model, corpus or run; other known files in words.

    Raises:
        FormatError: none of these.
    """
    if path.is_dir():
        return _kind_of_folder(path)
    if not path.exists():
        models = ", ".join(bundled_models())
        reason = f"{path}: no such file or folder, and no bundled model ({models})"
        raise FormatError(unfinished(path) or reason)
    if not path.is_file():
        raise FormatError(f"{path}: not a regular file")
    suffix = path.suffix.lower()
    if suffix == ".npy" or (suffix == ".npz" and is_feature_file(path)):
        return "features"
    if suffix == ".npz" and is_body_model(path):
        return "a body model of the SMPL family; give it as --body-model with a motion"
    if suffix in (*MOTION_SUFFIXES, ".vrm"):  # of an avatar, the rig
        return "motion"
    if suffix in SPEECH_SUFFIXES:
        return "audio"
    try:
        problem = unreadable_media(path)
        what = None if problem else _in_words(path)
    except OSError as error:
        problem, what = str(error.strerror), None
    if not problem and suffix in _JSON and what in (None, A_JSON_FILE):
        return _JSON[suffix]  # its reader says what it is where it is something else
    if what is None:
        problem = problem or f"not recognised; gesturekit inspects {_KNOWN}"
        raise FormatError(f"{path}: {problem}")
    return what


def _kind_of_folder(folder: Path) -> str:
    if (folder / "config.yaml").is_file():
        if "kind" in read_yaml(folder / "config.yaml"):
            return "model"
        return f"a recipe; gesturekit train {folder} trains it" if is_copy(folder) else "run"
    if is_sequence(folder):
        return "motion"
    if (folder / "feature_model.safetensors").is_file():
        return "a feature model of fit-features; give it to evaluate"
    recordings, _ = scan(folder)
    if recordings:
        return "corpus"
    if any(feature_files(folder)):  # reads no more than the first
        return "features"
    raise FormatError(f"{folder}: not a folder that gesturekit recognises; it inspects {_KNOWN}")


def _in_words(path: Path) -> str | None:
    """Describe a file and what to do with it; return None for an unknown file."""
    suffix = path.suffix.lower()
    for folder in path.parents[:2]:
        if any((folder / name).is_file() for name in ("model.safetensors", "versions.json")):
            return f"part of a model or a run; inspect its folder, {folder}"
    if suffix in (".yaml", ".yml"):
        if "systems" in read_yaml(path):
            return f"a user study; gesturekit study build {path} makes its page"
        return f"a configuration; gesturekit train {path} trains with it"
    with path.open("rb") as file:
        start = file.read(_GLANCE)
    if _OUR_PAGE in start:
        return "a page that gesturekit wrote (a player or a report); open it in a browser"
    what = kind_by_content(start)
    if what == A_JSON_FILE and suffix == ".json" and is_report(path):
        return REPORT_IN_WORDS
    return what
