"""Summaries of model folders, without loading their networks, and of training runs."""

from __future__ import annotations

import json
import math
import re
import time
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open

from gesturekit.errors import ConfigError, ModelError
from gesturekit.inspection.summary import Summary, size, span
from gesturekit.motion.skeleton import Skeleton
from gesturekit.training.config import read_yaml
from gesturekit.training.run_folder import is_running, read_rig, resume_command
from gesturekit.wording import listed

_NOTE = re.compile(r"- \*\*(.+?)\*\*: (.*)")
_SETTINGS = ("system", "corpus", "longer", "fps", "joints", "seed", "device", "precision")
_NONE: dict[str, Any] = {}


def inspect_model(folder: Path) -> Summary:
    """Summarise a model folder: the notes of its README, and the size of its network.

    Raises:
        ModelError: a part of it is missing or damaged.
    """
    path = folder / "config.yaml"
    try:
        config = read_yaml(path)
        path = folder / "skeleton.json"
        Skeleton.from_json(read_rig(folder)["skeleton"])
        path = folder / "model.safetensors"
        shapes = _shapes(path)
    except (OSError, ValueError, LookupError, TypeError, RecursionError, SafetensorError) as error:
        raise ModelError(f"{folder}: {path.name} is missing or damaged ({error!r})") from None
    n_parameters = sum(math.prod(shape) for shape in shapes)
    notes = readme_notes(folder / "README.md")
    facts = {"path": str(folder), "config": config, "notes": notes, "parameters": n_parameters}
    rows = {label.lower(): text for label, text in notes.items()}
    rows |= {"network": _settings(config.get("network", {})), "parameters": f"{n_parameters:,}"}
    n_bytes = sum(file.stat().st_size for file in folder.iterdir() if file.is_file())
    title = f"{folder}: model, {config.get('kind')}, {size(n_bytes)}"
    return Summary("model", title, facts, rows)


def _settings(values: dict[str, Any]) -> str:
    texts = {k: "-".join(map(str, v)) if isinstance(v, list) else v for k, v in values.items()}
    return ", ".join(f"{key} {text}" for key, text in texts.items())


def _shapes(path: Path) -> list[list[int]]:
    """Return the shapes of the network's tensors, from the header of the file alone."""
    with safe_open(path, framework="numpy") as file:
        names = [name for name in file.keys() if name.startswith("network.")]  # noqa: SIM118
        return [file.get_slice(name).get_shape() for name in names]


def readme_notes(readme: Path) -> dict[str, str]:
    """Return {label: text} of the README's notes on the training; empty without a README."""
    matches = map(_NOTE.fullmatch, _text(readme).splitlines())
    return {match[1]: match[2] for match in matches if match}


def inspect_run(folder: Path) -> Summary:
    """Summarise a run folder.

    Raises:
        ModelError: its configuration cannot be read.
    """
    # Modules that take long to import, which no summary of a model needs.
    from gesturekit.evaluation.definitions import DEFINITIONS
    from gesturekit.training.run_folder import Checkpoints

    try:
        config = read_yaml(folder / "config.yaml")
    except ConfigError as error:
        raise ModelError(f"not a run folder: {error}") from None
    checkpoints = Checkpoints(folder / "checkpoints")
    steps, logged = checkpoints.steps(), _metrics(folder / "metrics.jsonl")
    written = [folder / "config.yaml", folder / "metrics.jsonl", *map(checkpoints.path, steps)]
    silent = max(0.0, time.time() - max(p.stat().st_mtime for p in written if p.exists()))
    ago = f"last written {span(silent)} ago"
    state, words = "stopped", f"not finished and not running, {ago}; {resume_command(folder)}"
    if (folder / "model" / "config.yaml").is_file():
        state, words = "finished", f"finished; its model is {folder / 'model'}"
    elif is_running(folder):
        state, words = "running", f"running: {ago}"
    losses = next((line for line in reversed(logged) if "kind" not in line), _NONE)
    metrics = next((line for line in reversed(logged) if "verdict" in line), _NONE)
    headline = [key for key, entry in DEFINITIONS.items() if entry.group == "Headline"]
    heads = [f"{key}{of}" for key in headline for of in ("", "_recording")]
    settings = {key: config[key] for key in _SETTINGS if config.get(key) is not None}
    rows = {
        "state": words,
        "verdict": str(metrics.get("verdict", "")),
        "step": str(logged[-1].get("step")) if logged else "none logged yet",
        "losses": _numbers({key: value for key, value in losses.items() if key != "step"}),
        "metrics": _numbers({key: metrics.get(f"{metrics.get('kind')}/{key}") for key in heads}),
        "checkpoints": f"of steps {listed(list(map(str, steps)))}" if steps else "none",
        "settings": _settings(settings),
        "command": _text(folder / "command.txt"),
    }
    facts = {"path": str(folder), "state": state, "silent_seconds": silent, "losses": losses}
    facts |= {"metrics": metrics, "checkpoints": steps, "config": config}
    return Summary("run", f"{folder}: training run, {state}", facts, rows)


def _numbers(values: dict[str, Any]) -> str:
    # Whole numbers of any length are JSON.
    is_short = {k: not isinstance(v, int) or abs(v) < 2**63 for k, v in values.items()}
    known = {k: v for k, v in values.items() if isinstance(v, int | float) and is_short[k]}
    return ", ".join(f"{key.replace('_', ' ')} {value:.3g}" for key, value in known.items())


def _metrics(path: Path) -> list[dict[str, Any]]:
    lines = []
    for line in _text(path).splitlines():
        try:
            values = json.loads(line)
        except (ValueError, RecursionError):
            continue  # the line that was being written when the run was killed
        if isinstance(values, dict):
            lines.append(values)
    return lines


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError):
        return ""
