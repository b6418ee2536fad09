"""A checked request for motion: files read, and the length of each level."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import audio_features as af
from gesturekit.corpus.speech import speech_features
from gesturekit.errors import ModelError
from gesturekit.formats.tables import as_root_path
from gesturekit.motion.motion import Motion
from gesturekit.motion.root_path import RootPath
from gesturekit.multires.conditions import level_range, requested_styles
from gesturekit.multires.controls import MultiresControls
from gesturekit.multires.keyframes import fit_keyframes, full_frames
from gesturekit.postprocess import Placement
from gesturekit.state.process import given_state
from gesturekit.training.clips import InbetweenClips, pose_on_rig
from gesturekit.training.seeds import rng_for

if TYPE_CHECKING:
    from gesturekit.multires.model import MultiresModel

log = logging.getLogger(__name__)

_HELD_SECONDS = 0.5
"""A motion to redo may be this much shorter than its sound."""
_OF_LEVELS = ("levels", "level_style", "level_speech", "keyframes", "like", "keep", "path")
"""Controls that a model without levels, which plays recordings, does not take."""
_OF_ALL_LEVELS = ("path", "like", "keyframes", "keep", "speaker")
"""Controls that a motion of a coarse level does not take."""


class Request:
    """A request for motions that differ only in their random numbers.

    Args:
        model: the trained model.
        controls: the controls of `generate`, checked.
        speech: its speech, or None.
        seconds: length without speech.

    Attributes:
        controls: see above.
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
        state: (T, C) state of movement that is given, or None to draw it.

    Raises:
        ModelError: controls that cannot be combined, or no length.
        AudioError, FormatError: a file cannot be read.
    """

    def __init__(
        self,
        model: MultiresModel,
        controls: MultiresControls,
        speech: str | Path | af.Wave | None,
        seconds: float | None,
    ) -> None:
        representation, fps = model.representation, model.fps
        network, conditioner = model.network_config, model.conditions.conditioner
        self.controls = controls
        self.is_coarse = controls["levels"] not in (None, network.levels)
        whole = [n for n, v in controls.items() if n in _OF_ALL_LEVELS and v is not None]
        if {"path", "like"} <= {*whole}:
            raise ModelError("path and like: give one of them")
        if self.is_coarse and whole:
            raise ModelError(f"{whole[0]} goes with all levels: leave levels away")
        start = controls["keyframes"] if controls["like"] is None else controls["like"]
        self.start = Motion.load(start) if isinstance(start, str | Path) else start
        self.clips, path = None, None
        if controls["keep"] is not None:
            self.clips = InbetweenClips(controls["keep"], representation, fps)
        if controls["path"] is not None:
            path = as_root_path(controls["path"], representation.scale)
        level = controls["keyframe_level"] - 1
        length_given = speech is not None or seconds is not None
        edited = None if controls["keyframes"] is None else self.start
        if not length_given:
            if edited is not None:
                self.start = fit_keyframes(representation, edited, fps, network, level, None)
            seconds = _own_seconds(fps, self.start, self.clips, path)
        if conditioner is not None and speech is not None and not isinstance(speech, af.Wave):
            speech = af.Wave.load(speech)
        self.wave = speech if isinstance(speech, af.Wave) else None
        features = speech_features(conditioner, speech, seconds, fps, controls["vad"])
        self.n_frames = n_frames = len(features)
        if edited is not None and length_given:
            self.start = fit_keyframes(representation, edited, fps, network, level, n_frames)
        if controls["like"] is not None and self.start is not None:
            _warn_of_held_pose(self.start, n_frames / fps)
        if self.clips is not None:
            self.clips.check_end(n_frames)
        # A coarse level is edited frame by frame, so it gets no frames around it.
        generates = self.start is None and not self.is_coarse
        self.margin = network.margin if generates else 0
        self.features = _with_margins(features, self.margin)
        self.lengths = network.lengths(n_frames + 2 * self.margin)
        speaker = controls["speaker"]
        self.skeleton = None if speaker is None else model.speakers[speaker]
        self.path = None if path is None else path.resample(fps, n_frames)
        self.level_speech = _level_speech(model, controls, n_frames, self.margin)
        read_pose = partial(pose_on_rig, representation)
        self.placement = Placement.of(controls, read_pose, on_path=path is not None)
        self.state = _given_state(model, controls, self.start, n_frames)


def _with_margins(features: np.ndarray, margin: int) -> np.ndarray:
    """Return features (T + 2 margin, S), which continue as at their ends: active or silent."""
    return np.pad(features, ((margin, margin), (0, 0)), mode="reflect")


def _given_state(
    model: MultiresModel, controls: MultiresControls, start: Motion | None, n_frames: int
) -> np.ndarray | None:
    """Return the state (T, C) that is given, or that of a motion to redo; None to draw it."""
    state = controls["state"]
    if model.state_process is None:
        return None
    if state is None and controls["like"] is not None and start is not None:
        state = model.state(start)
    return None if state is None else given_state(model.state_process, state, n_frames)


def _level_speech(
    model: MultiresModel, controls: MultiresControls, n_frames: int, margin: int
) -> tuple[tuple[range, np.ndarray], ...]:
    """Return `Request.level_speech`: the end of each speech is cut off, or silence follows it."""
    made, conditioner = [], model.conditions.conditioner
    for levels, speech in _level_speech_ranges(controls, model.network_config.levels):
        features = speech_features(conditioner, speech, None, model.fps, controls["vad"])[:n_frames]
        missing = n_frames - len(features)
        if missing and conditioner is not None:
            features = np.concatenate([features, conditioner.silence(missing)])
        made.append((levels, _with_margins(features, margin)))
    return tuple(made)


def _level_speech_ranges(
    controls: MultiresControls, n_levels: int
) -> list[tuple[range, str | Path | af.Wave]]:
    """Return the levels of each `level_speech`.

    Raises:
        ModelError: levels that the model does not have, or text that cannot be parsed.
    """
    return [
        (level_range(levels, n_levels, "level speech", "7-10=b.wav"), speech)
        for levels, speech in (controls["level_speech"] or {}).items()
    ]


def _warn_of_held_pose(like: Motion, seconds: float) -> None:
    if like.duration < seconds - _HELD_SECONDS:
        log.warning(
            "like: %.4g s of motion for %.4g s: the last pose is held to the end",
            like.duration,
            seconds,
        )


def check_controls(model: MultiresModel, controls: MultiresControls, samples: int) -> None:
    """Check the controls that do not depend on the speech, and the number of motions.

    Raises:
        ModelError: a style, level or speaker that the model does not have, level_speech without
            speech input, or liveliness or mood_seed without a state of movement.
    """
    if problem := next(_problems(model, controls, samples), None):
        raise ModelError(problem)


def _problems(model: MultiresModel, controls: MultiresControls, samples: int) -> Iterator[str]:
    """Yield what is wrong with controls; a style or a level's text is wrong by a ModelError."""
    levels = model.network_config.levels
    if model.styles:
        lengths, rng = [1] * levels, rng_for(0, "check")
        requested_styles(model.styles, controls, lengths, fps=model.fps, rng=rng)
    for name, value in (("style", controls["style"]), ("level_style", controls["level_style"])):
        if value is not None and not model.styles:
            yield f"{name}={value!r}: this multires model has no {name}"
    if _level_speech_ranges(controls, levels) and model.conditions.conditioner is None:
        yield "level_speech: this model takes no speech"
    yield from model.problems(controls, samples)
    for which in ("levels", "keyframe_level"):
        level = controls[which]
        if level is not None and not 1 <= level <= levels:
            yield f"{which}={level}: the model has levels 1 (coarse) to {levels}"
    of_levels = [name for name, value in controls.items() if name in _OF_LEVELS and value]
    if model.retrieves and of_levels:
        yield f"{of_levels[0]}: this model plays recordings, without a network's levels"


def _own_seconds(
    fps: float, start: Motion | None, clips: InbetweenClips | None, path: RootPath | None
) -> float | None:
    """Return the length of a motion without speech or seconds, from a control that has one."""
    if start is not None:
        return full_frames(start, fps) / fps
    if clips is not None:
        return clips.end / fps
    return None if path is None else path.frames_within(fps) / fps
