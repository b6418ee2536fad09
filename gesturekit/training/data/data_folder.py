"""What a run trains on, on disk, for when it is resumed.

Features and encoded motion differ in their last bits from process to process, as numpy's vector
instructions depend on where arrays lie; a resumed run must read what it read.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

import audio_features as af
from gesturekit.atomic import atomic_write
from gesturekit.errors import ConfigError

Data = TypeVar("Data")


def save_data(folder: Path, tensors: dict[str, Tensor], about: Mapping[str, Any]) -> None:
    """Write `data.safetensors` and `data.json`, which holds plain values."""
    with atomic_write(folder / "data.safetensors") as temporary:
        save_file(tensors, temporary)
    with atomic_write(folder / "data.json") as temporary:
        temporary.write_text(json.dumps(about), encoding="utf-8")


def load_data(folder: Path, assemble: Callable[[dict[str, Any], dict[str, Tensor]], Data]) -> Data:
    """Read what `save_data` wrote.

    Args:
        folder: where.
        assemble: makes the data of plain values and tensors.

    Raises:
        ConfigError: the folder's data is missing or damaged.
        WeightsError: the WavLM weights are not those that the run began with.
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
