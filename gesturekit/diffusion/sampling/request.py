"""Request for one motion: speech, path, events and their conditions, and the start of SDEdit."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import audio_features as af
from gesturekit.corpus.speech import SpeechConditioner, speech_features
from gesturekit.diffusion.conditions import Conditions, smooth_path
from gesturekit.diffusion.controls import DiffusionControls
from gesturekit.diffusion.events import asked_events, check_event, wants_beats
from gesturekit.diffusion.sampling.experts import MAX_DEVIATION
from gesturekit.diffusion.sampling.solvers import last_step_with_signal
from gesturekit.diffusion.trained_model import TrainedModel
from gesturekit.errors import ModelError
from gesturekit.formats.tables import Event, as_root_path
from gesturekit.motion.contacts import floor_height
from gesturekit.motion.motion import Motion
from gesturekit.motion.root_path import RootPath
from gesturekit.postprocess import Placement
from gesturekit.training.data.own_rig import on_rig, pose_on_rig


@dataclass(frozen=True, eq=False)
class Request:
    """Everything that one motion is generated from, except its style.

    Attributes:
        controls: the controls of `generate`, checked.
        n_frames: T.
        fps: frames per second.
        seconds: length without speech, or None.
        start: a motion from which sampling starts; None for pure noise.
        wave: the sound; None for silence.
        path: the smoothed path of the root, T frames at `fps`; None for a model without one.
        scale: metres of the path per metre of the reference body, see `ModelJoints.scale`.
        events: in order of time; None for no events.
        conditioner: of the first model with speech input; None without such a model.
        features: (T, S) speech features of that conditioner.
        placement: where and how the motion begins and ends.
    """

    controls: DiffusionControls
    n_frames: int
    fps: float
    seconds: float | None
    start: SDEditStart | None
    wave: af.Wave | None
    path: RootPath | None
    scale: float
    events: tuple[Event, ...] | None
    conditioner: SpeechConditioner | None
    features: np.ndarray
    placement: Placement

    @classmethod
    def build(
        cls,
        models: Sequence[TrainedModel],
        controls: DiffusionControls,
        speech: str | Path | af.Wave | None,
        seconds: float | None,
    ) -> Request:
        """Read the inputs, settle the length and extract speech features.

        Args:
            models: of the product; the first is the one that generates.
            controls: checked (see `check_controls`).
            speech: see `DiffusionModel.generate`.
            seconds: length without speech.

        Raises:
            ModelError: an input that none of the models has, a missing path, or no length.
            AudioError, FormatError: a file that cannot be read.
        """
        model, start = models[0], None
        read_pose = partial(pose_on_rig, model.representation)
        fps, follows = model.fps, model.conditions.path
        path, events = controls["path"], controls["events"]
        if controls["like"] is not None:
            start = SDEditStart.build(model, controls["like"], controls["change"])
            if follows and path is None:
                path = start.path
            if speech is None and seconds is None and path is None:
                seconds = start.motion.duration
        followed = _followed(model, path)
        length = seconds
        if speech is None and seconds is None and followed is not None:
            length = followed.frames_within(fps) / fps
        conditioners = (one.conditions.conditioner for one in models)
        conditioner = next((one for one in conditioners if one is not None), None)
        sound, wave = speech, None
        if speech is not None and (conditioner is not None or wants_beats(events)):
            sound = wave = speech if isinstance(speech, af.Wave) else af.Wave.load(speech)
        if conditioner is None and wave is not None and length is None:
            # No model has speech input, but the beats of the sound are the times of events.
            sound, length = None, wave.n_frames(fps) / fps
        features = speech_features(conditioner, sound, length, fps, controls["vad"])
        n_frames = len(features)
        found = None if events is None else asked_events(events, wave)
        if followed is not None:
            followed = smooth_path(followed, fps, n_frames)
        return cls(
            controls=controls,
            n_frames=n_frames,
            fps=fps,
            seconds=seconds,
            start=start,
            wave=wave,
            path=followed,
            scale=model.representation.scale,
            events=found,
            conditioner=conditioner,
            features=features,
            placement=Placement.of(controls, read_pose, on_path=follows),
        )

    def condition(self, conditions: Conditions) -> np.ndarray:
        """Return a model's condition (T, C) float32, with its style and state left at zero."""
        speech, conditioner = None, conditions.conditioner
        if conditioner is not None and conditioner is self.conditioner:
            speech = self.features
        elif conditioner is not None:
            wave, n_frames = self.wave, self.n_frames
            if wave is None:
                speech = conditioner.silence(n_frames)
            else:
                speech = conditioner(wave, n_frames, self.controls["vad"])
        events = None
        if self.events is not None:
            events = [event for event in self.events if event.name in conditions.events]
        path = None
        if conditions.path and self.path is not None:
            path = self.path.scaled(1 / self.scale)
        return conditions.encode(self.n_frames, self.fps, speech=speech, path=path, events=events)


