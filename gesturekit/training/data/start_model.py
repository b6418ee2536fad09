"""The model that a run starts from (`start_from`): checks against the run, and its weights."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from gesturekit.corpus.checks import first_difference
from gesturekit.errors import ConfigError
from gesturekit.motion.skeleton import Skeleton

_PREFIX = "start."


def model_of(folder: Path) -> Path:
    """Return a model folder, given itself or its run folder."""
    inside = folder / "model"
    return inside if (inside / "config.yaml").is_file() else folder


def widened(
    weights: Mapping[str, Tensor], network: nn.Module, has_inputs: Callable[[str], bool]
) -> dict[str, Tensor]:
    """Return the weights of a model to start from, in the shapes of a network.

    Where the network has more inputs than the model, their weights are zeros, so that training
    begins with the model's output.

    Args:
        weights: of the model, by name.
        network: to be trained.
        has_inputs: whether the weights of this name have a column for each input.
    """
    result = dict(weights)
    for name, value in network.state_dict().items():
        if has_inputs(name):
            result[name] = torch.zeros_like(value)
            if (known := weights.get(name)) is not None:
                result[name][tuple(map(slice, known.shape))] = known
    return result


def check_settings(
    setting: str, folder: Path, known: Mapping[str, Any], wanted: Mapping[str, Any]
) -> None:
    """Check that a run has the settings of a model.

    Args:
        setting: key that names the model, such as `start_from`.
        folder: of the model.
        known: settings of the model by name.
        wanted: settings of the run by name, at least those of the model.

    Raises:
        ConfigError: a setting that differs.
    """
    for name, value in known.items():
        if value != wanted[name]:
            raise ConfigError(
                f"{setting}: {folder} has {name} {value}, this run {wanted[name]}; set it to what "
                "the model has"
            )


def check_conditions(folder: Path, known: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    """Check that a model to start from has the conditions of a run.

    A corpus may lack some of the model's styles and events (lists of names).

    Args:
        folder: of the model.
        known: conditions of the model by name, at least those of the run.
        wanted: conditions of the run by name.

    Raises:
        ConfigError: a condition that differs.
    """
    for name, value in wanted.items():
        lists = isinstance(value, list) and bool(value) == bool(known[name])
        if not (set(value) <= set(known[name]) if lists else value == known[name]):
            raise ConfigError(
                f"start_from: {folder} has {name} {known[name]}, this run {value}; a model's "
                "conditions cannot change"
            )


def check_rig(
    setting: str, folder: Path, known: Skeleton, skeleton: Skeleton, corpus: Path
) -> None:
    """Check that recordings have the joints and parents of a model; bone lengths may differ.

    Args:
        setting: key that names the model, such as `start_from`.
        folder: of the model.
        known: rig of the model.
        skeleton: rig of the recordings.
        corpus: manifest of the recordings.

    Raises:
        ConfigError: another rig.
    """
    different = first_difference(skeleton, known)
    if different:
        raise ConfigError(f"{setting}: {folder} has another rig than {corpus}: {different}")


def start_tensors(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the weights to start from by their names in a run folder's data.

    There they let a run that is resumed before its first checkpoint start from the same weights.
    """
    return {f"{_PREFIX}{name}": value.contiguous() for name, value in weights.items()}


def read_start(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the inverse of `start_tensors`; empty for a run that starts from random weights."""
    return {
        name.removeprefix(_PREFIX): value
        for name, value in tensors.items()
        if name.startswith(_PREFIX)
    }
