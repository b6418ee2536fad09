"""Motion frames of events, such as kicks or the beats of music, as binary flags."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from gesturekit.errors import ModelError
from gesturekit.formats.tables.events import Event
from gesturekit.wording import did_you_mean


def event_flags(
    events: Sequence[Event], names: Sequence[str], n_frames: int, fps: float
) -> np.ndarray:
    """Return flags (T, E): 1 from the frame nearest to an event's start, at least one frame.

    Args:
        events: events after the last frame are ignored.
        names: E names of the model's events.
        n_frames: T.
        fps: frames per second.

    Raises:
        ModelError: an event of an unknown name.
    """
    flags = np.zeros((n_frames, len(names)), np.float32)
    for event in events:
        check_event(event, names)
        start = math.floor(event.time * fps + 0.5)
        stop = math.floor((event.time + event.duration) * fps + 0.5)
        flags[start : max(stop, start + 1), names.index(event.name)] = 1
    return flags


def check_event(event: Event, known: Sequence[str]) -> None:
    """Raise ModelError for an event of an unknown name."""
    if event.name not in known:
        hint = did_you_mean(event.name, known, "did you mean {}? ")
        raise ModelError(f"event {event.name!r}: {hint}the model has {', '.join(known) or 'none'}")
