"""Recognition of the kind of a path, and dispatch to its summary."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from gesturekit.corpus.pairing import scan
from gesturekit.errors import ConfigError, FormatError
from gesturekit.formats.registry import A_JSON_FILE, MOTION_SUFFIXES
from gesturekit.formats.sources import (
    SPEECH_SUFFIXES,
    is_body_model,
    is_feature_file,
    is_sequence,
    unreadable_media,
)
from gesturekit.inspection.others import (
    feature_files,
    inspect_array,
    inspect_feature_folder,
    inspect_features,
    what_it_is,
)
from gesturekit.inspection.summary import Summary
from gesturekit.systems import bundled_models, model_folder
from gesturekit.training.config import read_yaml
from gesturekit.training.recipes import is_copy
from gesturekit.training.run.state import unfinished

_JSON = {".json": "motion", ".jsonl": "corpus"}
_KNOWN = (
    "motion (.bvh, .npz, .glb, EasyMocap folders), avatars (.vrm), sound (.wav, .flac, ...), "
    "feature files (.npz, .npy) and folders of them, manifests (.jsonl), model, run and corpus "
    "folders"
)


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
    kind = kind_of(path)
    if kind == "motion":
        from gesturekit.inspection.motion import inspect_motion

        return inspect_motion(Path(path), parts=parts, **dict(read or {}))
    if kind == "corpus" and Path(path).is_dir():
        from gesturekit.inspection.corpus import inspect_recordings

        return inspect_recordings(Path(path), parts=parts, read=read, progress=progress)
    if kind == "other":
        text = _recognised(Path(path))
        return Summary("other", f"{path}: {text}", {"path": str(path), "what": text})
    if parts or read:
        raise ConfigError(f"{path}: a {kind}; only motion has parts, axes, a unit and a height")
    if kind == "model":
        from gesturekit.inspection.model import inspect_model

        return inspect_model(model_folder(path))
    if kind == "run":
        from gesturekit.inspection.run import inspect_run

        return inspect_run(Path(path))
    if kind == "audio":
        from gesturekit.inspection.audio import inspect_audio

        return inspect_audio(Path(path))
    if kind == "features":
        if Path(path).is_dir():
            return inspect_feature_folder(Path(path))
        is_npy = Path(path).suffix.lower() == ".npy"
        return (inspect_array if is_npy else inspect_features)(Path(path))
    from gesturekit.inspection.corpus import inspect_manifest

    return inspect_manifest(Path(path))


def kind_of(path: str | Path) -> str:
    """Return motion, audio, features, model, corpus or run; "other" for other known files.

    Raises:
        FormatError: none of these.
    """
    if str(path) in bundled_models():
        return "model"
    path = Path(path)
    if path.is_dir():
        return _kind_of_folder(path)
    if not path.exists():
        if why := unfinished(path):
            raise FormatError(why)
        raise FormatError(
            f"{path}: no such file or folder, and no bundled model ({', '.join(bundled_models())})"
        )
    if not path.is_file():
        raise FormatError(f"{path}: not a regular file")
    suffix = path.suffix.lower()
    if suffix == ".npy" or (suffix == ".npz" and is_feature_file(path)):
        return "features"
    if suffix == ".npz" and is_body_model(path):
        return "other"
    if suffix in (*MOTION_SUFFIXES, ".vrm"):  # of an avatar, the rig
        return "motion"
    if suffix in SPEECH_SUFFIXES:
        return "audio"
    if reason := unreadable_media(path):
        raise FormatError(f"{path}: {reason}")
    try:
        what = what_it_is(path)
    except OSError as error:
        raise FormatError(f"{path}: {error.strerror}") from None
    if suffix in _JSON and what in (None, A_JSON_FILE):
        return _JSON[suffix]  # its reader says what it is where it is something else
    if what is None:
        raise FormatError(f"{path}: not recognised; gesturekit inspects {_KNOWN}")
    return "other"


def _recognised(path: Path) -> str:
    """Describe a path of kind "other"."""
    if is_copy(path):
        return f"a recipe; gesturekit train {path} trains it"
    if path.is_dir():
        return "a feature model of fit-features; give it to evaluate"
    if path.suffix.lower() == ".npz":
        return "a body model of the SMPL family; give it as --body-model with a motion"
    return what_it_is(path) or ""


def _kind_of_folder(folder: Path) -> str:
    if (folder / "config.yaml").is_file():
        if "kind" in read_yaml(folder / "config.yaml"):
            return "model"
        return "other" if is_copy(folder) else "run"
    if is_sequence(folder):
        return "motion"
    if (folder / "feature_model.json").is_file():
        return "other"
    found, _ = scan(folder)
    if found:
        return "corpus"
    if any(feature_files(folder)):  # reads no more than the first
        return "features"
    raise FormatError(f"{folder}: not a folder that gesturekit recognises; it inspects {_KNOWN}")
