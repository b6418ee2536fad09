"""Request for one motion: speech, path, events and their conditions, and the start of SDEdit."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

import audio_features as af
from gesturekit.corpus.speech import SpeechConditioner, speech_features
from gesturekit.diffusion.conditions import (
    Conditions,
    asked_events,
    check_event,
    smooth_path,
    wants_beats,
)
from gesturekit.diffusion.controls import DiffusionControls
from gesturekit.diffusion.inbetween import InbetweenConstraint
from gesturekit.diffusion.motion_vector import measured_state
from gesturekit.diffusion.noise_schedule import MAX_DEVIATION, last_step_with_signal
from gesturekit.errors import ModelError
from gesturekit.formats.tables import as_root_path
from gesturekit.motion.contacts import floor_height
from gesturekit.motion.motion import Motion
from gesturekit.motion.root_path import RootPath
from gesturekit.postprocess import Placement
from gesturekit.state.process import given_state
from gesturekit.training.clips import InbetweenClips, on_rig, pose_on_rig

if TYPE_CHECKING:
    from gesturekit.diffusion.experts import Member
    from gesturekit.diffusion.model import DiffusionModel


class Request:
    """Everything that motions are generated from: inputs are read, and the length is settled.

    Args:
        members: of the product; the first is the model that generates.
        controls: checked (see `check_controls`).
        speech: see `DiffusionModel.generate`.
        seconds: length without speech, or None.
        seed: with `item` and the number of a sample, it decides all random numbers.
        item: name of the utterance.

    Attributes:
        model: the first of the members.
        n_frames: T.
        fps: frames per second.
        start: normalised motion (T, X) and the step up to which it is noised, from which sampling
            starts; None for pure noise.
        between: the clips of in-betweening; None for none.
        place: x and z in metres and heading in radians of the first frame, without a path.
        state: channels (C, T) of the state of movement that is given, or that of the motion to
            start from; None to draw it.
        wave: the sound; None for silence.
        path: the smoothed path of the root, T frames at `fps`; None for a model without one.
        events: in order of time; None for no events.
        features: (T, S) speech features of each conditioner.
        placement: where and how the motion begins and ends.

    Raises:
        ModelError: an input that none of the models has, a missing path, or no length.
        AudioError, FormatError: a file that cannot be read.
    """

    def __init__(
        self,
        members: Sequence[Member],
        controls: DiffusionControls,
        speech: str | Path | af.Wave | None,
        seconds: float | None,
        seed: int,
        item: str,
    ) -> None:
        self.members, self.controls, self.seconds = members, controls, seconds
        self.seed, self.item = seed, item
        self.model = model = members[0].model
        self.fps = fps = model.fps
        path, begin, events = controls["path"], None, controls["events"]
        if controls["like"] is not None:
            begin = SDEditStart(model, controls["like"])
            if model.conditions.path and path is None:
                path = begin.path
            if speech is None and seconds is None and path is None:
                self.seconds = begin.motion.duration
        followed, length = _followed(model, path), self.seconds
        if speech is None and length is None and followed is not None:
            length = followed.frames_within(fps) / fps
        clips = None
        if controls["keep"] is not None:
            clips = InbetweenClips(controls["keep"], model.representation, fps)
            if speech is None and length is None:
                length = self.seconds = clips.end / fps
        conditioners = _conditioners(members, controls)
        sound, wave = speech, None
        if speech is not None and (conditioners or wants_beats(events)):
            sound = wave = speech if isinstance(speech, af.Wave) else af.Wave.load(speech)
        if not conditioners and wave is not None and length is None:
            # No model has speech input, but the beats of the sound are the times of events.
            sound, length = None, wave.n_frames(fps) / fps
        first, vad = next(iter(conditioners), None), controls["vad"]
        values = speech_features(first, sound, length, fps, vad)
        self.n_frames = n_frames = len(values)
        self.features = {} if first is None else {first: values}
        for other in conditioners[1:]:
            values = other.silence(n_frames) if wave is None else other(wave, n_frames, vad)
            self.features[other] = values
        self.wave = wave
        self.between = None
        if clips is not None:
            clips.check_end(n_frames)
            self.between = InbetweenConstraint(model, clips, n_frames)
        self.start = None if begin is None else begin.noised(n_frames, controls["change"])
        self.place = (0.0, 0.0, 0.0)
        if begin is not None:
            self.place = (*begin.path.positions[0], begin.path.headings[0])
        self.state = _known_state(members, controls, self.start, n_frames)
        self.path = None if followed is None else smooth_path(followed, fps, n_frames)
        self.events = None if events is None else asked_events(events, wave)
        read_pose = partial(pose_on_rig, model.representation)
        self.placement = Placement.of(controls, read_pose, on_path=model.conditions.path)

    def condition(self, conditions: Conditions) -> np.ndarray:
        """Return a model's condition (T, C) float32, with its style and state left at zero."""
        speech = events = path = None
        if conditions.conditioner is not None:
            speech = self.features[conditions.conditioner]
        if self.events is not None:
            events = [event for event in self.events if event.name in conditions.events]
        if conditions.path and self.path is not None:
            path = self.path.scaled(1 / self.model.representation.scale)
        return conditions.encode(self.n_frames, self.fps, speech=speech, path=path, events=events)


