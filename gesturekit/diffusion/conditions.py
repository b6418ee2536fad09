"""Conditions of a diffusion model, frame by frame: speech, a path, events, a style and a state.

Here too is the text of a request that says what holds when: events, styles, and weights of experts.

A condition has the columns `[speech S | path 3 | events E | styles K | state C]`; parts with which
the model was not trained have no columns. A part that is not given is zero, as with condition
dropout.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

import audio_features as af
from audio_features.weight_files import WeightPlaces
from gesturekit.corpus.speech import SpeechConditioner, style_number, style_track
from gesturekit.errors import ModelError
from gesturekit.evaluation.metrics.rhythm import music_beats
from gesturekit.formats.tables import Event, load_events
from gesturekit.motion.root_path import RootPath
from gesturekit.state.channels import StateChannels
from gesturekit.training.features import conditioner_values, load_conditioner
from gesturekit.wording import did_you_mean

PARTS = ("speech", "path", "events", "styles", "state")

Array = TypeVar("Array", np.ndarray, Tensor)


@dataclass(frozen=True, eq=False)
class Conditions:
    """The layout of a model's condition, and its encoding.

    Attributes:
        conditioner: turns waves (speech or music) into features; None for no sound input.
        path: whether the root follows a given path.
        events: names of the binary event flags.
        styles: names of the styles.
        path_mean: (3,) mean of turn, forward and lateral per frame over the training data, in
            radians and metres of the reference body (`ModelJoints.scale`).
        path_scale: (3,) their standard deviation.
        state: channels of the state of movement; None for a model without it.
    """

    conditioner: SpeechConditioner | None = None
    path: bool = False
    events: tuple[str, ...] = ()
    styles: tuple[str, ...] = ()
    path_mean: np.ndarray = field(default_factory=lambda: np.zeros(3))
    path_scale: np.ndarray = field(default_factory=lambda: np.ones(3))
    state: StateChannels | None = None

    @property
    def columns(self) -> dict[str, slice]:
        """Columns of each part of `PARTS`; an empty slice for a part that the model lacks."""
        widths = (
            0 if self.conditioner is None else self.conditioner.dim,
            3 if self.path else 0,
            len(self.events),
            len(self.styles),
            0 if self.state is None else len(self.state.names),
        )
        ends = np.cumsum(widths).tolist()
        return dict(zip(PARTS, map(slice, [0, *ends], ends)))

    @property
    def width(self) -> int:
        """C, the number of columns."""
        return self.columns["state"].stop

    def encode(
        self,
        n_frames: int,
        fps: float,
        *,
        speech: np.ndarray | None = None,
        path: RootPath | None = None,
        events: Iterable[Event] = (),
        style: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the condition (T, C) float32 of a clip, with its state left at zero.

        Args:
            n_frames: T.
            fps: frames per second of the motion.
            speech: (T, S) features of the conditioner.
            path: T frames at `fps`, in metres of the reference body; see `smooth_path`.
            events: flags are 1 from the frame nearest to an event's start, for at least one frame;
                events after the last frame are ignored.
            style: (T, K) style weights, see `gesturekit.corpus.speech.style_track`.

        Raises:
            ModelError: an event of an unknown name.
        """
        condition = np.zeros((n_frames, self.width), np.float32)
        steps = None if path is None else (path.deltas() - self.path_mean) / self.path_scale
        for name, values in (("speech", speech), ("path", steps), ("styles", style)):
            if values is not None:
                condition[:, self.columns[name]] = values
        flags = condition[:, self.columns["events"]]
        for event in events:
            check_event(event, self.events)
            start = math.floor(event.time * fps + 0.5)
            stop = math.floor((event.time + event.duration) * fps + 0.5)
            flags[start : max(stop, start + 1), self.events.index(event.name)] = 1
        return condition

    def without(self, condition: Array, *parts: str) -> Array:
        """Return a copy of a condition (..., C) with the named parts set to zero.

        Without names, these are all parts but the state.
        """
        dropped = condition.clone() if isinstance(condition, Tensor) else condition.copy()
        for name in parts or PARTS[:-1]:
            dropped[..., self.columns[name]] = 0
        return dropped

    def to_values(self) -> dict[str, Any]:
        """Return the layout as plain values for `config.yaml`; the state has its own there."""
        return {
            "features": None if self.conditioner is None else conditioner_values(self.conditioner),
            "path": self.path,
            "events": list(self.events),
            "styles": list(self.styles),
        }

    def path_tensors(self) -> dict[str, Tensor]:
        """Return mean and scale of paths for `model.safetensors`; empty without a path."""
        arrays = {"path.mean": self.path_mean, "path.scale": self.path_scale}
        return {name: torch.from_numpy(array) for name, array in arrays.items() if self.path}

    @classmethod
    def from_values(
        cls,
        values: Mapping[str, Any],
        tensors: Mapping[str, Tensor],
        fps: float,
        weights: WeightPlaces | None = None,
        device: str = "cpu",
        state: StateChannels | None = None,
    ) -> Conditions:
        """Rebuild conditions from `to_values` and a model's tensors; see `DiffusionModel.load`.

        Raises KeyError, TypeError or ValueError for damaged values, and WeightsError for WavLM
        weights that are missing or are not those of training.
        """
        features, conditioner, fitted = values["features"], None, {}
        if features is not None:
            conditioner = load_conditioner(features, tensors, fps, weights, device)
        if has_path := bool(values["path"]):
            fitted = {f"path_{part}": tensors[f"path.{part}"].numpy() for part in ("mean", "scale")}
        events, styles = (tuple(map(str, values[name])) for name in ("events", "styles"))
        return cls(conditioner, has_path, events, styles, **fitted, state=state)


