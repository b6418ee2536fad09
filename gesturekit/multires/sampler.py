"""Sampling of a request: read it, generate each motion under its constraints, smooth, lock feet."""

from __future__ import annotations

import logging
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

import audio_features as af
from gesturekit.corpus.speech import speech_features
from gesturekit.formats.tables import as_root_path
from gesturekit.motion.motion import Motion
from gesturekit.multires.constraints import InbetweenConstraint, PathConstraint, placed_clips
from gesturekit.multires.controls import MultiresControls
from gesturekit.multires.keyframes import (
    KeyframeConstraint,
    fit_keyframes,
    full_frames,
    keep_unedited,
    level_motion,
    motion_level,
    moved,
    root_through_keyframes,
)
from gesturekit.multires.motion_vector import fastest_second
from gesturekit.multires.pyramid import Pyramid, level_range, requested_styles
from gesturekit.multires.retrieval import PieceSequence, played_pieces
from gesturekit.postprocess import Placement, lock_feet, smooth_motion
from gesturekit.state.process import given_state, mood_seed
from gesturekit.training.clips import InbetweenClips, mixed_motions, pose_on_rig
from gesturekit.training.seeds import rng_for

if TYPE_CHECKING:
    from gesturekit.multires.model import MultiresModel

_HELD_SECONDS = 0.5
"""A motion to redo may be this much shorter than its sound."""
_TOO_FAST = 1.25
"""A speed this many times the fastest second in training is worth a warning ..."""
_STROLL = 0.1
"""... if it is also above this many m/s on the reference body."""

log = logging.getLogger(__name__)


