"""Parsing of the events control: times in seconds, or on the beats of a sound."""

from __future__ import annotations

import re
from pathlib import Path

import audio_features as af
from gesturekit.errors import ModelError
from gesturekit.evaluation.metrics.rhythm import music_beats
from gesturekit.formats.tables.events import Event, load_events

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