def _followed(model: TrainedModel, path: str | Path | RootPath | Motion | None) -> RootPath | None:
    """Return the path that the root follows, or None for a model that moves the root itself.

    Raises:
        ModelError: the model follows no path, or there is none.
        FormatError: a file that cannot be read.
    """
    if path is not None and not model.conditions.path:
        raise ModelError(
            f"path={path!r}: this model generates the root motion itself and cannot follow a path"
        )
    if path is None and model.conditions.path:
        raise ModelError(
            "path: this model follows a path and needs one: a .csv with columns "
            "time,x,z[,heading], or a motion file"
        )
    return None if path is None else as_root_path(path, model.representation.scale)


def check_events(events: str | Path, models: Sequence[Conditions]) -> None:
    """Check the names of requested events without their sound.

    Raises:
        ModelError: a text that cannot be read, or an event that none of the models has.
        FormatError: a table that cannot be read.
    """
    if not any(model.events for model in models):
        raise ModelError(f"events={str(events)!r}: this model has no events")
    if isinstance(events, str) and wants_beats(events):
        events = re.sub(r"@beats\b", "@0", events)
    known = tuple(dict.fromkeys(name for model in models for name in model.events))
    for event in asked_events(events, None):
        check_event(event, known)


@dataclass(frozen=True, eq=False)
class SDEditStart:
    """Motion from which sampling starts instead of from pure noise (SDEdit, Meng et al. 2022).

    The motion is noised up to some step of the schedule and denoised from there. Structure coarser
    than the noise is kept.

    Attributes:
        model: the model that continues from it.
        motion: on the model's rig, at its frame rate.
        lift: metres that the motion must be raised to stand on the model's floor.
        step: of the noise schedule, up to which the motion is noised.
    """

    model: TrainedModel
    motion: Motion
    lift: float
    step: int

    @classmethod
    def build(cls, model: TrainedModel, like: str | Path | Motion, change: float) -> SDEditStart:
        """Put a motion on the model's rig and choose the noise level.

        Args:
            model: the model that continues from it.
            like: a motion of any human rig, or its file.
            change: above 0, at most 1: the noise level, from the first step of the schedule to the
                last one with any signal, evenly in log signal-to-noise ratio. It is also the
                fraction of a few-step solver's steps that remain.

        Raises:
            ModelError: the motion cannot be put on the rig.
            FormatError: a file that cannot be read.
        """
        given = like if isinstance(like, Motion) else Motion.load(like)
        motion, lift = on_rig(model.representation, given), 0.0
        if motion is not given:
            # The floor of a foreign file is unknown; that of this rig is known.
            lift = _floor_of_model(model) - floor_height(motion)
        motion = motion.resample(model.fps)
        level = model.schedule.log_snr()[: last_step_with_signal(model.schedule) + 1]
        wanted = level[0] + change * (level[-1] - level[0])
        return cls(model, motion, lift, int((level - wanted).abs().argmin()))

    @property
    def path(self) -> RootPath:
        """The path of its root over the ground."""
        return self.model.representation.path_of(self.motion)

    @property
    def place(self) -> tuple[float, float, float]:
        """x and z in metres and heading in radians of its first frame."""
        path = self.path
        return (*path.positions[0], path.headings[0])

    def clean(self, n_frames: int) -> Tensor:
        """Return the normalised motion (T, X), cut or extended with its last pose to T frames."""
        own = self.model.representation
        values = own.encode(self.motion.resample(self.model.fps, n_frames))
        values[:, own.height_column] += self.lift / own.scale
        vectors = self.model.normaliser.forward(torch.from_numpy(values).float())
        # Another rig may bend joints that hardly move in the training data.
        return vectors.clamp(-MAX_DEVIATION, MAX_DEVIATION).to(self.model.device)


def _floor_of_model(model: TrainedModel) -> float:
    """Return the height of the lowest joint in the rig's mean pose, in metres."""
    own = model.representation
    height = float(model.normaliser.mean[own.height_column]) * own.scale
    place = np.array([[0.0, height, 0.0]])
    return floor_height(own.assemble(own.fixed_pose(1), place, model.fps, None))