def _conditioners(
    members: Sequence[Member], controls: DiffusionControls
) -> list[SpeechConditioner]:
    """Return the conditioners of all models with speech input, each once."""
    models = [*(member.model for member in members), controls["unconditional"]]
    conditioners = (m.conditions.conditioner for m in models if m is not None)
    return [known for known in dict.fromkeys(conditioners) if known is not None]


def _known_state(
    members: Sequence[Member],
    controls: DiffusionControls,
    start: tuple[Tensor, int] | None,
    n_frames: int,
) -> np.ndarray | None:
    """Return the state (C, T) that is given, or that of the motion to start from; else None."""
    model = next((m.model for m in members if m.model.state_process is not None), None)
    if model is None or model.state_process is None:
        return None
    process = model.state_process
    if controls["state"] is not None:
        return given_state(process, controls["state"], n_frames).T
    if start is None:
        return None
    vectors = model.normaliser.inverse(start[0].cpu()).numpy()
    return measured_state(vectors, model.representation, process.channels, process.fps)


def _followed(
    model: DiffusionModel, path: str | Path | RootPath | Motion | None
) -> RootPath | None:
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


class SDEditStart:
    """Motion from which sampling starts instead of from pure noise (SDEdit, Meng et al. 2022).

    The motion is noised up to some step of the schedule and denoised from there. Structure coarser
    than the noise is kept.

    Args:
        model: the model that continues from it.
        like: a motion of any human rig, or its file.

    Attributes:
        motion: on the model's rig, at its frame rate.
        path: of its root over the ground.
        lift: metres that the motion must be raised to stand on the model's floor.

    Raises:
        ModelError: the motion cannot be put on the rig.
        FormatError: a file that cannot be read.
    """

    def __init__(self, model: DiffusionModel, like: str | Path | Motion) -> None:
        given = like if isinstance(like, Motion) else Motion.load(like)
        motion = on_rig(model.representation, given)
        self.model, self.motion, self.lift = model, motion.resample(model.fps), 0.0
        if motion is not given:
            # The floor of a foreign file is unknown; that of this rig is known.
            self.lift = _floor_of_model(model) - floor_height(motion)
        self.path = model.representation.path_of(self.motion)

    def noised(self, n_frames: int, change: float) -> tuple[Tensor, int]:
        """Return the normalised motion (T, X) and the step up to which it is noised.

        Args:
            n_frames: T; the motion is cut, or extended with its last pose.
            change: above 0, at most 1: the noise level, from the first step of the schedule to the
                last one with any signal, evenly in log signal-to-noise ratio. It is also the
                fraction of a few-step solver's steps that remain.
        """
        model, representation = self.model, self.model.representation
        values = representation.encode(self.motion.resample(model.fps, n_frames))
        values[:, representation.height_column] += self.lift / representation.scale
        vectors = model.normaliser.forward(torch.from_numpy(values).float())
        level = model.schedule.log_snr()[: last_step_with_signal(model.schedule) + 1]
        wanted = level[0] + change * (level[-1] - level[0])
        # Another rig may bend joints that hardly move in the training data.
        clean = vectors.clamp(-MAX_DEVIATION, MAX_DEVIATION).to(model.device)
        return clean, int((level - wanted).abs().argmin())


def _floor_of_model(model: DiffusionModel) -> float:
    """Return the height of the lowest joint in the rig's mean pose, in metres."""
    rig = model.representation
    height = float(model.normaliser.mean[rig.height_column]) * rig.scale
    place = np.array([[0.0, height, 0.0]])
    return floor_height(rig.assemble(rig.fixed_pose(1), place, model.fps, None))
