"""A request for one motion: speech, path and events, and the conditions made from them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import audio_features as af
from gesturekit.corpus.speech import SpeechConditioner, speech_features
from gesturekit.diffusion.conditions import Conditions, smooth_path
from gesturekit.diffusion.controls import DiffusionControls
from gesturekit.diffusion.event_frames import check_event
from gesturekit.diffusion.sampling.event_times import asked_events, wants_beats
from gesturekit.errors import ModelError
from gesturekit.formats.tables.events import Event
from gesturekit.formats.tables.root_path import as_root_path
from gesturekit.motion.root_path import RootPath


@dataclass(frozen=True, eq=False)
class Request:
    """Everything that one motion is generated from, except its style.

    Attributes:
        n_frames: T.
        fps: frames per second.
        wave: the sound; None for silence.
        path: the smoothed path of the root, T frames at `fps`; None for a model without one.
        scale: metres of the path per metre of the reference body, see `ModelJoints.scale`.
        events: in order of time; None for no events.
        conditioner: of the first model with speech input; None without such a model.
        features: (T, S) speech features of that conditioner.
        vad: see `Controls.vad`.
    """

    n_frames: int
    fps: float
    wave: af.Wave | None
    path: RootPath | None
    scale: float
    events: tuple[Event, ...] | None
    conditioner: SpeechConditioner | None
    features: np.ndarray
    vad: bool | None = None

    @classmethod
    def build(
        cls,
        models: Sequence[Conditions],
        fps: float,
        scale: float,
        speech: str | Path | af.Wave | None,
        seconds: float | None,
        controls: DiffusionControls,
    ) -> Request:
        """Read the inputs, settle the length and extract speech features.

        Args:
            models: conditions of each model of the product, the first model's first.
            fps: frames per second of all models.
            scale: of their rig.
            speech: see `DiffusionModel.generate`.
            seconds: length without speech.
            controls: with `path` and checked `events` (see `check_events`).

        Raises:
            ModelError: an input that none of the models has, a missing path, or no length.
            AudioError, FormatError: a file that cannot be read.
        """
        path, events = controls.path, controls.events
        follows = models[0].path
        if path is not None and not follows:
            raise ModelError(
                f"path={path!r}: this model generates the root motion itself and cannot follow a "
                "path"
            )
        if path is None and follows:
            raise ModelError(
                "path: this model follows a path and needs one: a .csv with columns "
                "time,x,z[,heading], or a motion file"
            )
        followed = None if path is None else as_root_path(path, scale)
        if speech is None and seconds is None and followed is not None:
            seconds = followed.frames_within(fps) / fps
        conditioner = next((m.conditioner for m in models if m.conditioner is not None), None)
        sound, wave = speech, None
        if speech is not None and (conditioner is not None or wants_beats(events)):
            sound = wave = speech if isinstance(speech, af.Wave) else af.Wave.load(speech)
        if conditioner is None and wave is not None and seconds is None:
            # No model has speech input, but the beats of the sound are the times of events.
            sound, seconds = None, wave.n_frames(fps) / fps
        features = speech_features(conditioner, sound, seconds, fps, controls.vad)
        n_frames = len(features)
        found = None if events is None else asked_events(events, wave)
        if followed is not None:
            followed = smooth_path(followed, fps, n_frames)
        return cls(n_frames, fps, wave, followed, scale, found, conditioner, features, controls.vad)

    def condition(self, conditions: Conditions) -> np.ndarray:
        """Return a model's condition (T, C) float32, with its style left at zero."""
        speech, conditioner = None, conditions.conditioner
        if conditioner is not None and conditioner is self.conditioner:
            speech = self.features
        elif conditioner is not None:
            wave, n_frames = self.wave, self.n_frames
            if wave is None:
                speech = conditioner.silence(n_frames)
            else:
                speech = conditioner(wave, n_frames, self.vad)
        events = None
        if self.events is not None:
            events = [event for event in self.events if event.name in conditions.events]
        path = self.path.scaled(1 / self.scale) if conditions.path else None
        return conditions.encode(self.n_frames, self.fps, speech=speech, path=path, events=events)


def check_events(events: str | Path, models: Sequence[Conditions]) -> None:
    """Check the names of requested events without their sound.

    Raises:
        ModelError: a text that cannot be read, or an event that none of the models has.
        FormatError: a table that cannot be read.
    """
    if not any(model.events for model in models):
        raise ModelError(f"events={str(events)!r}: this model has no events")
    if wants_beats(events):
        events = re.sub(r"@beats\b", "@0", events)
    known = tuple(dict.fromkeys(name for model in models for name in model.events))
    for event in asked_events(events, None):
        check_event(event, known)
