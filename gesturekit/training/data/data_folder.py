"""Training data of a run on disk, from which a resumed run continues.

Features and encoded motion computed again would differ in their last bits, because numpy's vector
instructions depend on the alignment of arrays.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

import audio_features as af
from audio_features.atomic import atomic_write, remove_unfinished, write_tensors
from gesturekit.errors import ConfigError

Data = TypeVar("Data")


def save_data(folder: Path, tensors: dict[str, Tensor], about: Mapping[str, Any]) -> None:
    """Write `data.safetensors` and `data.json`, which holds plain values."""
    for name in ("data.safetensors", "data.json"):
        remove_unfinished(folder / name)
    write_tensors(folder / "data.safetensors", tensors)
    with atomic_write(folder / "data.json") as temporary:
        temporary.write_text(json.dumps(about), encoding="utf-8")


def load_data(folder: Path, assemble: Callable[[dict[str, Any], dict[str, Tensor]], Data]) -> Data:
    """Read what `save_data` wrote.

    Args:
        folder: as written by `save_data`.
        assemble: build the data from plain values and tensors.

    Raises:
        ConfigError: the folder's data is missing or damaged.
        WeightsError: the WavLM weights differ from those at the start of the run.
    """
    try:
        about = json.loads((folder / "data.json").read_text(encoding="utf-8"))
        return assemble(about, load_file(folder / "data.safetensors"))
    except af.WeightsError:
        raise
    except (OSError, ValueError, KeyError, TypeError, SafetensorError) as error:
        raise ConfigError(
            f"{folder}: the run's training data cannot be read ({error}); start a new run"
        ) from error