def smooth_path(path: RootPath, fps: float, n_frames: int | None = None) -> RootPath:
    """Resample a path to the model's frame rate and smooth it (section 4.1)."""
    return path.resample(fps, n_frames).smoothed()


def check_event(event: Event, known: Sequence[str]) -> None:
    """Raise ModelError for an event of an unknown name."""
    if event.name not in known:
        hint = did_you_mean(event.name, known, "did you mean {}? ")
        raise ModelError(f"event {event.name!r}: {hint}the model has {', '.join(known) or 'none'}")


_SECONDS = r"\d+(\.\d*)?|\.\d+"
_TERM = re.compile(rf"(?P<name>.+)@(?P<time>beats|{_SECONDS})(:(?P<duration>{_SECONDS}))?")
BEATS = re.compile(r"(?<=.@)beats(?=\s*(:|,|$))")
"""Places of an event's text where it depends on the beats of a sound."""


def wants_beats(events: str | Path | None) -> bool:
    """Return whether the events depend on the beats of a sound."""
    return isinstance(events, str) and BEATS.search(events) is not None


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
    asked: list[Event] = []
    for text in map(str.strip, events.split(",")):
        match, problem = _TERM.fullmatch(text), ""
        if match is None:
            problem = (
                "events look like kick@1.0,punch@2.5:0.5 (seconds, and how long), like kick@beats, "
                "or are a .csv with columns time,name[,duration]"
            )
        elif match["time"] != "beats":
            times = [float(match["time"])]
        elif wave is None:
            problem = "there is no sound to find beats in"
        elif not (times := music_beats(wave).tolist()):
            problem = f"no beat was found in {wave.source or 'the sound'}; give seconds instead"
        if match is None or problem:
            raise ModelError(f"event {text!r}: {problem}")
        duration = float(match["duration"] or 0)
        asked += [Event(time, match["name"].strip(), duration) for time in times]
    return tuple(sorted(asked))


SUM_TOLERANCE = 1e-5
"""Largest rounding error of the sum of the weights."""

ExpertWeight = float | np.ndarray | str | None
"""The forms of an expert's weight; see `weights_over_time`."""

_WEIGHT = r"(?P<weight>[-+]?(\d+(\.\d*)?|\.\d+))"
_SPAN = r"(?P<span>(?P<start>\d+(\.\d+)?)-(?P<end>\d+(\.\d+)?))"
_STYLE_TERM = re.compile(rf"(?P<name>.+?)(:{_WEIGHT})?(@{_SPAN})?")
_WEIGHT_SPAN = re.compile(rf"{_WEIGHT}@{_SPAN}")
_BACKWARDS = "the span ends before it begins"


