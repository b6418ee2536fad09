"""Recorded motion that a model plays, from its training recordings."""

from __future__ import annotations

import numpy as np
import torch

from gesturekit.multires.config import MultiresConfig
from gesturekit.multires.retrieval.library import RecordedLibrary, RecordedMotion
from gesturekit.multires.training.data import TrainingData
from gesturekit.multires.training.state import TrainingState

_MOST_SECONDS, _MOST_PASSIVE_SECONDS = 1200.0, 300.0
"""Seconds of recorded motion in a model: whole bodies, or fingers and faces. Of more, the same
share of each recording is kept."""
_LEAST_SECONDS = 4.0
"""Seconds of each recording that are kept at least: the length of a piece."""


def build_library(
    data: TrainingData, config: MultiresConfig, state: TrainingState | None
) -> RecordedLibrary | None:
    """Return what a model plays; None if its network makes all that moves in the recordings."""
    if state is None or (data.passive.is_empty and not config.retrieval):
        return None
    total = sum(sequence.n_frames for sequence in data.sample) / config.fps
    most = _MOST_SECONDS if config.retrieval else _MOST_PASSIVE_SECONDS
    recordings = []
    for sequence in data.sample:
        share = round(sequence.n_frames * min(1.0, most / total))
        n_frames = min(sequence.n_frames, max(share, round(_LEAST_SECONDS * config.fps)))
        start = (sequence.n_frames - n_frames) // 2
        part = slice(start, start + n_frames)
        motion = sequence.motion[:, part].contiguous()
        recordings.append(
            RecordedMotion(
                state=torch.from_numpy(state.with_voice(sequence)[:, part].astype(np.float32)),
                motion=motion if config.retrieval else motion[:0],
                passive=sequence.passive[:, part].contiguous(),
                speaker=sequence.speaker,
                style=sequence.style,
            )
        )
    return RecordedLibrary(config.fps, data.passive, tuple(recordings))
