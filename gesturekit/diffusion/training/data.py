"""Training data, in memory or on disk: motion vectors and conditions."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gesturekit.diffusion.conditions import Conditions
from gesturekit.diffusion.config import DiffusionConfig
from gesturekit.diffusion.model import read_fitted
from gesturekit.diffusion.motion_vector import DeltaRepresentation, Normaliser, measured_state
from gesturekit.motion.motion import Motion
from gesturekit.motion.root_path import RootPath
from gesturekit.motion.skeleton import Skeleton
from gesturekit.state.process import StateProcess, state_values
from gesturekit.training.arrays import Array, ArrayFolder, Frames
from gesturekit.training.features import speech_frames
from gesturekit.training.model_folder import (
    fitted_tensors,
    load_data,
    read_speakers,
    rig_values,
    save_data,
)
from gesturekit.training.origin import TrainedSegment, from_values, read_start, start_tensors


@dataclass(frozen=True, eq=False)
class StoredRows:
    """Frames (T, D) of a recording, of which `[start:stop]` reads some.

    Attributes:
        array: of the recording and its variants.
        first: its first row that belongs to them.
        n_frames: T.
        columns: of the array.
        n_speech: number of speech features before these columns.
        speech: (n_speech, T) the features; None for zeros.
        state: returns the state of movement (T, C) that follows; None for none.
    """

    array: Array
    first: int
    n_frames: int
    columns: slice
    n_speech: int = 0
    speech: Frames | None = None
    state: Callable[[], np.ndarray] | None = None

    def __len__(self) -> int:
        return self.n_frames

    def __getitem__(self, frames: slice) -> np.ndarray:
        start, stop, _ = frames.indices(self.n_frames)
        values = []
        if self.speech is not None:
            values.append(self.speech[:, start:stop].numpy().T)
        elif self.n_speech:
            values.append(np.zeros((stop - start, self.n_speech), np.float32))
        if not values or self.columns.start < self.array.shape[1]:
            values.append(self.array.rows(self.first + start, self.first + stop)[:, self.columns])
        if self.state is not None:
            values.append(self.state()[start:stop])
        return np.ascontiguousarray(np.concatenate(values, axis=1))


Rows = np.ndarray | StoredRows


@dataclass(frozen=True, eq=False)
class TrainingSequence:
    """One recording, or a variant of it, in memory or on disk.

    Attributes:
        name: of the item and variant.
        motion: (T, X) float32 motion vectors, not normalised.
        condition: (T, C) float32.
        is_paired: False for unpaired motion.
        recording: index of the recording.
        phase: number of its phase, from 0.
        mirrored: whether it is a mirrored copy.
    """

    name: str
    motion: Rows
    condition: Rows
    is_paired: bool = True
    recording: int = 0
    phase: int = 0
    mirrored: bool = False

    @property
    def n_frames(self) -> int:
        """T."""
        return len(self.motion)

    def in_memory(self) -> TrainingSequence:
        """Return the sequence with all its frames in memory."""
        return replace(self, motion=self.motion[:], condition=self.condition[:])


Cut = tuple[int, int, int]
"""Index of a sequence, first frame and end."""


def sequences_of(
    motion: Sequence[Array],
    speech: Sequence[Array],
    unpaired: Sequence[Array],
    conditions: Conditions,
    width: int,
) -> tuple[TrainingSequence, ...]:
    """Return recordings and their variants, mirrored copies last; no frames are read yet.

    Args:
        motion: arrays of paired recordings, see `VariantArrays`.
        speech: of each phase of these, see `SpeechArrays`; unused without speech input.
        unpaired: those of unpaired motion.
        conditions: the layout of conditions.
        width: X, of a motion vector.
    """
    phases = [(i, k) for i, array in enumerate(motion) for k in range(len(array.facts["lengths"]))]
    speech_of: dict[tuple[int, int], Frames] = {}
    if conditions.conditioner is not None:
        lengths = [n_frames for array in motion for n_frames in array.facts["lengths"]]
        frames = speech_frames(speech, conditions.conditioner, lengths)
        speech_of = dict(zip(phases, frames, strict=True))
    n_speech, sequences = conditions.columns["speech"].stop, []
    for i, array in enumerate([*motion, *unpaired]):
        first = 0
        for mirrored in (False, True)[: 1 + array.facts["mirrored"]]:
            for phase, length in enumerate(array.facts["lengths"]):
                features = speech_of.get((i, phase))
                n_frames = length if features is None else min(length, features.shape[1])
                rows = partial(StoredRows, array, first, n_frames)
                name = array.facts["id"]
                name += f" (phase {phase + 1})" if phase else ""
                name += " (mirrored)" if mirrored else ""
                vectors = rows(slice(0, width))
                condition = rows(slice(width, None), n_speech, features)
                about = i < len(motion), i, phase, mirrored
                sequences.append(TrainingSequence(name, vectors, condition, *about))
                first += length
    return tuple(sorted(sequences, key=lambda sequence: sequence.mirrored))


def motion_of(recordings: Sequence[TrainingSequence], sampled: Iterable[Cut]) -> list[np.ndarray]:
    """Return the motion vectors (T, X) from which statistics are computed."""
    return [recordings[i].motion[start:stop] for i, start, stop in sampled]


def with_state(
    recording: TrainingSequence, process: StateProcess, representation: DeltaRepresentation
) -> TrainingSequence:
    """Return a recording with its state as the last columns of its condition.

    The state of a recording on disk is measured when it is first used, and kept in memory.
    """

    @cache
    def state() -> np.ndarray:
        motion = recording.motion[:]
        values = measured_state(motion, representation, process.channels, process.fps)
        return process.given(values).T.astype(np.float32)

    condition = recording.condition
    if isinstance(condition, StoredRows):
        return replace(recording, condition=replace(condition, state=state))
    return replace(recording, condition=np.concatenate([condition, state()], axis=1))


@dataclass(frozen=True, eq=False)
class TrainingData:
    """All training data of a run, on the CPU.

    Attributes:
        recordings: and their variants.
        seconds: total length of paired recordings, without variants.
        unpaired_seconds: that of unpaired ones.
        representation: the motion vector of the rig.
        conditions: the layout of conditions.
        normaliser: mean and scale of motion vectors.
        speakers: a reference skeleton for each named speaker.
        sources: the recordings with speech, or all for a model without speech input.
        recorded_fps: the most common frame rate of the recordings.
        sampled: parts of `recordings` from which statistics are computed.
        start: weights of the network to start from, by name; empty for random ones.
        stored: of recordings on disk, the names of their arrays of "motion", of the "speech" of
            their phases, and of "unpaired" motion; None in memory.
        state_process: of the state of movement; None without it.
    """

    recordings: tuple[TrainingSequence, ...]
    seconds: float
    unpaired_seconds: float
    representation: DeltaRepresentation
    conditions: Conditions
    normaliser: Normaliser
    speakers: dict[str, Skeleton]
    recorded_fps: float
    sources: tuple[TrainedSegment, ...]
    sampled: tuple[Cut, ...]
    start: Mapping[str, Tensor] = field(default_factory=dict)
    stored: Mapping[str, Sequence[str]] | None = None
    state_process: StateProcess | None = None

    @property
    def is_stored(self) -> bool:
        """Return True if the recordings are arrays on disk."""
        return self.stored is not None

    @property
    def paired(self) -> list[TrainingSequence]:
        """Recordings with their conditions, without unpaired motion."""
        return [recording for recording in self.recordings if recording.is_paired]

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
            self.normaliser.forward(torch.from_numpy(motion)).diff(dim=0)
            for motion in motion_of(self.recordings, self.sampled)
        ]
        spread = torch.cat(steps).square().mean(dim=0).sqrt()
        return spread.clamp(min=max(0.1 * float(spread.median()), 1e-6))

    def save(self, folder: Path) -> None:
        """Write the data to a folder, for resuming the run."""
        conditions = self.conditions
        tensors = fitted_tensors(self.normaliser, conditions.conditioner, self.state_process)
        tensors |= conditions.path_tensors() | start_tensors(self.start)
        in_memory = self.recordings if self.stored is None else ()
        for i, recording in enumerate(in_memory):
            tensors[f"recording.{i}.motion"] = torch.from_numpy(recording.motion[:])
            tensors[f"recording.{i}.condition"] = torch.from_numpy(recording.condition[:])
        about = {
            "names": [recording.name for recording in in_memory],
            "is_paired": [recording.is_paired for recording in in_memory],
            "sampled": self.sampled,
            "stored": self.stored,
            "seconds": [self.seconds, self.unpaired_seconds],
            "sources": [*map(asdict, self.sources)],
            "recorded_fps": self.recorded_fps,
            "conditions": conditions.to_values(),
            "state": None if self.state_process is None else state_values(self.state_process),
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
            values = {**about, **about["conditions"], "fps": config.fps}
            fitted = read_fitted(values, tensors, weights, device)
            representation, process = fitted["representation"], fitted["state_process"]
            if (stored := about["stored"]) is None:
                recordings = tuple(
                    TrainingSequence(
                        name,
                        tensors[f"recording.{i}.motion"].numpy(),
                        tensors[f"recording.{i}.condition"].numpy(),
                        about["is_paired"][i],
                    )
                    for i, name in enumerate(about["names"])
                )
            else:
                folder, width = ArrayFolder(config.arrays_folder), representation.n_features
                arrays = {kind: folder.find_all(keys) for kind, keys in stored.items()}
                recordings = sequences_of(**arrays, conditions=fitted["conditions"], width=width)
                if process is not None:
                    recordings = tuple(with_state(r, process, representation) for r in recordings)
            paired, unpaired = about["seconds"]
            return cls(
                **fitted,
                recordings=recordings,
                seconds=paired,
                unpaired_seconds=unpaired,
                speakers=read_speakers(about),
                sources=from_values(about["sources"]),
                recorded_fps=about["recorded_fps"],
                start=read_start(tensors),
                sampled=tuple((i, start, stop) for i, start, stop in about["sampled"]),
                stored=stored,
            )

        return load_data(folder, assemble)
