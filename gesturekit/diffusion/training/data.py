"""Training data in memory: motion vectors and conditions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gesturekit.diffusion.conditions import Conditions
from gesturekit.diffusion.config import DiffusionConfig
from gesturekit.diffusion.motion_vector import DeltaRepresentation, Normaliser
from gesturekit.motion.motion import Motion
from gesturekit.motion.root_path import RootPath
from gesturekit.motion.skeleton import Skeleton
from gesturekit.training.data.data_folder import load_data, save_data
from gesturekit.training.data.sources import TrainedSegment, from_values, to_values
from gesturekit.training.data.start_model import read_start, start_tensors
from gesturekit.training.model_folder import read_speakers, rig_values


@dataclass(frozen=True, eq=False)
class TrainingSequence:
    """One recording, or a variant of it.

    Attributes:
        name: of the item and variant.
        motion: (T, X) float32 motion vectors, not normalised.
        condition: (T, C) float32.
        is_paired: False for unpaired motion.
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
    """All training data of a run, on the CPU.

    Attributes:
        recordings: and their variants.
        seconds: total length of paired and unpaired recordings, without variants.
        representation: the motion vector of the rig.
        conditions: the layout of conditions.
        normaliser: mean and scale of motion vectors.
        speakers: a reference skeleton for each named speaker.
        sources: the recordings with speech, or all for a model without speech input.
        recorded_fps: the most common frame rate of the recordings.
        start: weights of the network to start from, by name; empty for random ones.
    """

    recordings: tuple[TrainingSequence, ...]
    seconds: tuple[float, float]
    representation: DeltaRepresentation
    conditions: Conditions
    normaliser: Normaliser
    speakers: dict[str, Skeleton]
    recorded_fps: float
    sources: tuple[TrainedSegment, ...]
    start: Mapping[str, Tensor] = field(default_factory=dict)

    def decode(self, values: np.ndarray, condition: np.ndarray, fps: float) -> Motion:
        """Decode a motion from unnormalised motion vectors (T, X) and its condition (T, C)."""
        path = None
        if not self.representation.makes_root:
            scaled = condition[:, self.conditions.columns["path"]].astype(np.float64)
            deltas = scaled * self.conditions.path_scale + self.conditions.path_mean
            path = RootPath.from_deltas(deltas, fps).scaled(self.representation.scale)
        return self.representation.decode(values, fps, path=path)

    def changes(self) -> Tensor:
        """Return the root mean square (X,) of frame-to-frame changes of normalised motion.

        Values are at least a tenth of the median.
        """
        steps = [
            self.normaliser.forward(torch.from_numpy(recording.motion)).diff(dim=0)
            for recording in self.recordings
        ]
        spread = torch.cat(steps).square().mean(dim=0).sqrt()
        return spread.clamp(min=max(0.1 * float(spread.median()), 1e-6))

    def save(self, folder: Path) -> None:
        """Write the data to a folder, for resuming the run."""
        tensors = {
            "motion.mean": self.normaliser.mean,
            "motion.scale": self.normaliser.scale,
            **self.conditions.to_tensors(),
            **start_tensors(self.start),
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
            **rig_values(self.representation, self.speakers),
        }
        save_data(folder, tensors, about)

    @classmethod
    def load(cls, folder: Path, config: DiffusionConfig, device: str = "cpu") -> TrainingData:
        """Read what `save` wrote; encoders compute on the device.

        Raises:
            ConfigError: the folder's data is missing or damaged.
            WeightsError: the WavLM weights are not those of the start of the run.
        """
        weights = None if config.features is None else config.features.encoder_places

        def assemble(about: dict[str, Any], tensors: dict[str, Tensor]) -> TrainingData:
            paired, unpaired = about["seconds"]
            return cls(
                recordings=tuple(
                    TrainingSequence(
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
                    about["conditions"], tensors, config.fps, weights, device
                ),
                normaliser=Normaliser(tensors["motion.mean"], tensors["motion.scale"]),
                speakers=read_speakers(about),
                sources=from_values(about["sources"]),
                recorded_fps=about["recorded_fps"],
                start=read_start(tensors),
            )

        return load_data(folder, assemble)
