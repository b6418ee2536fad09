"""What a diffusion run trains on: motion and what is told about it, in memory."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gesturekit.diffusion.conditions import Conditions
from gesturekit.diffusion.config import DiffusionConfig
from gesturekit.diffusion.motion_vector import DeltaRepresentation
from gesturekit.diffusion.standardiser import Standardiser
from gesturekit.motion.motion import Motion
from gesturekit.motion.root_path import RootPath
from gesturekit.motion.skeleton import Skeleton
from gesturekit.training.data.data_folder import load_data, save_data
from gesturekit.training.data.sources import Source, from_values, to_values


@dataclass(frozen=True, eq=False)
class Recording:
    """One recording, or a variant of it.

    Attributes:
        name: of the item, and which variant it is.
        motion: (T, X) float32 in their own units.
        condition: (T, C) float32; zeros where nothing is told.
        is_paired: False for motion that goes without speech.
    """

    name: str
    motion: np.ndarray
    condition: np.ndarray
    is_paired: bool = True

    @property
    def n_frames(self) -> int:
        """T."""
        return len(self.motion)


@dataclass(frozen=True, eq=False)
class TrainingData:
    """Everything a run needs, on the CPU.

    Attributes:
        recordings: with their variants.
        seconds: of the recordings themselves, variants not counted; paired and unpaired.
        representation: of the rig.
        conditions: what the model is told.
        standardiser: of motion vectors.
        speakers: a reference skeleton for each named speaker.
        sources: the recordings with speech, or all for a model without speech input.
        recorded_fps: the commonest frame rate of the recordings; None where older runs lack it.
    """

    recordings: tuple[Recording, ...]
    seconds: tuple[float, float]
    representation: DeltaRepresentation
    conditions: Conditions
    standardiser: Standardiser
    speakers: dict[str, Skeleton]
    sources: tuple[Source, ...] = ()
    recorded_fps: float | None = None

    def decode(self, values: np.ndarray, condition: np.ndarray, fps: float) -> Motion:
        """A motion from (T, X) values in their own units and the (T, C) it was told."""
        path = None
        if not self.representation.makes_root:
            told = condition[:, self.conditions.columns["path"]].astype(np.float64)
            deltas = told * self.conditions.path_scale + self.conditions.path_mean
            path = RootPath.from_deltas(deltas, fps).scaled(self.representation.scale)
        return self.representation.decode(values, fps, path=path)

    def changes(self) -> Tensor:
        """(X,) root mean square of how standardised motion changes from frame to frame.

        What hardly ever changes counts as if it did a tenth as much as the median.
        """
        steps = [
            self.standardiser.forward(torch.from_numpy(recording.motion)).diff(dim=0)
            for recording in self.recordings
        ]
        spread = torch.cat(steps).square().mean(dim=0).sqrt()
        return spread.clamp(min=max(0.1 * float(spread.median()), 1e-6))

    def save(self, folder: Path) -> None:
        """Write all of it into a folder, for a run that is resumed."""
        tensors = {
            "motion.mean": self.standardiser.mean,
            "motion.scale": self.standardiser.scale,
            **self.conditions.to_tensors(),
        }
        for i, recording in enumerate(self.recordings):
            tensors[f"recording.{i}.motion"] = torch.from_numpy(recording.motion)
            tensors[f"recording.{i}.condition"] = torch.from_numpy(recording.condition)
        about = {
            "names": [recording.name for recording in self.recordings],
            "is_paired": [recording.is_paired for recording in self.recordings],
            "seconds": list(self.seconds),
            "sources": to_values(self.sources),
            "recorded_fps": self.recorded_fps,
            "conditions": self.conditions.to_values(),
            "skeleton": self.representation.skeleton.to_json(),
            "motion": self.representation.to_json(),
            "speakers": {name: rig.to_json() for name, rig in self.speakers.items()},
        }
        save_data(folder, tensors, about)

    @classmethod
    def load(cls, folder: Path, config: DiffusionConfig) -> TrainingData:
        """Read what `save` wrote.

        Raises:
            ConfigError: the folder's data is missing or damaged.
            WeightsError: the WavLM weights are not those that the run began with.
        """
        weights = None if config.features is None else config.features.weights

        def assemble(about: dict[str, Any], tensors: dict[str, Tensor]) -> TrainingData:
            paired, unpaired = about["seconds"]
            return cls(
                recordings=tuple(
                    Recording(
                        name,
                        tensors[f"recording.{i}.motion"].numpy(),
                        tensors[f"recording.{i}.condition"].numpy(),
                        is_paired,
                    )
                    for i, (name, is_paired) in enumerate(
                        zip(about["names"], about["is_paired"], strict=True)
                    )
                ),
                seconds=(paired, unpaired),
                representation=DeltaRepresentation.from_json(
                    Skeleton.from_json(about["skeleton"]), about["motion"]
                ),
                conditions=Conditions.from_values(
                    about["conditions"], tensors, config.fps, weights
                ),
                standardiser=Standardiser(tensors["motion.mean"], tensors["motion.scale"]),
                speakers={name: Skeleton.from_json(rig) for name, rig in about["speakers"].items()},
                sources=from_values(about.get("sources", ())),
                recorded_fps=about.get("recorded_fps"),
            )

        return load_data(folder, assemble)
