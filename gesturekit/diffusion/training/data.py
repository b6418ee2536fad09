"""Training data, in memory or on disk: motion vectors and conditions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gesturekit.diffusion.conditions import Conditions
from gesturekit.diffusion.config import DiffusionConfig
from gesturekit.diffusion.motion_vector import DeltaRepresentation, Normaliser
from gesturekit.diffusion.state import measured
from gesturekit.diffusion.training.augmentation import Rows
from gesturekit.motion.motion import Motion
from gesturekit.motion.root_path import RootPath
from gesturekit.motion.skeleton import Skeleton
from gesturekit.state.channels import StateChannels
from gesturekit.state.files import load_state, state_tensors, state_values
from gesturekit.state.process import StateProcess
from gesturekit.training.data.arrays import ArrayFolder, StoredArray, StoredFrames
from gesturekit.training.data.data_folder import load_data, save_data
from gesturekit.training.data.features import stored_speech
from gesturekit.training.data.sources import TrainedSegment, from_values, to_values
from gesturekit.training.data.start_model import read_start, start_tensors
from gesturekit.training.model_folder import read_speakers, rig_values


@dataclass(frozen=True, eq=False)
class StoredRows:
    """Frames (T, D) of a recording on disk, of which `[start:stop]` reads some.

    Attributes:
        n_frames: T.
        read: returns frames `start` to `stop`, (stop - start, D) float32.
    """

    n_frames: int
    read: Callable[[int, int], np.ndarray]

    def __len__(self) -> int:
        return self.n_frames

    def __getitem__(self, frames: slice) -> np.ndarray:
        start, stop, _ = frames.indices(self.n_frames)
        return self.read(start, stop)


@dataclass(frozen=True, eq=False)
class TrainingSequence:
    """One recording, or a variant of it, in memory or on disk.

    Attributes:
        name: of the item and variant.
        motion: (T, X) float32 motion vectors, not normalised.
        condition: (T, C) float32.
        is_paired: False for unpaired motion.
    """

    name: str
    motion: Rows
    condition: Rows
    is_paired: bool = True

    @property
    def n_frames(self) -> int:
        """T."""
        return len(self.motion)


Cut = tuple[int, int, int]
"""Index of a sequence, first frame and end."""


@dataclass(frozen=True, eq=False)
class StoredVariant:
    """A variant of a recording: part of an array that `VariantArrays` made.

    Attributes:
        which: index of the recording.
        phase: number of its phase, from 0.
        mirrored: whether it is a mirrored copy.
        array: of the recording.
        first: its first row in the array.
        n_frames: number of its rows.
    """

    which: int
    phase: int
    mirrored: bool
    array: StoredArray
    first: int
    n_frames: int

    def sequence(
        self, width: int, n_speech: int, speech: StoredFrames | None, *, is_paired: bool
    ) -> TrainingSequence:
        """Return the variant as training data; its frames are not read yet.

        Args:
            width: X, of a motion vector.
            n_speech: S, of speech features.
            speech: (S, T) of its phase; None for zeros.
            is_paired: False for unpaired motion.
        """
        n_frames = self.n_frames if speech is None else min(self.n_frames, speech.shape[1])

        def rows(start: int, stop: int) -> np.ndarray:
            return self.array.rows(self.first + start, self.first + stop)

        def motion(start: int, stop: int) -> np.ndarray:
            return np.ascontiguousarray(rows(start, stop)[:, :width])

        def condition(start: int, stop: int) -> np.ndarray:
            features = np.zeros((stop - start, n_speech), np.float32)
            if speech is not None:
                features = speech[:, start:stop].numpy().T
            if self.array.shape[1] == width:
                return np.ascontiguousarray(features)
            return np.concatenate([features, rows(start, stop)[:, width:]], axis=1)

        name = self.array.facts["id"] + (f" (phase {self.phase + 1})" if self.phase else "")
        return TrainingSequence(
            f"{name} (mirrored)" if self.mirrored else name,
            StoredRows(n_frames, motion),
            StoredRows(n_frames, condition),
            is_paired,
        )


def stored_variants(arrays: Sequence[StoredArray]) -> list[StoredVariant]:
    """Return the variants of recordings in the order of training data, mirrored copies last."""
    found = []
    for which, array in enumerate(arrays):
        first = 0
        for mirrored in (False, True)[: 1 + array.facts["mirrored"]]:
            for phase, n_frames in enumerate(array.facts["lengths"]):
                found.append(StoredVariant(which, phase, mirrored, array, first, n_frames))
                first += n_frames
    return sorted(found, key=lambda one: one.mirrored)


@dataclass(frozen=True)
class StoredCorpus:
    """Names of the arrays of a corpus in their folder.

    Attributes:
        motion: of the recordings, made by `VariantArrays`.
        speech: of their phases, made by `SpeechArrays`; empty without speech input.
        unpaired: of recordings without speech.
    """

    motion: Sequence[str]
    speech: Sequence[str]
    unpaired: Sequence[str]

    def sequences(
        self, config: DiffusionConfig, conditions: Conditions, width: int
    ) -> tuple[TrainingSequence, ...]:
        """Return all recordings and their variants; their frames are not read yet.

        Args:
            config: of the run.
            conditions: the layout of conditions.
            width: X, of a motion vector.

        Raises:
            ConfigError: an array is missing or not whole.
        """
        folder, paired = ArrayFolder(config.arrays_folder), len(self.motion)
        variants = stored_variants(folder.find_all((*self.motion, *self.unpaired)))
        speech: dict[tuple[int, int], StoredFrames] = {}
        if conditions.conditioner is not None:
            phases = [one for one in variants if one.which < paired and not one.mirrored]
            found = stored_speech(
                folder.find_all(self.speech),
                conditions.conditioner,
                [phase.n_frames for phase in phases],
            )
            numbers = [(phase.which, phase.phase) for phase in phases]
            speech = dict(zip(numbers, found, strict=True))
        n_speech = conditions.columns["speech"].stop
        return tuple(
            one.sequence(
                width, n_speech, speech.get((one.which, one.phase)), is_paired=one.which < paired
            )
            for one in variants
        )


def motion_of(
    recordings: Sequence[TrainingSequence], sampled: Sequence[Cut] | None
) -> list[np.ndarray]:
    """Return the motion vectors (T, X) from which statistics are computed.

    Args:
        recordings: and their variants.
        sampled: parts of them; None for all of them.
    """
    if sampled is None:
        return [recording.motion[:] for recording in recordings]
    return [recordings[i].motion[start:stop] for i, start, stop in sampled]


def with_state(
    recording: TrainingSequence, process: StateProcess, representation: DeltaRepresentation
) -> TrainingSequence:
    """Return a recording with its state as the last columns of its condition.

    The state of a recording on disk is measured when it is first used, and kept in memory.
    """
    condition = recording.condition

    @cache
    def state() -> np.ndarray:
        values = measured(recording.motion[:], representation, process.channels, process.fps)
        return process.given(values).T.astype(np.float32)

    if isinstance(condition, np.ndarray):
        return replace(recording, condition=np.concatenate([condition, state()], axis=1))

    def read(start: int, stop: int) -> np.ndarray:
        return np.concatenate([condition[start:stop], state()[start:stop]], axis=1)

    return replace(recording, condition=StoredRows(recording.n_frames, read))


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
        sampled: parts of `recordings` from which statistics are computed; None for all of them.
        stored: of recordings on disk, what `load` finds them by.
        state_process: of the state of movement; None without it.
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
    sampled: tuple[Cut, ...] | None = None
    stored: StoredCorpus | None = None
    state_process: StateProcess | None = None

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
        tensors = {
            "motion.mean": self.normaliser.mean,
            "motion.scale": self.normaliser.scale,
            **self.conditions.to_tensors(),
            **start_tensors(self.start),
            **({} if self.state_process is None else state_tensors(self.state_process)),
        }
        own = self.recordings if self.stored is None else ()
        for i, recording in enumerate(own):
            tensors[f"recording.{i}.motion"] = torch.from_numpy(recording.motion[:])
            tensors[f"recording.{i}.condition"] = torch.from_numpy(recording.condition[:])
        about = {
            "names": [recording.name for recording in own],
            "is_paired": [recording.is_paired for recording in own],
            "sampled": self.sampled,
            "stored": None if self.stored is None else asdict(self.stored),
            "seconds": list(self.seconds),
            "sources": to_values(self.sources),
            "recorded_fps": self.recorded_fps,
            "conditions": self.conditions.to_values(),
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
            paired, unpaired = about["seconds"]
            skeleton = Skeleton.from_json(about["skeleton"])
            representation = DeltaRepresentation.from_json(skeleton, about["motion"])
            conditions = Conditions.from_values(
                about["conditions"], tensors, config.fps, weights, device
            )
            channels = StateChannels.find(skeleton, representation.joints)
            n_speech = conditions.columns["speech"].stop
            process = load_state(about["state"], tensors, channels, config.fps, n_speech)
            stored, sampled = None, None
            if about["stored"] is None:
                labels = zip(about["names"], about["is_paired"], strict=True)
                recordings = tuple(
                    TrainingSequence(
                        name,
                        tensors[f"recording.{i}.motion"].numpy(),
                        tensors[f"recording.{i}.condition"].numpy(),
                        is_paired,
                    )
                    for i, (name, is_paired) in enumerate(labels)
                )
            else:
                stored = StoredCorpus(**about["stored"])
                sampled = tuple((i, start, stop) for i, start, stop in about["sampled"])
                recordings = stored.sequences(config, conditions, representation.n_features)
                if process is not None:
                    recordings = tuple(
                        with_state(own, process, representation) for own in recordings
                    )
            if process is not None:
                conditions = replace(conditions, state=channels)
            return cls(
                recordings=recordings,
                seconds=(paired, unpaired),
                representation=representation,
                conditions=conditions,
                normaliser=Normaliser(tensors["motion.mean"], tensors["motion.scale"]),
                speakers=read_speakers(about),
                sources=from_values(about["sources"]),
                recorded_fps=about["recorded_fps"],
                start=read_start(tensors),
                sampled=sampled,
                stored=stored,
                state_process=process,
            )

        return load_data(folder, assemble)
