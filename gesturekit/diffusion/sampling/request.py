"""What a motion is asked for by: speech, path, events, as the models of a product are told it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import audio_features as af
from gesturekit.corpus.speech import SpeechConditioner, speech_features
from gesturekit.diffusion.conditions import Conditions, check_event, smooth_path
from gesturekit.diffusion.sampling.event_times import asked_events, wants_beats
from gesturekit.errors import ModelError
from gesturekit.formats.tables.events import Event
from gesturekit.formats.tables.root_path import as_root_path
from gesturekit.motion.motion import Motion
from gesturekit.motion.root_path import RootPath


@dataclass(frozen=True, eq=False)
class Request:
    """One motion to make, but for its style.

    Attributes:
        n_frames: T.
        fps: frames per second.
        wave: the sound, or None for silence.
        path: what the root follows, T frames at `fps`, smoothed; None where a model moves it.
        scale: metres of the path for a metre of the reference body, see `ModelJoints.scale`.
        events: what happens, and when; None for nothing.
        ears: what the first model that hears does so by; None where none does.
        features: (T, S) that it hears.
    """

    n_frames: int
    fps: float
    wave: af.Wave | None
    path: RootPath | None
    scale: float
    events: tuple[Event, ...] | None
    ears: SpeechConditioner | None
    features: np.ndarray

    @classmethod
    def of(
        cls,
        models: Sequence[Conditions],
        fps: float,
        *,
        scale: float = 1.0,
        speech: str | Path | af.Wave | None,
        seconds: float | None,
        path: str | Path | RootPath | Motion | None,
        events: str | Path | None,
    ) -> Request:
        """What was asked, if there is a model that it can be told.

        Args:
            models: what each model of the product knows, the leading one first.
            fps: frames per second of all of them.
            scale: of their rig.
            speech, seconds, path, events: see `DiffusionModel.generate`.

        Raises:
            ModelError: something that none of the models knows, a path that is missing, or no
                length.
            AudioError, FormatError: a file that cannot be read.
        """
        follows = models[0].path
        if path is not None and not follows:
            raise ModelError(f"path={path!r}: this model moves its root itself and follows no path")
        if path is None and follows:
            raise ModelError(
                "path: this model follows a path and needs one: a .csv with columns "
                "time,x,z[,heading], or a motion file"
            )
        if events is not None and not any(model.events for model in models):
            raise ModelError(f"events={str(events)!r}: this model knows no events")
        way = None if path is None else as_root_path(path, scale)
        if speech is None and seconds is None and way is not None:
            seconds = way.frames_within(fps) / fps
        ears = next((m.conditioner for m in models if m.conditioner is not None), None)
        heard, wave = speech, None
        if speech is not None and (ears is not None or wants_beats(events)):
            heard = wave = speech if isinstance(speech, af.Wave) else af.Wave.load(speech)
        if ears is None and wave is not None and seconds is None:
            # No model hears it, but something shall happen on its beats.
            heard, seconds = None, wave.n_frames(fps) / fps
        features = speech_features(ears, heard, seconds, fps)
        n_frames = len(features)
        happens = None if events is None else asked_events(events, wave)
        _check_events(happens or (), models)
        if way is not None:
            way = smooth_path(way, fps, n_frames)
        return cls(n_frames, fps, wave, way, scale, happens, ears, features)

    def told(self, conditions: Conditions) -> np.ndarray:
        """(T, C) float32: what a model is told of this, its style left at zero."""
        heard, ears = None, conditions.conditioner
        if ears is not None and ears is self.ears:
            heard = self.features
        elif ears is not None:
            wave, n_frames = self.wave, self.n_frames
            heard = ears.silence(n_frames) if wave is None else ears(wave, n_frames)
        known = None
        if self.events is not None:
            known = [event for event in self.events if event.name in conditions.events]
        path = self.path.scaled(1 / self.scale) if conditions.path else None
        return conditions.encode(self.n_frames, self.fps, speech=heard, path=path, events=known)


def check_events(events: str | Path, models: Sequence[Conditions]) -> None:
    """Check the names of events that are asked for, whatever the sound.

    Raises:
        ModelError: a text that cannot be read, or a name that none of the models knows.
        FormatError: a table that cannot be read.
    """
    if not any(model.events for model in models):
        raise ModelError(f"events={str(events)!r}: this model knows no events")
    if wants_beats(events):
        events = re.sub(r"@beats\b", "@0", events)
    _check_events(asked_events(events, None), models)


def _check_events(events: Sequence[Event], models: Sequence[Conditions]) -> None:
    """Each must be known to one of the models."""
    known = tuple(dict.fromkeys(name for model in models for name in model.events))
    for event in events:
        check_event(event, known)
