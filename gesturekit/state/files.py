"""State of movement in files: a given state, and the process in a model folder."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gesturekit.errors import FormatError, ModelError
from gesturekit.state.channels import StateChannels
from gesturekit.state.live import ahead_tensors, ahead_values, load_ahead
from gesturekit.state.prediction import WantedMovement
from gesturekit.state.process import Group, StateProcess


def unused_controls(controls: Mapping[str, object], process: StateProcess | None) -> Iterator[str]:
    """Yield what is wrong with controls of the state of movement that have no effect.

    Args:
        controls: of a request.
        process: of the model; None for a model without a state of movement.
    """
    if controls["state"] is not None and process is None:
        yield "state: this model was trained without the state of movement"
    for name, unset in (("liveliness", 1), ("mood_seed", None)):
        if (value := controls[name]) == unset:
            continue
        if process is None:
            yield f"{name}={value}: only models that draw how lively they are take it"
        for other in ("like", "state"):
            if controls[other] is not None:
                yield f"{name}={value}: {other} sets the movement; give one of them"


def mood_seed(seed: int, controls: Mapping[str, Any]) -> int:
    """Return the seed of the drawn state of movement: the control of that name, or `seed`."""
    return seed if controls["mood_seed"] is None else int(controls["mood_seed"])


def given_state(process: StateProcess, state: str | Path | np.ndarray, n_frames: int) -> np.ndarray:
    """Return a state (T, C) of a process, cut to a motion of T frames or held to its end.

    Args:
        process: of the model.
        state: (frames, C), or a .npy file of it.
        n_frames: T.

    Raises:
        ModelError: a state of another width, empty, or not finite.
        FormatError: its file cannot be read.
    """
    if not isinstance(state, np.ndarray):
        try:
            state = np.load(state, mmap_mode="r", allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise FormatError(
                f"{state}: not a .npy file of numbers, as numpy.save writes model.state"
            ) from error
    wanted, shape = len(process.channels.names), state.shape
    is_right = state.dtype.kind in "fiu" and len(shape) == 2 and shape[0] and shape[1] == wanted
    state = state[:n_frames].astype(float) if is_right else state
    if not is_right or not np.isfinite(state).all():
        raise ModelError(
            f"state: {state.dtype} of shape {shape}, not (frames, {wanted}) finite numbers; as "
            "model.state returns it"
        )
    return np.pad(state, ((0, max(0, n_frames - len(state))), (0, 0)), mode="edge")[:n_frames]


_SHAPES: dict[str, tuple[str, ...]] = {
    "silence": ("S",),
    "mean": ("C",),
    "scale": ("C",),
    "explained": ("C",),
    "usual": ("3",),
    "mixing": ("C", "C"),
    "between": ("C - F",),
    "width": ("C - F",),
    "kernel": ("F", "R"),
    "quantiles": ("G", "2", "C", "Q"),
    "response": ("2", "C", "P"),
    "followed": ("C",),
}
_RANGES = {
    "scale": (1e-6, 1e6),
    "explained": (-1, 1),
    "mixing": (-2, 2),
    "between": (0, 1),
    "width": (0.1, 100),
    "kernel": (-2, 2),
    "followed": (0.1, 1),
}
_WIDEST = (-1e6, 1e6)
_TAKE = (0.1, 1e7)  # seconds; a single take may have hours
_MOST_POINTS = 1000  # of a filter, and of quantiles


def state_values(process: StateProcess) -> dict[str, Any]:
    """Return the plain values of a process."""
    wanted = process.wanted
    return {
        "channels": list(process.channels.names),
        "take": process.take,
        "groups": [list(group) for group in process.quantiles],
        "wanted": None if wanted is None else wanted.values(),
        "ahead": ahead_values(process.ahead),
    }


def state_tensors(process: StateProcess) -> dict[str, Tensor]:
    """Return the tensors of a process by name."""
    quantiles = np.stack(list(process.quantiles.values()))
    arrays = {name: getattr(process, name) for name in _SHAPES} | {"quantiles": quantiles}
    tensors = {
        f"state.{name}": torch.from_numpy(np.array(array, float)) for name, array in arrays.items()
    }
    tensors |= ahead_tensors(process.ahead, "state")
    return tensors | ({} if process.wanted is None else process.wanted.tensors("state"))


def load_state(
    values: Mapping[str, Any] | None,
    tensors: Mapping[str, Tensor],
    channels: StateChannels,
    fps: float,
    speech_size: int,
) -> StateProcess | None:
    """Read what `state_values` and `state_tensors` wrote; None for a model without a state.

    Args:
        values: of config.yaml.
        tensors: of the folder.
        channels: of the model's rig.
        fps: frames per second.
        speech_size: S, the number of speech features.

    Raises KeyError, IndexError or ValueError for values out of range, or tensors whose shapes do
    not fit the model.
    """
    if values is None:
        return None
    if tuple(values["channels"]) != channels.names:
        raise ValueError(f"state: the rig has the channels {', '.join(channels.names)}")
    groups = [_group(*group) for group in values["groups"]]
    arrays = {name: tensors[f"state.{name}"].double().numpy() for name in _SHAPES}
    _check(arrays, len(groups), channels, speech_size)
    wanted, ahead = None, ()
    if values["wanted"] is not None:
        wanted = WantedMovement.load(values["wanted"], tensors, "state", fps)
        ahead = load_ahead(values["ahead"], tensors, "state", wanted, speech_size, fps)
    process = StateProcess(
        channels=channels,
        fps=fps,
        wanted=wanted,
        take=float(np.clip(values["take"], *_TAKE)),
        quantiles=dict(zip(groups, arrays.pop("quantiles"), strict=True)),
        **arrays,
        ahead=ahead,
    )
    process.draw(0, np.zeros((speech_size, 2), np.float32))  # fails where something does not fit
    return process


def _group(speaker: Any, style: Any) -> Group:
    """Return speaker and number of the style from their plain values."""
    return None if speaker is None else str(speaker), None if style is None else int(style)


def _check(
    arrays: Mapping[str, np.ndarray], groups: int, channels: StateChannels, speech_size: int
) -> None:
    """Raise ValueError for arrays of other shapes, or with values out of range."""
    n, n_fast = len(channels.names), int(channels.fast.sum())
    sizes = {"S": speech_size, "C": n, "F": n_fast, "C - F": n - n_fast, "G": groups}
    sizes |= {"2": 2, "3": 3}
    for size, name in {"R": "kernel", "Q": "quantiles", "P": "response"}.items():
        sizes[size] = min(arrays[name].shape[-1], _MOST_POINTS)
    for name, axes in _SHAPES.items():
        wanted, (low, high) = tuple(sizes[axis] for axis in axes), _RANGES.get(name, _WIDEST)
        array = arrays[name]
        if array.shape != wanted or not ((low <= array) & (array <= high)).all():
            raise ValueError(
                f"state.{name} has the shape {array.shape}; expected {wanted} and values from "
                f"{low:g} to {high:g}"
            )
