"""Controls of the state of movement: one that is given in place of a drawn one, and checks."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from gesturekit.errors import FormatError, ModelError
from gesturekit.state.process import StateProcess


def check_drawn(controls: Mapping[str, object], process: StateProcess | None) -> None:
    """Raise ModelError for controls of the state of movement that have no effect.

    Args:
        controls: of a request.
        process: of the model; None for a model without a state of movement.
    """
    if controls["state"] is not None and process is None:
        raise ModelError("state: this model was trained without the state of movement")
    for name, unset in (("liveliness", 1), ("mood_seed", None)):
        value = controls[name]
        if value == unset:
            continue
        if process is None:
            raise ModelError(f"{name}={value}: only models that draw how lively they are take it")
        for other in ("like", "state"):
            if controls[other] is not None:
                raise ModelError(f"{name}={value}: {other} sets the movement; give one of them")


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
    if state.dtype.kind not in "fiu":
        raise ModelError(f"state: its type is {state.dtype}, not a number")
    state, width = state[:n_frames].astype(float), len(process.channels.names)
    if state.ndim != 2 or state.shape[1] != width or not len(state):
        raise ModelError(
            f"state: shape {state.shape}, not (frames, {width}); as model.state returns it"
        )
    if not np.isfinite(state).all():
        raise ModelError("state: not all of its values are finite")
    return np.pad(state, ((0, max(0, n_frames - len(state))), (0, 0)), mode="edge")[:n_frames]
