"""Events, such as kicks or the beats of music: their parsing, and flags of their frames."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import audio_features as af
from gesturekit.errors import ModelError
from gesturekit.evaluation.metrics.rhythm import music_beats
from gesturekit.formats.tables import Event, load_events
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


_SECONDS = r"\d+(\.\d*)?|\.\d+"
_TERM = re.compile(rf"(?P<name>.+)@(?P<time>beats|{_SECONDS})(:(?P<duration>{_SECONDS}))?")


def wants_beats(events: str | Path | None) -> bool:
    """Return whether the events depend on the beats of a sound."""
    return isinstance(events, str) and any(
        match is not None and match["time"] == "beats"
        for match in (_TERM.fullmatch(text.strip()) for text in events.split(","))
    )


def asked_events(events: str | Path, wave: af.Wave | None) -> tuple[Event, ...]:
    """Return the requested events in order of time.

    Args:
        events: a table (`.csv`, see `load_events`), or names and seconds from the beginning
            (`kick@1.0,punch@2.5`). `kick@beats` is on every detected beat of the sound.
            `kick@1.0:0.5` lasts half a second; without a duration, an event is one frame long.
        wave: the sound that `@beats` refers to.

    Raises:
        ModelError: a text that cannot be read, or beats without a sound that has beats.
        FormatError: a table that cannot be read.
    """
    if isinstance(events, Path) or events.lower().endswith(".csv"):
        return load_events(events)
    found = []
    for text in events.split(","):
        match = _TERM.fullmatch(text.strip())
        if match is None:
            raise ModelError(
                f"event {text.strip()!r}: events look like kick@1.0,punch@2.5:0.5 (seconds, and "
                "how long), like kick@beats, or are a .csv with columns time,name[,duration]"
            )
        duration = float(match["duration"] or 0)
        times = _beats(text, wave) if match["time"] == "beats" else [float(match["time"])]
        found += [Event(time, match["name"].strip(), duration) for time in times]
    return tuple(sorted(found))


def _beats(text: str, wave: af.Wave | None) -> list[float]:
    if wave is None:
        raise ModelError(f"event {text.strip()!r}: there is no sound to find beats in")
    beats = music_beats(wave).tolist()
    if not beats:
        raise ModelError(
            f"event {text.strip()!r}: no beat was found in {wave.source or 'the sound'}; give "
            "seconds instead"
        )
    return beats
