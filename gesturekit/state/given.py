"""A state of movement that is given in place of a drawn one."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gesturekit.errors import FormatError, ModelError
from gesturekit.state.process import StateProcess


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
