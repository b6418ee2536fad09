"""Fields of a trained model that every system has, and their values in files."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from gesturekit.motion.resampling import checked_fps
from gesturekit.motion.skeleton import Skeleton
from gesturekit.training.model_folder import ModelParts, rates, reduction


@dataclass(eq=False, repr=False, kw_only=True)
class BaseModel:
    """Fields of every trained model; each system adds its networks and its generation.

    Attributes:
        fps: frames per second at which the network (its finest level) works.
        representation: the motion vector of the rig.
        conditions: inputs of the model beside noise or the noisy motion.
        speakers: a reference skeleton for each speaker that the corpus named.
        smooth: default of the control `smooth`, in seconds; None for no smoothing.
        recorded_fps: the recordings' rate, which generated motion gets; by default `fps`.
        folder: folder that it was loaded from; None for one that was not loaded.
    """

    kind: ClassVar[str]

    fps: float
    representation: Any
    conditions: Any
    speakers: Mapping[str, Skeleton] = field(default_factory=dict)
    smooth: float | None = None
    recorded_fps: float = None  # type: ignore[assignment]
    folder: Path | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        if self.recorded_fps is None:
            self.recorded_fps = self.fps

    def __repr__(self) -> str:
        folder = "" if self.folder is None else f"{str(self.folder)!r}: "
        return f"{type(self).__name__}({folder}{self.motion_row()})"

    @property
    def skeleton(self) -> Skeleton:
        """The rig, with all the joints of the training files."""
        return self.representation.skeleton

    @property
    def styles(self) -> tuple[str, ...]:
        """Names of its styles; empty for a model without styles."""
        return self.conditions.styles

    def first_values(self) -> dict[str, Any]:
        """Return the first lines of config.yaml."""
        return {
            "kind": self.kind,
            "fps": self.fps,
            "recorded_fps": self.recorded_fps,
            "joints": list(self.representation.joints),
        }

    def motion_row(self) -> str:
        """Return the rates and joints of the motion, for the README of the model folder."""
        joints = f"{len(self.representation.joints)} of {self.skeleton.n_joints} joints modelled"
        return f"{rates(self.fps, self.recorded_fps)}, {joints}"

    def speech_rows(self) -> dict[str, str]:
        """Return the speech features, for the README; empty without speech input."""
        conditioner = self.conditions.conditioner
        if conditioner is None:
            return {}
        rows = {"Speech features": json.dumps(conditioner.extractor.spec)}
        if conditioner.components is not None:
            rows["Reduced features"] = reduction(conditioner.components.shape)
        return rows


def common_arguments(parts: ModelParts) -> dict[str, Any]:
    """Return the fields of `BaseModel` from a model folder, without those of each system."""
    smooth, recorded_fps = parts.config.get("smooth"), parts.config.get("recorded_fps")
    return {
        "fps": float(parts.config["fps"]),
        "speakers": read_speakers(parts.rig),
        "smooth": None if smooth is None else float(smooth),
        "recorded_fps": None if recorded_fps is None else checked_fps(recorded_fps),
    }


def rig_values(representation: Any, speakers: Mapping[str, Skeleton]) -> dict[str, Any]:
    """Return the content of skeleton.json, which run folders store too."""
    return {
        "skeleton": representation.skeleton.to_json(),
        "motion": representation.to_json(),
        "speakers": {name: body.to_json() for name, body in speakers.items()},
    }


def read_speakers(rig: Mapping[str, Any]) -> dict[str, Skeleton]:
    """Return the reference skeletons in `rig_values`."""
    return {name: Skeleton.from_json(body) for name, body in rig["speakers"].items()}
