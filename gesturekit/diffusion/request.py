"""Request for motions: its controls are checked, its inputs read, and its length settled."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

import audio_features as af
from gesturekit.corpus.checks import first_difference
from gesturekit.corpus.speech import speech_features
from gesturekit.diffusion.conditions import (
    BEATS,
    Conditions,
    ExpertWeight,
    asked_events,
    check_event,
    smooth_path,
    style_weights,
    wants_beats,
    weight_track,
)
from gesturekit.diffusion.controls import DiffusionControls
from gesturekit.diffusion.noise_schedule import MAX_DEVIATION, chosen_steps, last_step_with_signal
from gesturekit.errors import ModelError
from gesturekit.formats.tables import as_root_path
from gesturekit.motion.contacts import floor_height
from gesturekit.motion.motion import Motion
from gesturekit.postprocess import Placement
from gesturekit.training.clips import InbetweenClips, on_rig, pose_on_rig

if TYPE_CHECKING:
    from gesturekit.diffusion.model import DiffusionModel

_SCALE_TOLERANCE = 1e-4
"""Largest relative difference between the scales of two models that can be combined."""


class Member(NamedTuple):
    """A model of a product, with its weight, and its style; None for a random style."""

    model: DiffusionModel
    weight: ExpertWeight
    style: str | None


def check_controls(
    model: DiffusionModel, controls: DiffusionControls, samples: int
) -> list[Member]:
    """Check the controls that do not depend on the speech, and return the models of the product.

    An expert without a style gets the style of the first model if it has that style, and a random
    one otherwise.

    Raises:
        ModelError: a control, style, event or speaker that the model does not have, experts that
            cannot be combined, or guidance that none of the models supports.
        FormatError: a table of events that cannot be read.
    """
    if problem := next(_problems(model, controls, samples), None):
        raise ModelError(problem)
    members = [Member(model, None, controls["style"])]
    for other, weight, style in ((*expert, None, None)[:3] for expert in controls["experts"]):
        if isinstance(weight, str):
            weight_track(weight, 1, model.fps)
        if style is None and controls["style"] is not None:
            with suppress(ModelError):
                style_weights(other.styles, controls["style"], 1, other.fps)
                style = controls["style"]
        members.append(Member(other, weight, style))
    for member, _, style in members:
        if member.styles and style is not None:
            style_weights(member.styles, style, 1, member.fps)
    if (events := controls["events"]) is not None:
        known = tuple(dict.fromkeys(name for m in members for name in m.model.conditions.events))
        if not known:
            raise ModelError(f"events={str(events)!r}: this model has no events")
        without_beats = BEATS.sub("0", events) if isinstance(events, str) else events
        for event in asked_events(without_beats, None):
            check_event(event, known)
    if controls["like"] is None:
        chosen_steps(model.schedule, controls["steps"])
    return members


def _problems(model: DiffusionModel, controls: DiffusionControls, samples: int) -> Iterator[str]:
    """Yield what is wrong with a request, beside styles, weights and events over time."""
    yield from model.problems(controls, samples)
    if model.conditions.path:
        placed = {"facing": controls["facing"], "in_place": controls["in_place"] or None}
        for name, value in placed.items():
            if value is not None:
                yield f"{name}={value}: the model follows a path, which places the body"
        if controls["keep"] is not None:
            yield "keep: this model follows a path, which moves the body"
    elif (path := controls["path"]) is not None:
        yield f"path={path!r}: this model generates the root motion and cannot follow a path"
    for number, expert in enumerate(controls["experts"], start=1):
        if not 1 <= len(expert) <= 3:
            yield f"expert {number}: expected (model, weight) or + (style,)"
        yield from (f"expert {number}: {reason}" for reason in _differences(model, expert[0]))
    styled = (model, *(expert[0] for expert in controls["experts"]))
    if (style := controls["style"]) is not None and not any(each.styles for each in styled):
        yield f"style={style!r}: this model has no styles"
    guidance, unconditional = controls["guidance"], controls["unconditional"]
    if (gamma := controls["state_guidance"]) is not None and "state" not in model.droppable:
        how = "of the state (training.dropout_state above 0)"
        yield f"state_guidance={gamma:g}: this model was trained without dropout {how}"
    if unconditional is not None:
        if guidance is None:
            yield "unconditional: only used with guidance; give guidance too"
        yield from (f"unconditional: {reason}" for reason in _differences(model, unconditional))
        if unconditional.styles and not {"styles", "all"} & set(unconditional.droppable):
            yield "unconditional: that model needs a style too; give one trained with styles: null"
    elif guidance is not None:
        if not model.conditions.columns["state"].start:
            yield f"guidance={guidance:g}: this model has no conditions to guide on"
        if not ("all" in model.droppable or (model.styles and "styles" in model.droppable)):
            what = "style" if model.styles else "condition"
            how = f"(training.dropout_{what} above 0); give an unconditional model beside it"
            yield f"guidance={guidance:g}: this model was trained without {what} dropout {how}"


def _differences(first: DiffusionModel, other: Any) -> Iterator[str]:
    """Yield reasons for which the motion vectors or noise of two models differ in meaning."""
    kind = getattr(other, "kind", type(other).__name__)
    if kind != first.kind:
        yield f"a {kind} model; only diffusion models can be combined"
    if other.device != first.device:
        yield f"is on {other.device}, this model on {first.device}; load both on one device"
    if other.fps != first.fps:
        yield f"moves at {other.fps:g} fps, this model at {first.fps:g}"
    theirs, ours = other.representation, first.representation
    if different := first_difference(other.skeleton, first.skeleton):
        yield f"another rig: {different}"
    if theirs.joints != ours.joints:
        yield f"its {len(theirs.joints)} joints are not the {len(ours.joints)} of this model"
    if theirs.makes_root != ours.makes_root:
        yield "only one of the two follows a path"
    if theirs.turn_first != ours.turn_first:
        yield "only one of the two has the motion vector of the released code"
    ratio = other.normaliser.scale / first.normaliser.scale
    worst = float(ratio[(ratio.log().abs()).argmax()])
    places = (theirs.references, ours.references), (theirs.side, ours.side)
    is_size = math.isclose(theirs.scale, ours.scale, rel_tol=_SCALE_TOLERANCE)
    is_pose = all(np.allclose(*pair, atol=1e-6) for pair in places)
    is_scale = abs(worst - 1) <= _SCALE_TOLERANCE
    same = {
        "lengths are relative to another body size": is_size,
        "rotations are relative to other mean rotations": is_pose,
        f"motion has another scale (by up to a factor of {worst:.3g})": is_scale,
    }
    for reason in (text for text, is_same in same.items() if not is_same):
        yield f"its {reason}; train one with moves_like: the other, to share motion vectors"
    schedule = "{0.steps} steps, beta {0.first_beta:g} to {0.last_beta:g}".format
    its, own = schedule(other.noise_config), schedule(first.noise_config)
    if its != own:
        yield f"its noise schedule has {its}, that of this model {own}"


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
            starts (SDEdit, Meng et al. 2022); None for pure noise.
        clips: those of in-betweening; None for none.
        place: x and z in metres and heading in radians of the first frame, without a path.
        wave: the sound; None for silence.
        path: the smoothed path of the root, T frames at `fps`; None for a model without one.
        events: in order of time.
        features: (T, S) speech features of each conditioner.
        placement: where and how the motion begins and ends.

    Raises:
        ModelError: an input that none of the models has, a missing path, or no length.
        AudioError, FormatError: a file that cannot be read.
    """

    clips: InbetweenClips | None = None
    start: tuple[Tensor, int] | None = None
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)
    wave: af.Wave | None = None

    def __init__(
        self,
        members: Sequence[Member],
        controls: DiffusionControls,
        speech: str | Path | af.Wave | None,
        seconds: float | None,
        seed: int,
        item: str,
    ) -> None:
        self.members, self.controls, self.seed, self.item = members, controls, seed, item
        self.model = model = members[0].model
        self.fps = fps = model.fps
        path, events, vad = controls["path"], controls["events"], controls["vad"]
        like, lift = None, 0.0
        if controls["like"] is not None:
            like, lift = _on_floor(model, controls["like"])
            if model.conditions.path and path is None:
                path = model.representation.path_of(like)
            if speech is None and seconds is None and path is None:
                seconds = like.duration
        if path is None and model.conditions.path:
            how = "a .csv with columns time,x,z[,heading], or a motion file"
            raise ModelError(f"path: this model follows a path and needs one: {how}")
        followed = None if path is None else as_root_path(path, model.representation.scale)
        if controls["keep"] is not None:
            self.clips = InbetweenClips(controls["keep"], model.representation, fps)
            if speech is None and seconds is None:
                seconds = self.clips.end / fps
        self.seconds = length = seconds
        if speech is None and length is None and followed is not None:
            length = followed.frames_within(fps) / fps
        models = [*(member.model for member in members), controls["unconditional"]]
        known = dict.fromkeys(m.conditions.conditioner for m in models if m is not None)
        conditioners = [conditioner for conditioner in known if conditioner is not None]
        sound = speech
        if speech is not None and (conditioners or wants_beats(events)):
            sound = self.wave = speech if isinstance(speech, af.Wave) else af.Wave.load(speech)
        if not conditioners and self.wave is not None and length is None:
            # No model has speech input, but the beats of the sound are the times of events.
            sound, length = None, self.wave.n_frames(fps) / fps
        first = next(iter(conditioners), None)
        values = speech_features(first, sound, length, fps, vad)
        self.n_frames = n_frames = len(values)
        self.features = {} if first is None else {first: values}
        for other in conditioners[1:]:
            values = other(self.wave, n_frames, vad) if self.wave else other.silence(n_frames)
            self.features[other] = values
        if self.clips is not None:
            self.clips.check_end(n_frames)
        if like is not None:
            self.start = _noised(model, like, lift, n_frames, controls["change"])
            own = model.representation.path_of(like)
            self.place = (*own.positions[0], own.headings[0])
        self.path = None if followed is None else smooth_path(followed, fps, n_frames)
        self.events = () if events is None else asked_events(events, self.wave)
        read_pose = partial(pose_on_rig, model.representation)
        self.placement = Placement.of(controls, read_pose, on_path=model.conditions.path)

    def condition(self, conditions: Conditions) -> np.ndarray:
        """Return a model's condition (T, C) float32, with its style and state left at zero."""
        speech = path = None
        if conditions.conditioner is not None:
            speech = self.features[conditions.conditioner]
        events = [event for event in self.events if event.name in conditions.events]
        if conditions.path and self.path is not None:
            path = self.path.scaled(1 / self.model.representation.scale)
        return conditions.encode(self.n_frames, self.fps, speech=speech, path=path, events=events)


