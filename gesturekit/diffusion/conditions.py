"""Conditions of a diffusion model, frame by frame: speech, a path, events, a style and a state.

A condition has the columns `[speech S | path 3 | events E | styles K | state C]`; parts with which
the model was not trained have no columns. A part that is not given is zero, as with condition
dropout.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from audio_features.weight_files import WeightPlaces
from gesturekit.corpus.speech import SpeechConditioner
from gesturekit.diffusion.events import event_flags
from gesturekit.errors import ModelError
from gesturekit.formats.tables import Event
from gesturekit.motion.root_path import RootPath
from gesturekit.state.channels import StateChannels
from gesturekit.training.data.features import (
    conditioner_tensors,
    conditioner_values,
    load_conditioner,
)

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
        return {
            name: slice(end - width, end)
            for name, width, end in zip(PARTS, widths, ends, strict=True)
        }

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
        events: Sequence[Event] | None = None,
        style: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the condition (T, C) float32 of a clip, with its state left at zero.

        Args:
            n_frames: T.
            fps: frames per second of the motion.
            speech: (T, S) features of the conditioner.
            path: T frames at `fps`, in metres of the reference body; see `smooth_path`.
            events: with known names; events after the last frame are ignored.
            style: (T, K) style weights, see `gesturekit.corpus.styles.style_track`.

        Raises:
            ModelError: a part that this model lacks, a part of the wrong shape, or an event of an
                unknown name.
        """
        condition = np.zeros((n_frames, self.width), np.float32)
        given = {
            "speech": speech,
            "path": None if path is None else self._normalised(path),
            "events": None if events is None else event_flags(events, self.events, n_frames, fps),
            "styles": style,
        }
        for name, values in given.items():
            columns = self.columns[name]
            if values is None:
                continue
            wanted = (n_frames, columns.stop - columns.start)
            if values.shape != wanted and values.size:
                why = "the model has no such part" if not wanted[1] else f"expected {wanted}"
                raise ModelError(f"condition: {name} of shape {values.shape}; {why}")
            if values.size:
                condition[:, columns] = values
        return condition

    def without(self, condition: Array, *parts: str) -> Array:
        """Return a copy of a condition (..., C) with the named parts set to zero.

        Without names, these are all parts but the state.
        """
        dropped = condition.clone() if isinstance(condition, Tensor) else condition.copy()
        for name in parts or PARTS[:-1]:
            dropped[..., self.columns[name]] = 0
        return dropped

    def _normalised(self, path: RootPath) -> np.ndarray:
        return (path.deltas() - self.path_mean) / self.path_scale

    def to_values(self) -> dict[str, Any]:
        """Return the layout as plain values for `config.yaml`; the state has its own there."""
        return {
            "features": None if self.conditioner is None else conditioner_values(self.conditioner),
            "path": self.path,
            "events": list(self.events),
            "styles": list(self.styles),
        }

    def to_tensors(self) -> dict[str, Tensor]:
        """Return means and scales for `model.safetensors`."""
        tensors = conditioner_tensors(self.conditioner)
        if self.path:
            tensors["path.mean"] = torch.from_numpy(self.path_mean)
            tensors["path.scale"] = torch.from_numpy(self.path_scale)
        return tensors

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
        """Rebuild conditions from `to_values` and `to_tensors`; see `DiffusionModel.load`.

        Raises KeyError, TypeError or ValueError for damaged values, and WeightsError for WavLM
        weights that are missing or are not those of training.
        """
        features, conditioner = values["features"], None
        if features is not None:
            conditioner = load_conditioner(features, tensors, fps, weights, device)
        path = {}
        if values["path"]:
            path = {
                "path_mean": tensors["path.mean"].numpy(),
                "path_scale": tensors["path.scale"].numpy(),
            }
        return cls(
            conditioner,
            bool(values["path"]),
            tuple(map(str, values["events"])),
            tuple(map(str, values["styles"])),
            state=state,
            **path,
        )


def smooth_path(path: RootPath, fps: float, n_frames: int | None = None) -> RootPath:
    """Resample a path to the model's frame rate and smooth it (section 4.1)."""
    return path.resample(fps, n_frames).smoothed()
