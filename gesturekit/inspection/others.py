"""Summaries of feature files and of other known files, and what to do with them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import audio_features as af
from audio_features.files import open_npy
from gesturekit.formats.registry import A_JSON_FILE, REPORT_IN_WORDS, is_report, kind_by_content
from gesturekit.formats.sources import is_feature_file, visible_folders
from gesturekit.inspection.summary import Summary, size, span
from gesturekit.training.config import read_yaml
from gesturekit.wording import counted, listed

_READ_HERE = ("BVH", "wav", "flac", "ogg", "npz")
_GLANCE = 4096  # bytes
_OUR_PAGE = b'<meta name="generator" content="gesturekit">'
_IN_RUN = ("command.txt", "versions.json", "metrics.jsonl")
_IN_MODEL = ("model.safetensors", "skeleton.json", "README.md", "trained_on.json")
_IN_DATA = ("data.json", "data.safetensors")
_IN_FEATURE_MODEL = ("feature_model.json", "feature_model.safetensors")
_TABLES = {  # columns in the first line
    ("time", "name"): "a table of events, which goes with a recording as STEM.events.csv",
    ("time", "x", "z"): "a path of the root, which goes with a recording as STEM.path.csv, or to "
    "render --path",
}


def what_it_is(path: Path) -> str | None:
    """Describe a file and what to do with it; return None for an unknown file.

    Raises:
        OSError: it cannot be read.
        ConfigError: a configuration that is no YAML.
    """
    if whole := _part_of(path):
        return whole
    with path.open("rb") as file:
        start = file.read(_GLANCE)
    if _OUR_PAGE in start:
        return "a page that gesturekit wrote (a player or a report); open it in a browser"
    suffix = path.suffix.lower()
    if suffix == ".obj" and start.startswith(b"v "):
        return "a mesh (OBJ), the skin of one frame; open it in Blender"
    if suffix == ".csv":
        columns = start.decode("utf-8-sig", "replace").partition("\n")[0].lower().split(",")
        names = {column.strip() for column in columns}
        return next((text for known, text in _TABLES.items() if names.issuperset(known)), None)
    if (what := kind_by_content(start)) is None:
        return None
    if what == A_JSON_FILE and suffix == ".json" and is_report(path):
        return REPORT_IN_WORDS
    if any(kind in what for kind in _READ_HERE):
        return f"looks like {what} inside; give it the suffix of one"
    return what


def _part_of(path: Path) -> str | None:
    """Describe a file that is part of a model, run or feature model; else return None."""
    folder, name = path.parent, path.name
    if name in _IN_FEATURE_MODEL:
        return f"part of a feature model of fit-features; give its folder, {folder}, to evaluate"
    if path.suffix == ".pt" and folder.name == "checkpoints":
        return f"a checkpoint of a run; inspect its folder, {folder.parent}"
    if name.startswith("events.out.tfevents"):
        return f"the log of a run, for TensorBoard: tensorboard --logdir {folder}"
    has = {name for name in (*_IN_RUN, *_IN_MODEL) if (folder / name).exists()}
    if (folder / "config.yaml").is_file() and (name in has or (name == "config.yaml" and has)):
        return f"part of a model or a run; inspect its folder, {folder}"
    if name in _IN_DATA and (folder.parent / "config.yaml").is_file():
        return f"the prepared data of a run; inspect its folder, {folder.parent}"
    if name == "trained_on.json":
        return "the list of recordings that a model was trained on; it belongs into its folder"
    if path.suffix in (".yaml", ".yml"):
        if "systems" in read_yaml(path):
            return f"a user study; gesturekit study build {path} makes its page"
        return f"a configuration; gesturekit train {path} trains with it"
    return None


_SHOWN = 12


def inspect_features(path: Path) -> Summary:
    """Summarise a feature file (npz of values, times and spec).

    Raises:
        FeatureError: it cannot be read.
    """
    track = af.FeatureTrack.load(path)
    n_frames, n_columns = track.values.shape
    step = float(np.median(np.diff(track.times))) if n_frames > 1 else None
    mean, spread = track.values.mean(axis=0), track.values.std(axis=0)
    facts = {
        "path": str(path),
        "bytes": path.stat().st_size,
        "frames": n_frames,
        "columns": n_columns,
        "names": list(track.names),
        "first": float(track.times[0]),
        "last": float(track.times[-1]),
        "rate": 1 / step if step else None,
        "spec": track.spec,
        "mean": mean,
        "sd": spread,
    }
    rows = [
        (
            "time",
            f"{span(track.times[-1] - track.times[0])}: {counted(n_frames, 'frame')}"
            + (f" at {1 / step:.6g} a second" if step else "")
            + f", centred from {track.times[0]:.4f} to {track.times[-1]:.4f} s",
        ),
        ("columns", f"{n_columns}: {listed(track.names, _SHOWN)}"),
        ("values", f"{track.values.min():.4g} to {track.values.max():.4g}"),
        ("made by", json.dumps(track.spec, ensure_ascii=False) if track.spec else "unknown"),
    ]
    still = [name for name, sd in zip(track.names, spread) if sd == 0]
    problems = (f"never change: {listed(still, _SHOWN)}",) if still and n_frames > 1 else ()
    return Summary(
        kind="features",
        title=f"{path}: features of a sound, {size(facts['bytes'])}",
        facts=facts,
        rows=tuple(rows),
        problems=problems,
    )


def feature_files(folder: Path) -> Iterator[Path]:
    """Yield the npz files of speech features below a folder."""
    every = (path for _, _, files in visible_folders(folder) for path in files)
    yield from (path for path in every if path.suffix.lower() == ".npz" and is_feature_file(path))


def inspect_feature_folder(folder: Path) -> Summary:
    """Summarise a folder of feature files, of which the first is read.

    Raises:
        FeatureError: the first cannot be read.
    """
    files = list(feature_files(folder))
    first = inspect_features(files[0])
    names = [path.relative_to(folder).as_posix() for path in files]
    return Summary(
        kind="features",
        title=f"{folder}: features of {counted(len(files), 'sound')}",
        facts={"path": str(folder), "files": names, "first": first.facts},
        rows=(("files", listed(names, _SHOWN)), *first.rows[1::2]),  # columns, made by
    )


_BLOCK = 1 << 20
"""Values that are checked at a time."""


def inspect_array(path: Path) -> Summary:
    """Summarise an npy file of own features, which stays on disk.

    Raises:
        FeatureError: it holds no array of plain values.
    """
    try:
        values = open_npy(path)
    except af.FeatureError as error:
        raise af.FeatureError(f"{path}: {error}") from None
    shape, dtype = values.shape, str(values.dtype)
    n_bytes = path.stat().st_size
    facts = {"path": str(path), "bytes": n_bytes, "shape": list(shape), "dtype": dtype}
    rows = [("shape", f"{shape}, {dtype}")]
    if values.ndim == 2:
        n_rows, n_columns = counted(shape[0], "row"), counted(shape[1], "column")
        setting = f"{{kind: files, dim: {shape[1]}, suffix: .npy, rate: ROWS PER SECOND}}"
        rows = [("shape", f"{n_rows}, {n_columns}, {dtype}"), ("train with", setting)]
    problems = [] if values.size else ["no values"]
    if values.dtype.kind in "fiub":
        facts |= _not_finite(values)
        counts = {"NaN": facts["nan"], "infinite": facts["infinite"]}
        problems += [f"{n} of {values.size} values are {name}" for name, n in counts.items() if n]
    else:
        problems.append(f"{dtype} is no number: save plain numbers")
    title = f"{path}: an array without times, {size(n_bytes)}"
    return Summary("features", title, facts, tuple(rows), problems=tuple(problems))


def _not_finite(values: np.ndarray) -> dict[str, int]:
    """Return the numbers of NaN and of infinite values, without copying the array."""
    flat, found = values.ravel(order="K"), {"nan": 0, "infinite": 0}
    for start in range(0, flat.size, _BLOCK):
        block = flat[start : start + _BLOCK]
        found["nan"] += int(np.isnan(block).sum())
        found["infinite"] += int(np.isinf(block).sum())
    return found