def _on_floor(model: DiffusionModel, like: str | Path | Motion) -> tuple[Motion, float]:
    """Return a motion of any human rig, or of its file, on the model's rig at its frame rate.

    With it, the metres that it must be raised to stand on the model's floor: that of a foreign file
    is unknown, that of this rig is known.

    Raises:
        ModelError: the motion cannot be put on the rig.
        FormatError: a file that cannot be read.
    """
    given, rig = like if isinstance(like, Motion) else Motion.load(like), model.representation
    motion = on_rig(rig, given)
    if motion is given:
        return motion.resample(model.fps), 0.0
    height = float(model.normaliser.mean[rig.height_column]) * rig.scale
    place = np.array([[0.0, height, 0.0]])
    floor = floor_height(rig.assemble(rig.fixed_pose(1), place, model.fps, None))
    return motion.resample(model.fps), floor - floor_height(motion)


def _noised(
    model: DiffusionModel, motion: Motion, lift: float, n_frames: int, change: float
) -> tuple[Tensor, int]:
    """Return a normalised motion (T, X) and the step up to which it is noised.

    It is denoised from there, so that structure coarser than the noise is kept.

    Args:
        model: the model that continues from it.
        motion: on its rig.
        lift: metres to raise it.
        n_frames: T; the motion is cut, or extended with its last pose.
        change: above 0, at most 1: the noise level, from the first step of the schedule to the last
            one with any signal, evenly in log signal-to-noise ratio. It is also the fraction of a
            few-step solver's steps that remain.
    """
    rig = model.representation
    values = rig.encode(motion.resample(model.fps, n_frames))
    values[:, rig.height_column] += lift / rig.scale
    vectors = model.normaliser.forward(torch.from_numpy(values).float())
    level = model.schedule.log_snr()[: last_step_with_signal(model.schedule) + 1]
    wanted = level[0] + change * (level[-1] - level[0])
    # Another rig may bend joints that hardly move in the training data.
    clean = vectors.clamp(-MAX_DEVIATION, MAX_DEVIATION).to(model.device)
    return clean, int((level - wanted).abs().argmin())
