"""The systems gesturekit has, by name: the one place where a name leads upwards to its code."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from gesturekit.errors import ConfigError, ModelError
from gesturekit.model import Model
from gesturekit.training.config import load_config, read_chain, read_yaml


@dataclass(frozen=True)
class System:
    """Where the parts of a system live, as `module:name`; imported when they are asked for."""

    model: str
    config: str
    train: str


SYSTEMS = {
    "multires": System(
        model="gesturekit.multires.model:MultiresModel",
        config="gesturekit.multires.config:MultiresConfig",
        train="gesturekit.multires.trainer:train",
    ),
    "diffusion": System(
        model="gesturekit.diffusion.model:DiffusionModel",
        config="gesturekit.diffusion.config:DiffusionConfig",
        train="gesturekit.diffusion.trainer:train",
    ),
}

_BUNDLED = Path(__file__).parent / "models"


def bundled_models() -> list[str]:
    """Names of the models that come with the package."""
    if not _BUNDLED.is_dir():
        return []
    return sorted(folder.parent.name for folder in _BUNDLED.glob("*/config.yaml"))


def bundled_speech() -> Path:
    """The short recording that comes with the demo model."""
    return _BUNDLED / "demo" / "speech.wav"


def model_folder(model: str | Path) -> Path:
    """The folder that a bundled name or a path stands for.

    A bundled name wins over a folder that happens to be called so; ./demo means the folder.
    """
    return _BUNDLED / str(model) if str(model) in bundled_models() else Path(model)


def load(
    model: str | Path,
    *,
    weights: str | Path | None = None,
    device: str = "cpu",
    dtype: Literal["fp32", "bf16"] = "fp32",
) -> Model:
    """Load a model.

    Args:
        model: a bundled name such as "demo", or a model folder.
        weights: folder of WavLM weights, for models that hear by WavLM.
        device: where its networks compute: cpu, cuda, cuda:1, or auto (a GPU if there is one).
            A pyramid of multires stays on the CPU, which makes its motion in milliseconds.
        dtype: arithmetic of the network: single precision, or bfloat16, in which diffusion takes
            half the time on processors that have it. Its motion differs in small things.

    Returns:
        a model, whose `generate` makes motion.

    Raises:
        ModelError: there is no such model, it cannot be read, or has no such dtype.
        ConfigError: there is no such device.
        WeightsError: the model needs weights, or other weights.
    """
    folder = model_folder(model)
    if not folder.is_dir():
        raise ModelError(
            f"{model}: neither a model folder nor a bundled model "
            f"({', '.join(bundled_models()) or 'none is bundled'})"
        )
    try:
        kind = read_yaml(folder / "config.yaml").get("kind")
    except ConfigError as error:
        raise ModelError(f"not a model folder: {error}") from None
    if kind is None and (folder / "model" / "config.yaml").is_file():
        raise ModelError(f"{folder}: a run folder; its model is {folder / 'model'}")
    if not isinstance(kind, str) or kind not in SYSTEMS:
        raise ModelError(
            f"{folder / 'config.yaml'}: kind {kind!r}; known: {', '.join(SYSTEMS)}. "
            "A newer kind needs a newer gesturekit"
        )
    return _part(SYSTEMS[kind].model).load(folder, weights=weights, device=device, dtype=dtype)


def train(
    config: str | Path,
    overrides: Sequence[str] | Mapping[str, Any] = (),
    *,
    resume: bool = False,
    **settings: Any,
) -> Path:
    """Train the system that a configuration file names.

    `train("light.yaml", {"schedule.batch": 8}, corpus="corpus.jsonl", out="runs/mine")`.

    Args:
        config: YAML file, whose `system:` is one of `SYSTEMS`; its parent may say so too.
        overrides: single settings, as `key=value` strings, or by dotted name.
        resume: go on from the last checkpoint of the run folder.
        settings: further settings by name; a mapping changes single settings of a section.

    Returns:
        the model folder.

    Raises:
        ConfigError: the configuration is wrong.
    """
    name = read_chain(config).get("system")
    if not isinstance(name, str) or name not in SYSTEMS:
        raise ConfigError(f"{config}: system: {name!r} is not one of {', '.join(SYSTEMS)}")
    if isinstance(overrides, Mapping):
        overrides, settings = (), {**overrides, **settings}
    loaded = load_config(config, _part(SYSTEMS[name].config), overrides, settings)
    return _part(SYSTEMS[name].train)(loaded, resume=resume)


def _part(where: str) -> Any:
    module, _, name = where.partition(":")
    return getattr(importlib.import_module(module), name)