def style_weights(names: Sequence[str], wanted: str, n_frames: int, fps: float) -> np.ndarray:
    """Return the weights (T, K) float64 of the styles over time, which add up to 1.

    Args:
        names: the model's K styles.
        wanted: one style (`old`); several with weights (`old:0.25,angry:0.75`), which may be below
            0 or above 1 (`old:-0.25,angry:1.25`); spans in seconds (`old@0-10,angry@10-20`), which
            are cross-faded as in `style_track`; or weights in spans
            (`old:0.5@0-10,angry:0.5@0-10,angry@10-20`).
        n_frames: T.
        fps: frames per second.

    Raises:
        ModelError: an unknown style, a text that cannot be read, or weights that do not add up to 1
            in some span.
    """
    spans: dict[str, dict[int, float | None]] = {}
    problems = []
    for text in map(str.strip, [wanted] if wanted in names else wanted.split(",")):
        name, weight, span, match = text, None, "", _STYLE_TERM.fullmatch(text)
        if match is not None and text not in names:
            name, weight, span = match["name"], match["weight"], match["span"] or ""
            if span and float(match["end"]) <= float(match["start"]):
                problems.append(f"{text}: {_BACKWARDS}")
            if weight is not None and f"{name}:{weight}" in names:  # a name with a colon
                name, weight = f"{name}:{weight}", None
        number, named = style_number(names, name), spans.setdefault(span, {})
        if number in named:
            problems.append(f"{name} is named twice for the same time")
        named[number] = None if weight is None else float(weight)
    if "" in spans and len(spans) > 1:
        problems.append("give all styles a span of seconds, or none: old@0-10,angry@10-20")
    mixtures = np.zeros((len(spans), len(names)))
    for row, weights in zip(mixtures, spans.values(), strict=True):
        given = [weight for weight in weights.values() if weight is not None]
        if given and len(given) < len(weights):
            problems.append("some styles have a weight and some have none")
        elif given and abs(sum(given) - 1) > SUM_TOLERANCE:
            problems.append(f"weights add up to {sum(given):g}; they must give 1")
        row[list(weights)] = given if len(given) == len(weights) else 1 / len(weights)
    if problems:
        raise ModelError(f"style {wanted!r}: {problems[0]}")
    if "" in spans:
        return np.repeat(mixtures, n_frames, axis=0)
    return _cross_faded(list(spans), mixtures, n_frames, fps)


def _cross_faded(spans: Sequence[str], values: np.ndarray, n_frames: int, fps: float) -> np.ndarray:
    """Return values (S, ...) of spans of seconds over time, (T, ...) float64; see `style_track`."""
    labels = [str(k) for k in range(len(spans))]
    asked = ",".join(f"{k}@{span}" for k, span in enumerate(spans))
    return style_track(labels, asked, n_frames, fps).astype(np.float64) @ values


def weight_track(text: str, n_frames: int, fps: float) -> np.ndarray:
    """Return weights (T,) float64 given as spans in seconds: `0.2@0-10,0.8@10-20`.

    Neighbouring spans are cross-faded like styles (`style_track`), and overlapping spans averaged.
    Outside of all spans the weight is 0.

    Raises:
        ModelError: a text that cannot be read, or a span that ends before it begins.
    """
    spans, weights, reached = [], [], 0.0
    for asked in map(str.strip, text.split(",")):
        if (match := _WEIGHT_SPAN.fullmatch(asked)) is None:
            raise ModelError(f"weight {asked!r}: weights over time look like 0.2@0-10,0.8@10-20")
        if float(match["end"]) <= float(match["start"]):
            raise ModelError(f"weight {asked!r}: {_BACKWARDS}")
        spans.append((match["start"], match["end"]))
        weights.append(float(match["weight"]))
    after = n_frames / fps
    for start, end in sorted([*spans], key=lambda span: float(span[0])):
        if float(start) > reached:
            spans.append((f"{reached:f}", start))
        reached = max(reached, float(end))
    if after > reached:
        spans.append((f"{reached:f}", f"{reached + after:f}"))
    weights += [0.0] * (len(spans) - len(weights))
    return _cross_faded([*map("-".join, spans)], np.array(weights), n_frames, fps)


def weights_over_time(given: Sequence[ExpertWeight], n_frames: int, fps: float) -> list[np.ndarray]:
    """Return the weight of each expert: (1,) if it is constant, else (T,).

    Args:
        given: numbers, arrays (T,), texts (see `weight_track`), or None for an equal share of the
            remaining weight.
        n_frames: T.
        fps: frames per second.

    Raises:
        ModelError: a text that cannot be read, or weights that do not fit the frames.
    """
    weights: list[np.ndarray | None] = []
    for weight in given:
        if isinstance(weight, str):
            weight = weight_track(weight, n_frames, fps)
        values = None if weight is None else np.atleast_1d(np.asarray(weight, dtype=np.float64))
        if values is not None and values.shape not in ((1,), (n_frames,)):
            right = f"a number or ({n_frames},), one for each frame"
            raise ModelError(f"weights of an expert have shape {values.shape}; expected {right}")
        weights.append(values)
    rest = np.ones(1) - sum(weight for weight in weights if weight is not None)
    shares = sum(weight is None for weight in weights)
    return [rest / shares if weight is None else weight for weight in weights]
