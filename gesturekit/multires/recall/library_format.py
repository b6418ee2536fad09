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
from gesturekit.multires.recall.parts import PassiveChannels, motion_parts, slow_rows
from gesturekit.multires.recall.slow_state import SlowState
from gesturekit.state.ahead import ahead_tensors, ahead_values, load_ahead
from gesturekit.state.prediction import WantedMovement
from gesturekit.training.model_folder import ModelParts
from gesturekit.wording import counted

_VALUES = ("level", "piece", "overlap", "mean", "spread", "stretch")
_LARGEST = 1e4  # of `_VALUES`: levels, seconds and log m/s
_LEAST_SPREAD = 1e-6
_CURVES = ("motion", "passive", "profiles", "states", "directions", "defective")
_SLOW_STATE = {"explained": (-2, 2), "mixing": (-2, 2), "between": (0, 1), "width": (0.1, 100)}
"""Ranges of the slow state's tensors."""
_TAKE = (0.1, 1e7)  # seconds; a single take may have hours


def library_values(library: RecallLibrary) -> dict[str, Any]:
    """Return the plain values of a library."""
    wanted = library.wanted
    return {
        **{name: getattr(library, name) for name in _VALUES},
        "separate": len(library.parts) > 1,
        "recordings": [[part.speaker, part.style] for part in library.recordings],
        "passive": {"joints": list(library.passive.joints), "face": library.passive.expressions},
        "slow_state": {"take": library.slow_state.take},
        "wanted": None if wanted is None else wanted.values(),
        "ahead": ahead_values(library.ahead),
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


def prediction_rows(library: RecallLibrary) -> dict[str, str]:
    """Return the correlations of speech with hand movement, for the README; empty without."""
    return {} if library.wanted is None else {"Hand movement from speech": library.wanted.summary()}


def library_tensors(library: RecallLibrary) -> dict[str, Tensor]:
    """Return the tensors of a library by name."""
    tensors = {
        f"recall.slow_state.{name}": _tensor(getattr(library.slow_state, name))
        for name in _SLOW_STATE
    }
    for i, recording in enumerate(library.recordings):
        for name in _CURVES:
            tensors[f"recall.{i}.{name}"] = getattr(recording, name).contiguous()
    if library.wanted is not None:
        tensors |= library.wanted.tensors("recall")
    return tensors | ahead_tensors(library.ahead, "recall")


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
    _check_values(values, levels)
    wanted = None
    if values["wanted"] is not None:
        wanted = WantedMovement.load(values["wanted"], tensors, "recall", fps)
    library = RecallLibrary(
        level=int(values["level"]),
        levels=levels,
        fps=fps,
        piece=float(values["piece"]),
        overlap=float(values["overlap"]),
        parts=motion_parts(representation, bool(values["separate"])),
        recordings=recordings,
        spread=float(values["spread"]),
        mean=float(values["mean"]),
        slow_state=SlowState(
            **{name: tensors[f"recall.slow_state.{name}"].numpy() for name in _SLOW_STATE},
            trust=0.0 if wanted is None else wanted.trust,
            take=float(values["slow_state"]["take"]),
        ),
        wanted=wanted,
        passive=PassiveChannels(
            tuple(map(str, values["passive"]["joints"])), int(values["passive"]["face"])
        ),
        stretch=float(values["stretch"]),
        ahead=load_ahead(values["ahead"], tensors, "recall", wanted, speech_size, fps),
    )
    _check_shapes(library, representation.n_features, speech_size)
    for name, tensor in tensors.items():
        if name.startswith("recall.") and not torch.isfinite(tensor).all():
            raise ValueError(f"{name} has numbers that are not finite")
    for name in library.passive.joints:
        representation.skeleton.index(name)
    return library


def _check_values(values: Mapping[str, Any], levels: int) -> None:
    """Raise ValueError for values out of range."""
    for name in _VALUES:
        if not isinstance(values[name], int | float) or not abs(values[name]) <= _LARGEST:
            raise ValueError(f"recall: {name} is {values[name]}")
    if not 1 <= values["level"] <= levels:
        raise ValueError(f"recall: level {values['level']} of {levels}")
    check_stretch(values["stretch"])
    if not values["spread"] >= _LEAST_SPREAD:
        raise ValueError(f"recall: spread is {values['spread']}")
    _check_range("slow_state.take", float(values["slow_state"]["take"]), *_TAKE)


def _check_range(name: str, values: float | np.ndarray, low: float, high: float) -> None:
    """Raise ValueError for values out of a range, NaN included."""
    wrong = np.extract(~((low <= np.asarray(values)) & (np.asarray(values) <= high)), values)
    if len(wrong):
        raise ValueError(f"recall: {name} is {wrong[0]}, not from {low:g} to {high:g}")


def _check_shapes(library: RecallLibrary, n_features: int, speech_size: int) -> None:
    """Raise ValueError for tensors with which `RecallLibrary.recall` would fail."""
    passive = library.passive
    n_passive = 6 * len(passive.joints) + passive.expressions
    n_parts = len(library.parts)
    sizes = {"motion": n_features, "passive": n_passive, "profiles": n_parts}
    sizes["states"] = slow_rows(library.parts)[-1].stop
    sizes["defective"] = n_parts
    sizes["directions"] = 4 if library.parts[0].is_arm else 0
    for i, recording in enumerate(library.recordings):
        for name, size in sizes.items():
            found, wanted = tuple(getattr(recording, name).shape), (size, library.lengths[i])
            if found != wanted or not library.lengths[i]:
                raise ValueError(f"recall.{i}.{name} has the shape {found}, not {wanted}")
        if recording.defective.dtype != torch.bool:
            raise ValueError(f"recall.{i}.defective is {recording.defective.dtype}, not bool")
    for name, limits in _SLOW_STATE.items():
        size = sizes["states"]
        found, wanted = getattr(library.slow_state, name), (size,) * (1 + (name == "mixing"))
        if found.shape != wanted:
            raise ValueError(f"recall.slow_state.{name} has the shape {found.shape}, not {wanted}")
        _check_range(f"slow_state.{name}", found, *limits)
    if library.wanted is not None:
        try:
            library.wanted(np.zeros((speech_size, 2), np.float32))
        except (IndexError, ValueError) as error:
            raise ValueError(f"recall: no {speech_size} speech features fit ({error})") from None


def _tensor(value: Any) -> Tensor:
    return torch.from_numpy(np.array(value, dtype=np.float64))
