"""Summary of a model folder, without loading its networks or WavLM."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open

from audio_features.extractor import needs_of
from gesturekit.errors import ConfigError, GestureKitError, ModelError
from gesturekit.inspection.summary import Summary, size
from gesturekit.model import rate_text, reduction_text
from gesturekit.motion.skeleton import Skeleton
from gesturekit.training.config import read_yaml
from gesturekit.wording import counted, listed

_NOTE = re.compile(r"- \*\*(.+?)\*\*: (.*)")
_SHOWN_ABOVE = {"Kind", "Motion", "Speech features", "Needs", "Reduced features", "Styles"}
_OF_CONFORMERS = {
    "layers",
    "heads",
    "feedforward",
    "kernels",
    "nearest_view",
    "farthest_view",
    "dropout",
}
"""Settings of a diffusion network that its diffwave architecture does not use."""


def inspect_model(folder: Path) -> Summary:
    """Summarise a model folder.

    Raises:
        ModelError: a part of it is missing or damaged.
    """
    try:
        config = read_yaml(folder / "config.yaml")
        rig = json.loads((folder / "skeleton.json").read_bytes())
        skeleton = Skeleton.from_json(rig["skeleton"])
        shapes = _tensors(folder / "model.safetensors")
        fps, joints, features = float(config["fps"]), list(config["joints"]), config["features"]
        recorded_fps = float(config["recorded_fps"])
    except FileNotFoundError as error:
        # safetensors does not say which file it missed.
        missing = Path(error.filename or "model.safetensors").name
        raise ModelError(f"{folder}: the model lacks {missing}") from None
    except (ConfigError, GestureKitError) as error:
        raise ModelError(f"{folder}: {error}") from None
    except json.JSONDecodeError as error:
        raise ModelError(f"{folder}: skeleton.json is damaged ({error})") from None
    except (KeyError, TypeError, ValueError, OSError, RecursionError) as error:
        raise ModelError(f"{folder}: the model is damaged ({error!r})") from None
    if features is None:  # a model without speech input
        features = {}
    if not isinstance(features, dict):
        raise ModelError(f"{folder / 'config.yaml'}: features is {features!r}, expected a mapping")
    weights = {name: shape for name, shape in shapes.items() if name.startswith("network.")}
    facts: dict[str, Any] = {
        "path": str(folder),
        "format": config.get("format"),
        "model_kind": config.get("kind"),
        "fps": fps,
        "recorded_fps": recorded_fps,
        "joints": joints,
        "recorded_joints": _recorded_joints(config),
        "skeleton": list(skeleton.names),
        "features": features,
        "needs": needs_of(features.get("spec")),
        "components": shapes.get("features.components"),
        "styles": [str(name) for name in config.get("styles") or ()],
        "network": _used(config.get("network", {})),
        "parameters": sum(math.prod(shape) for shape in weights.values()),
        "bytes": sum(file.stat().st_size for file in folder.iterdir() if file.is_file()),
        "speakers": sorted(rig.get("speakers", {})),
        "notes": readme_notes(folder / "README.md"),
    }
    return Summary(
        kind="model",
        title=f"{folder}: model, {facts['model_kind']}, format {facts['format']}, "
        f"{size(facts['bytes'])}",
        facts=facts,
        rows=tuple(_rows(facts, skeleton)),
    )


def _recorded_joints(config: Any) -> list[str]:
    """Return the joints, such as fingers, that are played from recordings, not modelled."""
    for key in ("recorded", "passive", "joints"):
        config = config.get(key) if isinstance(config, dict) else None
    return [str(name) for name in config] if isinstance(config, list) else []


def _rows(facts: dict[str, Any], skeleton: Skeleton) -> list[tuple[str, str]]:
    recorded = facts["recorded_joints"]
    still = [name for name in skeleton.names if name not in {*facts["joints"], *recorded}]
    rows = [
        (
            "moves",
            f"{len(facts['joints'])} of {counted(skeleton.n_joints, 'joint')} at "
            + rate_text(facts["fps"], facts["recorded_fps"])
            + (f"; {len(recorded)} more from recordings: {listed(recorded, 4)}" if recorded else "")
            + (f"; not {listed(still, 4)}" if still else ""),
        ),
        ("speech features", _speech_features(facts["features"].get("spec"))),
        *(("needs", need) for need in facts["needs"]),
    ]
    if facts["components"]:
        rows.append(("reduced features", reduction_text(facts["components"])))
    rows += [
        ("network", _settings(facts["network"])),
        ("parameters", f"{facts['parameters']:,}"),
    ]
    if facts["styles"]:
        rows.append(("styles", listed(facts["styles"], 12)))
    if facts["speakers"]:
        rows.append(("speakers", listed(facts["speakers"], 12)))
    rows += [(k.lower(), v) for k, v in facts["notes"].items() if k not in _SHOWN_ABOVE]
    return rows


def _speech_features(spec: Any) -> str:
    """Describe the speech features: "logmel (n_mels 24), prosody"."""
    if not isinstance(spec, dict):
        return "none" if spec is None else str(spec)
    if spec.get("kind") == "stack":
        return ", ".join(map(_speech_features, spec.get("parts", ())))
    settings = ", ".join(f"{key} {value}" for key, value in spec.items() if key != "kind")
    return f"{spec.get('kind')}" + (f" ({settings})" if settings else "")


def _used(network: Any) -> Any:
    """Return the settings that the network's architecture uses."""
    if not isinstance(network, dict) or network.get("architecture") != "diffwave":
        return network
    return {key: value for key, value in network.items() if key not in _OF_CONFORMERS}


def _settings(values: Any) -> str:
    if not isinstance(values, dict):
        return str(values)
    return ", ".join(f"{key} {_value(value)}" for key, value in values.items())


def _value(value: Any) -> str:
    return "-".join(map(str, value)) if isinstance(value, list) else str(value)


def _tensors(path: Path) -> dict[str, list[int]]:
    """Return {name: shape} of the tensors, from the header alone."""
    try:
        with safe_open(path, framework="numpy") as file:
            return {name: file.get_slice(name).get_shape() for name in file.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise ModelError(f"{path.name} is damaged: {error}") from None


def readme_notes(readme: Path) -> dict[str, str]:
    """Return {label: text} of the README's notes on the training; empty without a README."""
    try:
        text = readme.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return {}
    return {match[1]: match[2] for match in map(_NOTE.fullmatch, text.splitlines()) if match}
