"""Recorded motion in a model folder: plain values and tensors, and back."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gesturekit.multires.motion_vector import MultiresRepresentation
from gesturekit.multires.retrieval.library import RecordedLibrary, RecordedMotion
from gesturekit.multires.retrieval.passive import PassiveChannels
from gesturekit.training.model_folder import ModelParts
from gesturekit.wording import counted, roughly

_CURVES = ("state", "motion", "passive")


def library_values(library: RecordedLibrary) -> dict[str, Any]:
    """Return the plain values of a library."""
    return {
        "recordings": [[part.speaker, part.style] for part in library.recordings],
        "passive": {"joints": list(library.passive.joints), "face": library.passive.expressions},
    }


def library_row(library: RecordedLibrary) -> str:
    """Return "30 joints and 50 face coefficients from 4 min of recordings, 1.2 MB of ..."."""
    passive = library.passive
    what = [counted(len(passive.joints), "joint")] if passive.joints else []
    what += [counted(passive.expressions, "face coefficient")] if passive.expressions else []
    size = sum(tensor.numel() for tensor in library_tensors(library).values()) * 4 / 1e6
    seconds = sum(own.state.shape[1] for own in library.recordings) / library.fps
    played = "the whole body" if library.is_whole else " and ".join(what)
    return f"{played} from {roughly(seconds)} of recordings, {size:.1f} MB of model.safetensors"


def library_tensors(library: RecordedLibrary) -> dict[str, Tensor]:
    """Return the tensors of a library by name."""
    return {
        f"recorded.{i}.{name}": getattr(recording, name).contiguous()
        for i, recording in enumerate(library.recordings)
        for name in _CURVES
    }


def load_library(
    parts: ModelParts, representation: MultiresRepresentation, n_channels: int
) -> RecordedLibrary | None:
    """Read what `library_values` and `library_tensors` wrote; None for a model without.

    `n_channels` is the number of channels of the state of movement.

    Raises:
        ValueError: tensors whose shapes do not fit the model, or that are not finite.
    """
    values, tensors = parts.config["recorded"], parts.tensors
    if values is None:
        return None
    passive = PassiveChannels(
        tuple(map(str, values["passive"]["joints"])), int(values["passive"]["face"])
    )
    for name in passive.joints:
        representation.skeleton.index(name)
    recordings = tuple(
        RecordedMotion(
            **{name: tensors[f"recorded.{i}.{name}"].float() for name in _CURVES},
            speaker=speaker,
            style=int(style),
        )
        for i, (speaker, style) in enumerate(values["recordings"])
    )
    if not recordings:
        raise ValueError("recorded: no recording")
    library = RecordedLibrary(float(parts.config["fps"]), passive, recordings)
    sizes = {
        "state": n_channels + 1,
        "motion": representation.n_features if library.is_whole else 0,
        "passive": 6 * len(passive.joints) + passive.expressions,
    }
    for i, recording in enumerate(recordings):
        n_frames = recording.state.shape[-1]
        for name, size in sizes.items():
            found = getattr(recording, name)
            if tuple(found.shape) != (size, n_frames) or not n_frames:
                shape = tuple(found.shape)
                raise ValueError(f"recorded.{i}.{name} has the shape {shape}, not {size} rows")
            if not torch.isfinite(found).all():
                raise ValueError(f"recorded.{i}.{name} has numbers that are not finite")
    return library
