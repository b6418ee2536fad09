"""Summary of a training run."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

from gesturekit.errors import ConfigError, ModelError
from gesturekit.evaluation.definitions import DEFINITIONS
from gesturekit.inspection.model import readme_notes
from gesturekit.inspection.summary import Summary, size, span
from gesturekit.training.config import read_yaml
from gesturekit.training.run.folder import Checkpoints, is_running, resume_command
from gesturekit.wording import listed

_SETTINGS = ("system", "corpus", "longer", "fps", "joints", "seed", "device", "precision")


def inspect_run(folder: Path) -> Summary:
    """Summarise a run folder.

    Raises:
        ModelError: its configuration cannot be read.
    """
    try:
        config = read_yaml(folder / "config.yaml")
    except ConfigError as error:
        raise ModelError(f"not a run folder: {error}") from None
    checkpoints = Checkpoints(folder / "checkpoints")
    steps = checkpoints.steps()
    logged = _metrics(folder / "metrics.jsonl")
    last = logged[-1] if logged else {}
    written = [folder / "config.yaml", folder / "metrics.jsonl"]
    written += [checkpoints.path(step) for step in steps]
    silent = max(0.0, time.time() - max(p.stat().st_mtime for p in written if p.exists()))
    is_done = (folder / "model" / "config.yaml").is_file()
    facts: dict[str, Any] = {
        "path": str(folder),
        "state": "finished" if is_done else "running" if is_running(folder) else "stopped",
        "silent_seconds": silent,
        "step": last.get("step"),
        "losses": next((line for line in reversed(logged) if "kind" not in line), {}),
        "metrics": next((line for line in reversed(logged) if "verdict" in line), {}),
        "notes": readme_notes(folder / "model" / "README.md"),
        "checkpoints": steps,
        "config": config,
        "command": _text(folder / "command.txt"),
        "versions": _versions(folder / "versions.json"),
        "bytes": sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()),
    }
    return Summary(
        kind="run",
        title=f"{folder}: training run, {facts['state']}, {size(facts['bytes'])}",
        facts=facts,
        rows=tuple(_rows(folder, facts)),
    )


def _rows(folder: Path, facts: dict[str, Any]) -> list[tuple[str, str]]:
    ago = f"last written {span(facts['silent_seconds'])} ago"
    state = {
        "finished": f"finished; its model is {folder / 'model'}",
        "running": f"running: {ago}",
        "stopped": f"not finished and not running, {ago}; {resume_command(folder)}",
    }[facts["state"]]
    losses = [
        f"{key} {value if isinstance(value, int) else f'{value:.3g}'}"
        for key, value in facts["losses"].items()
        if key != "step" and isinstance(value, int | float)
    ]
    settings = [
        f"{key} {facts['config'][key]}" for key in _SETTINGS if facts["config"].get(key) is not None
    ]
    shown = [
        ("state", state),
        ("verdict", str(facts["metrics"].get("verdict", ""))),
        ("step", "none logged yet" if facts["step"] is None else str(facts["step"])),
        ("recordings", facts["notes"].get("Recordings")),
        ("losses", ", ".join(losses)),
        ("metrics", _headline(folder, facts["metrics"])),
        (
            "checkpoints",
            f"{len(facts['checkpoints'])}: steps {listed(list(map(str, facts['checkpoints'])))}"
            if facts["checkpoints"]
            else "none",
        ),
        ("settings", ", ".join(settings)),
        ("command", facts["command"]),
        ("made with", ", ".join(f"{key} {value}" for key, value in facts["versions"].items())),
    ]
    return [(label, text) for label, text in shown if text]


def _headline(folder: Path, metrics: dict[str, Any]) -> str:
    """Return the metrics at the head of a report, and where the others are."""
    shown = []
    for key in (key for key, entry in DEFINITIONS.items() if entry.group == "Headline"):
        names = [f"{metrics.get('kind')}/{key}{of}" for of in ("", "_recording")]
        value, recording = (metrics.get(name) for name in names)
        if isinstance(value, int | float):
            of = f" (recordings {recording:.3g})" if isinstance(recording, int | float) else ""
            shown.append(f"{key} {value:.3g}{of}")
    where = f"all of them: {folder / 'report.html'}, {folder / 'metrics.jsonl'}"
    return f"{', '.join(shown)}; {where}" if shown else ""


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


def _versions(path: Path) -> dict[str, str]:
    try:
        values = json.loads(_text(path) or "{}")
    except (ValueError, RecursionError):
        return {}
    wanted = ("gesturekit", "python", "torch")
    return {key: values[key] for key in wanted if key in values} if isinstance(values, dict) else {}


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError):
        return ""