class Sampler:
    """A request for motions that differ only in their random numbers.

    Args:
        model: the trained model.
        controls: the controls of `generate`, checked.
        speech: its speech, or None.
        seconds: length without speech.

    Attributes:
        wave: the speech, or None.
        features: (T + 2 margin, S) speech features; S is 0 for a model without speech input.
        n_frames: T, without margins.
        margin: frames generated before and after the motion, and cut off.
        lengths: frames of each level, margins included.
        is_coarse: True if the motion ends with a level that is not the finest.
        skeleton: rig whose bone lengths to use; None for the reference skeleton.
        start: a motion that replaces the output of a coarse level, or None for noise.
        path: the path of the root, T frames at the model's rate, or None.
        clips: the clips of in-betweening, or None.
        level_speech: levels with speech of their own, and its features, shaped as `features`.
        placement: where and how the motion begins and ends.
        state: (T, C) state of movement that is given, or that of a motion to redo; None to draw it.

    Raises:
        ModelError: no length, or an input that does not fit the model.
        AudioError, FormatError: a file cannot be read.
    """

    def __init__(
        self,
        model: MultiresModel,
        controls: MultiresControls,
        speech: str | Path | af.Wave | None,
        seconds: float | None,
    ) -> None:
        self.model, self.controls = model, controls
        representation, fps, network = model.representation, model.fps, model.network_config
        self.is_coarse = controls["levels"] not in (None, network.levels)
        edited, like = controls["keyframes"], controls["like"]
        start = edited if like is None else like
        self.start = Motion.load(start) if isinstance(start, str | Path) else start
        self.clips, path = None, None
        if controls["keep"] is not None:
            self.clips = InbetweenClips(controls["keep"], representation, fps)
        if controls["path"] is not None:
            path = as_root_path(controls["path"], representation.scale)
        level = controls["keyframe_level"] - 1
        has_length = speech is not None or seconds is not None
        if not has_length and self.start is not None:
            if edited is not None:
                self.start = fit_keyframes(model, self.start, level, None)
            seconds = full_frames(self.start, fps) / fps
        elif not has_length and self.clips is not None:
            seconds = self.clips.end / fps
        elif not has_length and path is not None:
            seconds = path.frames_within(fps) / fps
        if model.conditions.conditioner and speech is not None and not isinstance(speech, af.Wave):
            speech = af.Wave.load(speech)
        self.wave = speech if isinstance(speech, af.Wave) else None
        features = self._features(speech, seconds)
        self.n_frames = len(features)
        if edited is not None and self.start is not None and has_length:
            self.start = fit_keyframes(model, self.start, level, self.n_frames)
        # A coarse level is edited frame by frame, so it gets no frames around it.
        generates = self.start is None and not self.is_coarse
        self.margin = network.margin if generates else 0
        self.features = self._with_margins(features)
        self.lengths = network.lengths(self.n_frames + 2 * self.margin)
        speaker = controls["speaker"]
        self.skeleton = None if speaker is None else model.speakers[speaker]
        self.level_speech = self._level_speech()
        self.path = None if path is None else path.resample(fps, self.n_frames)
        read_pose = partial(pose_on_rig, representation)
        self.placement = Placement.of(controls, read_pose, on_path=path is not None)
        self._constrain()

    def _features(self, speech: str | Path | af.Wave | None, seconds: float | None) -> np.ndarray:
        model = self.model
        conditioner, vad = model.conditions.conditioner, self.controls["vad"]
        return speech_features(conditioner, speech, seconds, model.fps, vad)

    def _with_margins(self, features: np.ndarray) -> np.ndarray:
        """Return features (T + 2 margin, S), which continue as at their ends: active or silent."""
        return np.pad(features, ((self.margin, self.margin), (0, 0)), mode="reflect")

    def _level_speech(self) -> list[tuple[range, np.ndarray]]:
        """Return `level_speech`: the end of each speech is cut off, or silence follows it."""
        made, conditioner = [], self.model.conditions.conditioner
        for text, speech in (self.controls["level_speech"] or {}).items():
            levels = level_range(text, len(self.lengths), "level speech")
            features = self._features(speech, None)[: self.n_frames]
            missing = self.n_frames - len(features)
            if missing and conditioner is not None:
                features = np.concatenate([features, conditioner.silence(missing)])
            made.append((levels, self._with_margins(features)))
        return made

    def _constrain(self) -> None:
        """Read the given state, and make the constraints on where the body goes."""
        model, state = self.model, self.controls["state"]
        if self.controls["like"] is not None and self.start is not None:
            if self.start.duration < self.n_frames / model.fps - _HELD_SECONDS:
                log.warning(
                    "like: %.4g s of motion for %.4g s: the last pose is held to the end",
                    *(self.start.duration, self.n_frames / model.fps),
                )
            if state is None and model.state_process is not None:
                state = model.state(self.start)
        self.state = None
        if state is not None and model.state_process is not None:
            self.state = given_state(model.state_process, state, self.n_frames)
        about = model.representation, model.normaliser, self.lengths, self.margin
        self.along = self.between = None
        if self.path is not None:
            path = self.path.scaled(1 / model.representation.size_of(self.skeleton))
            steps = np.diff(path.positions, axis=0)
            self._warn_of_speed("the path", fastest_second(steps, model.fps))
            self.along = PathConstraint(path.scaled(1 / model.representation.scale), *about)
        if self.clips is not None:
            self.clips.check_end(self.n_frames)
            self._warn_of_speed("between the clips the body", self.clips.fastest_gap())
            self.between = InbetweenConstraint(self.clips, *about)

    def _warn_of_speed(self, what: str, speed: float) -> None:
        fastest, stroll = self.model.fastest, _STROLL * self.model.representation.scale
        if speed > max(_TOO_FAST * fastest, stroll):
            log.warning(
                "%s goes %.2f m/s; nothing in the training was faster than %.2f m/s, and feet will "
                "slide",
                what,
                speed,
                fastest,
            )

    def motion(self, seed: int, item: str, number: int) -> Motion:
        """Generate the sample of an item with this number."""
        model, controls, process = self.model, self.controls, self.model.state_process
        rng_of = partial(rng_for, seed, item, "sample", number)
        styles, state, played = list[Tensor](), None, None
        if model.styles:
            ask = partial(requested_styles, model.styles, controls, self.lengths, fps=model.fps)
            styles = ask(rng=rng_of("style"), margin=self.margin)
        if process is not None:
            mood = rng_for(mood_seed(seed, controls), item, "sample", number, "mood")
            channels = self._channels(mood, styles)
            state = process.condition(rng_of("carriers").initial_seed() >> 1, channels)
            if model.library is not None and not self.is_coarse:
                played = played_pieces(
                    model.library,
                    process.with_voice(channels, self.features.T),
                    partial(rng_of, "piece"),
                    controls["speaker"],
                    styles[-1][0].argmax(dim=0).numpy() if styles else None,
                )
        condition = model.conditions.of_motion(
            self.features, self.lengths, styles, self.level_speech, state
        )
        pyramid = Pyramid(model, self.lengths, condition, lambda i: rng_of("level", i + 1))
        motion = self._generated(pyramid, played)
        if played is not None:
            motion = played.with_passive(motion, self.margin)
        return motion if self.clips is None else self.clips.restored(motion)

    def _channels(self, rng: torch.Generator, styles: list[Tensor]) -> np.ndarray:
        """Return the channels (C, T + 2 margin) of the state of movement, given or drawn."""
        controls, process = self.controls, self.model.state_process
        assert process is not None
        if self.state is not None:
            return np.pad(self.state.T, ((0, 0), (self.margin, self.margin)), mode="edge")
        style = int(styles[0][0].mean(dim=-1).argmax()) if styles else None
        return process.draw(
            rng.initial_seed() >> 1,
            self.features.T,
            (controls["speaker"], style),
            first=-self.margin,
            liveliness=controls["liveliness"],
        )

    def _generated(self, pyramid: Pyramid, played: PieceSequence | None) -> Motion:
        """Generate the motion of the modelled joints, as the request's constraints say."""
        model, representation = self.model, self.model.representation
        if self.start is not None:
            return self._from_level(pyramid, self.start)
        if self.is_coarse:
            values = pyramid.random(levels=self.controls["levels"])
            return level_motion(model, values, self.n_frames)
        if self.clips is not None:
            values = self._cropped(pyramid.random(constraint=self.between))
            motion = self._smoothed(placed_clips(self.clips, values, representation))
            return self._locked(motion, values, self.clips.given(self.n_frames), keep_path=True)
        if self.along is not None and self.path is not None:
            values = self._cropped(self.along.placed(pyramid.random(constraint=self.along)))
            motion = moved(representation, self._decoded(values), self.path.positions[0])
            return self._locked(self._smoothed(motion), values, keep_path=True)
        if played is not None and played.is_whole:
            vectors = played.values(np.arange(self.lengths[-1]))[:, : representation.n_features]
            values = model.normaliser.to_values(torch.from_numpy(vectors.T[None]))
        else:
            values = pyramid.random()
        values = self._cropped(values)
        return self._locked(self._smoothed(self._decoded(values)), values)

    def _from_level(self, pyramid: Pyramid, start: Motion) -> Motion:
        """Generate the levels above keyframes, or above a motion to redo (`like`)."""
        model, level = self.model, self.controls["keyframe_level"] - 1
        representation, lengths = model.representation, self.lengths
        coarse = motion_level(model, start, lengths, level)
        edited = np.ones(coarse.shape, bool)
        if start.n_frames == lengths[level]:
            # It may be an edit of what this seed generates.
            made = pyramid.random(levels=level + 1)
            unedited = level_motion(model, made, lengths[-1])
            read = motion_level(model, unedited, lengths, level)
            coarse, edited = keep_unedited(coarse, made, read, representation)
        if self.controls["like"] is not None:
            values = pyramid.random(coarser=coarse, first=level + 1)
            return self._locked(self._smoothed(self._decoded(values)), values)
        constraint = KeyframeConstraint(coarse, edited, representation, model.normaliser)
        values = pyramid.random(coarser=coarse, first=level + 1, constraint=constraint)
        given = constraint.edited_feet(self.n_frames)
        free = self._smoothed(self._decoded(values))
        locked = self._locked(free, values, given)
        frames = np.asarray(edited.any(axis=1))
        if not frames.any():
            return locked
        # Foot locking moves the root, so its drift is known only now. Feet are locked again on the
        # path through the keyframes: merely moved along, they slide a fifth faster there.
        wanted = level_motion(model, coarse, self.n_frames)
        motion = root_through_keyframes(representation, free, locked, wanted, frames)
        return self._locked(motion, values, given, keep_path=True)

    def _cropped(self, values: np.ndarray) -> np.ndarray:
        """Return (T, D) without the margins."""
        return values[self.margin : len(values) - self.margin]

    def _decoded(self, values: np.ndarray) -> Motion:
        """Return the motion of vectors (T, D)."""
        return self.model.representation.decode(values, self.model.fps, skeleton=self.skeleton)

    def _smoothed(self, motion: Motion) -> Motion:
        smooth = self.controls["smooth"]
        smooth = self.model.smooth if smooth is None else smooth
        return smooth_motion(motion, smooth) if smooth else motion

    def _locked(
        self,
        motion: Motion,
        values: np.ndarray,
        given: np.ndarray | None = None,
        *,
        keep_path: bool = False,
    ) -> Motion:
        """Return the motion with locked feet, unless foot locking is off.

        Args:
            motion: T frames.
            values: (T, D) vectors with the contact labels.
            given: (T,) 1 where the motion stays as it is, 0 where feet are locked, with smooth
                transitions; None locks them everywhere.
            keep_path: see `lock_feet`.
        """
        if not self.controls["foot_lock"]:
            return motion
        labels = values[:, self.model.representation.layout.contacts]
        locked = lock_feet(motion, labels, keep_path=keep_path)
        return locked if given is None or not given.any() else mixed_motions(locked, motion, given)
