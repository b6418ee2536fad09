"""Recall library in a model folder: plain values and tensors, and back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gesturekit.multires.config import check_stretch
from gesturekit.multires.motion_vector import MultiresRepresentation
from gesturekit.multires.recall.library import RecalledRecording, RecallLibrary
from gesturekit.multires.recall.parts import PassiveChannels, motion_parts
from gesturekit.multires.recall.wanted import Regression, WantedMovement
from gesturekit.training.model_folder import ModelParts
from gesturekit.wording import counted

_VALUES = ("level", "piece", "overlap", "mean", "stretch")
_LARGEST = 1e4  # of `_VALUES`: levels, seconds and log m/s
_CURVES = ("motion", "passive", "profiles", "directions", "defective")
_REGRESSION = ("mean", "weights", "offset", "predicted", "recorded", "r")
_DISTRIBUTION = ("predicted", "recorded", "voices")


def library_values(library: RecallLibrary) -> dict[str, Any]:
    """Return the plain values of a library."""
    wanted = library.wanted
    return {
        **{name: getattr(library, name) for name in _VALUES},
        "separate": len(library.parts) > 1,
        "recordings": [[part.speaker, part.style] for part in library.recordings],
        "passive": {"joints": list(library.passive.joints), "face": library.passive.expressions},
        "effort": None if wanted is None else list(wanted.effort),
    }


def library_row(library: RecallLibrary) -> str:
    """Return "2 recordings at level 4 (4.4 fps), 0.2 MB of model.safetensors".

    Stretching is added: "..., arms up to 25 % faster or slower".
    """
    tensors = library_tensors(library).values()
    size = sum(tensor.numel() * tensor.element_size() for tensor in tensors) / 1e6
    count = counted(len(library.recordings), "recording")
    rate = f"level {library.level} ({library.level_fps:.2g} fps)"
    faster = f", arms up to {100 * library.stretch:.3g} % faster or slower"
    return f"{count} at {rate}, {size:.1f} MB of model.safetensors" + faster * (library.stretch > 0)


def library_tensors(library: RecallLibrary) -> dict[str, Tensor]:
    """Return the tensors of a library by name."""
    tensors = {"recall.spread": torch.from_numpy(library.spread)}
    for i, recording in enumerate(library.recordings):
        for name in _CURVES:
            tensors[f"recall.{i}.{name}"] = getattr(recording, name).contiguous()
    wanted = library.wanted
    if wanted is None:
        return tensors
    if wanted.basis is not None:
        tensors["recall.basis"] = torch.from_numpy(np.ascontiguousarray(wanted.basis))
    for name in _DISTRIBUTION:
        tensors[f"recall.{name}"] = _tensor(getattr(wanted, name))
    for part in ("fast", "slow"):
        for name in _REGRESSION:
            tensors[f"recall.{part}.{name}"] = _tensor(getattr(getattr(wanted, part), name))
    return tensors


def load_library(
    parts: ModelParts, representation: MultiresRepresentation, levels: int, speech_size: int
) -> RecallLibrary | None:
    """Read what `library_values` and `library_tensors` wrote; None for a model without recall.

    `speech_size` is the number of speech features.

    Raises:
        ValueError: values out of range, or tensors whose shapes do not fit the model.
    """
    values = parts.config["recall"]
    if values is None:
        return None
    tensors, fps = parts.tensors, float(parts.config["fps"])
    recordings = tuple(
        RecalledRecording(
            **{name: tensors[f"recall.{i}.{name}"] for name in _CURVES},
            speaker=speaker,
            style=int(style),
        )
        for i, (speaker, style) in enumerate(values["recordings"])
    )
    wanted = None
    if values["effort"] is not None:
        basis = tensors.get("recall.basis")
        wanted = WantedMovement(
            fps,
            tuple(map(int, values["effort"])),
            None if basis is None else basis.numpy(),
            _regression(tensors, "fast"),
            _regression(tensors, "slow"),
            *(tensors[f"recall.{name}"].numpy() for name in _DISTRIBUTION),
        )
    _check_values(values, levels)
    for name in values["passive"]["joints"]:
        representation.skeleton.index(name)
    library = RecallLibrary(
        level=int(values["level"]),
        levels=levels,
        fps=fps,
        piece=float(values["piece"]),
        overlap=float(values["overlap"]),
        parts=motion_parts(representation, bool(values["separate"])),
        recordings=recordings,
        spread=tensors["recall.spread"].numpy(),
        mean=float(values["mean"]),
        wanted=wanted,
        passive=PassiveChannels(
            tuple(map(str, values["passive"]["joints"])), int(values["passive"]["face"])
        ),
        stretch=float(values["stretch"]),
    )
    _check_shapes(library, representation.n_features, speech_size)
    return library


def _check_values(values: Mapping[str, Any], levels: int) -> None:
    """Raise ValueError for values out of range."""
    for name in _VALUES:
        if not isinstance(values[name], int | float) or not abs(values[name]) <= _LARGEST:
            raise ValueError(f"recall: {name} is {values[name]}")
    if not 1 <= values["level"] <= levels:
        raise ValueError(f"recall: level {values['level']} of {levels}")
    check_stretch(values["stretch"])


def _check_shapes(library: RecallLibrary, n_features: int, speech_size: int) -> None:
    """Raise ValueError for tensors with which `RecallLibrary.recall` would fail."""
    passive = library.passive
    n_passive = 6 * len(passive.joints) + passive.expressions
    n_parts = len(library.parts)
    sizes = {"motion": n_features, "passive": n_passive, "profiles": 2 * n_parts}
    sizes["defective"] = n_parts
    sizes["directions"] = min(2, len(library.recordings[0].directions))
    for i, recording in enumerate(library.recordings):
        for name, size in sizes.items():
            found, wanted = tuple(getattr(recording, name).shape), (size, library.lengths[i])
            if found != wanted or not library.lengths[i]:
                raise ValueError(f"recall.{i}.{name} has the shape {found}, not {wanted}")
        if recording.defective.dtype != torch.bool:
            raise ValueError(f"recall.{i}.defective is {recording.defective.dtype}, not bool")
    if library.spread.shape != (2,):
        raise ValueError(f"recall.spread has the shape {library.spread.shape}, not (2,)")
    if library.wanted is not None:
        try:
            library.wanted(np.zeros((speech_size, 2), np.float32))
        except (IndexError, ValueError) as error:
            raise ValueError(f"recall: no {speech_size} speech features fit ({error})") from None


def _regression(tensors: Mapping[str, Tensor], part: str) -> Regression:
    arrays = {name: tensors[f"recall.{part}.{name}"].numpy() for name in _REGRESSION}
    return Regression(**{**arrays, "offset": float(arrays["offset"]), "r": float(arrays["r"])})


def _tensor(value: Any) -> Tensor:
    return torch.from_numpy(np.array(value, dtype=np.float64))
