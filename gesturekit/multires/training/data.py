"""Training data of a multires run: normalised recordings and speech features, in memory or on disk.

Reconstruction steps and discriminators use paired sequences (speech and motion). Random-generation
steps use unpaired speech only. Without speech input, speech has no channels (0, T), and every
motion is a sequence.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gesturekit.corpus.speech import SpeechConditioner
from gesturekit.motion.skeleton import Skeleton
from gesturekit.multires.config import MultiresConfig
from gesturekit.multires.motion_vector import MultiresRepresentation, Normaliser
from gesturekit.multires.network.resampling import reflect
from gesturekit.multires.retrieval.passive import PassiveChannels
from gesturekit.multires.sampling.conditions import Conditions, state_level
from gesturekit.multires.sampling.trained_model import clocked_noise
from gesturekit.multires.training.sequences import Cut, PairedSequence
from gesturekit.multires.training.stored import StoredCorpus
from gesturekit.state.channels import StateChannels
from gesturekit.training.data.arrays import Frames
from gesturekit.training.data.features import (
    conditioner_tensors,
    conditioner_values,
    load_conditioner,
)
from gesturekit.training.data.sources import TrainedSegment, from_values, to_values
from gesturekit.training.data.start_model import read_start, start_tensors
from gesturekit.training.model_folder import load_data, read_speakers, rig_values, save_data


@dataclass(frozen=True)
class TrainingData:
    """Training data of a run, on the CPU.

    Attributes:
        paired: recordings with motion.
        unpaired: (S, T) speech without motion; that of `paired` if the corpus has none.
        silence: (S, T) speech features of silence, as long as the longest motion of a step.
        conditioner: converts waves to speech features; None without speech input.
        styles: names of the styles, in alphabetical order; empty outside label mode. A model to
            start from may have more styles than the recordings.
        speakers: reference skeleton of each named speaker.
        window: frames of a training window; None for whole sequences.
        sources: recordings from which `paired` was read.
        recorded_fps: most common frame rate of the recordings.
        passive: joints and face channels that are played but not modelled; none without `state`.
        start: weights of the generators to start from, by name; empty for random ones.
        spoken: seconds and number of the sounds without motion.
        sampled: parts of `paired` from which statistics are computed; None for all of it.
        stored: of recordings on disk, what `load` finds them by.
    """

    paired: tuple[PairedSequence, ...]
    unpaired: tuple[Frames, ...]
    silence: Tensor
    window: int | None
    representation: MultiresRepresentation
    conditioner: SpeechConditioner | None
    styles: tuple[str, ...]
    normaliser: Normaliser
    speakers: dict[str, Skeleton]
    unpaired_is_paired: bool
    sources: tuple[TrainedSegment, ...]
    recorded_fps: float
    passive: PassiveChannels
    start: Mapping[str, Tensor]
    spoken: tuple[float, int]
    sampled: tuple[Cut, ...] | None = None
    stored: StoredCorpus | None = None

    @cached_property
    def sample(self) -> tuple[PairedSequence, ...]:
        """Return recordings or parts of them, in memory, from which statistics are computed."""
        cuts = self.sampled
        if cuts is None and self.stored is None:
            return self.paired
        if cuts is None:
            cuts = tuple((i, 0, sequence.n_frames) for i, sequence in enumerate(self.paired))
        return tuple(self.paired[i].cut(start, stop) for i, start, stop in cuts)

    def save(self, folder: Path) -> None:
        """Write the data into a folder, from which a resumed run loads it."""
        tensors: dict[str, Any] = {
            "silence": self.silence,
            "motion.mean": self.normaliser.mean,
            "motion.scale": self.normaliser.scale,
            **conditioner_tensors(self.conditioner),
            **start_tensors(self.start),
        }
        if self.stored is None:
            for i, sequence in enumerate(self.paired):
                for name in PairedSequence.TENSORS:
                    tensors[f"paired.{i}.{name}"] = getattr(sequence, name).contiguous()
            if not self.unpaired_is_paired:
                tensors |= {f"unpaired.{i}": clip for i, clip in enumerate(self.unpaired)}
        else:
            tensors["sigma"] = self.paired[0].sigma
        about = {
            "names": [sequence.name for sequence in self.paired],
            "unpaired": 0 if self.unpaired_is_paired else len(self.unpaired),
            "features": None if self.conditioner is None else conditioner_values(self.conditioner),
            "styles": list(self.styles),
            "style_of": [sequence.style for sequence in self.paired],
            "speaker_of": [sequence.speaker for sequence in self.paired],
            "take_of": [sequence.take for sequence in self.paired],
            "sources": to_values(self.sources),
            "window": self.window,
            "recorded_fps": self.recorded_fps,
            "passive": [list(self.passive.joints), self.passive.expressions],
            "spoken": self.spoken,
            "sampled": self.sampled,
            "stored": None if self.stored is None else asdict(self.stored),
            **rig_values(self.representation, self.speakers),
        }
        save_data(folder, tensors, about)

    @classmethod
    def load(cls, folder: Path, config: MultiresConfig, device: str = "cpu") -> TrainingData:
        """Read what `save` wrote; encoders compute on the device.

        Raises:
            ConfigError: the folder's data is missing or damaged.
            WeightsError: the WavLM weights differ from those at the start of the run.
        """

        def assemble(about: dict[str, Any], tensors: dict[str, Any]) -> TrainingData:
            joints, expressions = about["passive"]
            skeleton = Skeleton.from_json(about["skeleton"])
            representation = MultiresRepresentation.from_json(skeleton, about["motion"])
            normaliser = Normaliser(tensors["motion.mean"], tensors["motion.scale"])
            conditioner = None
            if config.features is not None:
                places = config.features.encoder_places
                about_features = about["features"]
                conditioner = load_conditioner(about_features, tensors, config.fps, places, device)
            names = ("names", "style_of", "speaker_of", "take_of")
            labels = list(zip(*(about[key] for key in names), strict=True))
            stored = None
            if about["stored"] is None:
                paired = tuple(
                    PairedSequence(
                        name,
                        *[tensors[f"paired.{i}.{part}"] for part in PairedSequence.TENSORS],
                        *others,
                    )
                    for i, (name, *others) in enumerate(labels)
                )
                unpaired = tuple(tensors[f"unpaired.{i}"] for i in range(about["unpaired"]))
            else:
                stored = StoredCorpus(**about["stored"])
                paired, unpaired = stored.sequences(
                    config, labels, normaliser, conditioner, tensors["sigma"]
                )
            return cls(
                paired=paired,
                unpaired=unpaired or tuple(sequence.speech for sequence in paired),
                silence=tensors["silence"],
                window=about["window"],
                representation=representation,
                conditioner=conditioner,
                styles=tuple(about["styles"]),
                normaliser=normaliser,
                speakers=read_speakers(about),
                unpaired_is_paired=config.features is not None and not unpaired,
                sources=from_values(about["sources"]),
                recorded_fps=about["recorded_fps"],
                passive=PassiveChannels(tuple(joints), expressions),
                start=read_start(tensors),
                spoken=tuple(about["spoken"]),
                sampled=_cuts(about["sampled"]),
                stored=stored,
            )

        return load_data(folder, assemble)

    @property
    def n_speech(self) -> int:
        """Return S, the number of speech features; 0 without speech input."""
        return self.silence.shape[0]

    def conditions(self, config: MultiresConfig) -> Conditions:
        """Return the inputs of the model beside noise."""
        state = self.state_channels if config.state else None
        return Conditions(self.conditioner, self.styles, config.residual, state)

    @cached_property
    def state_channels(self) -> StateChannels:
        """Return the channels of the state of movement of the rig."""
        return StateChannels.find(self.representation.skeleton, self.representation.joints)

    def state_levels(self, state: np.ndarray, lengths: Sequence[int]) -> list[Tensor]:
        """Return the states (N, C, T_i) of each level from those of N windows, (N, C, T)."""
        n_carriers = self.state_channels.n_carriers
        return [torch.from_numpy(state_level(state, n_carriers, n)) for n in lengths]

    def clocked_noises(
        self, state: np.ndarray, lengths: Sequence[int], sigma: Tensor
    ) -> list[Tensor | None]:
        """Return the noise of states (N, C, T): that of level 1 alone, see `clocked_noise`.

        `sigma` (L,) is the noise scale of each level.
        """
        n_carriers = self.state_channels.n_carriers
        first = clocked_noise(state, n_carriers, lengths[0], sigma[0])
        return [first, *[None] * (len(lengths) - 1)]

    @property
    def own_lengths(self) -> bool:
        """Return True if random steps have the lengths of unpaired clips, not of recordings."""
        return self.window is None and self.n_speech > 0

    def draw_weight(self, sequence: PairedSequence) -> float:
        """Return how often a recording is drawn, relative to the others.

        Whole recordings are drawn equally often (eq. 15), and so are windows, wherever they are.
        """
        return 1.0 if self.window is None else float(sequence.n_frames)

    def style_shares(self, sequences: Sequence[PairedSequence]) -> Tensor:
        """Return how often a recording of each style (K,) is drawn from these sequences."""
        shares = torch.zeros(len(self.styles))
        for sequence in sequences:
            shares[sequence.style] += self.draw_weight(sequence)
        return shares

    def window_lengths(self) -> dict[int, list[int]]:
        """Return {window length: indices of paired sequences with windows of that length}."""
        groups: dict[int, list[int]] = {}
        for i, sequence in enumerate(self.paired):
            frames = sequence.n_frames
            length = frames if self.window is None else min(frames, self.window)
            groups.setdefault(length, []).append(i)
        return groups

    @cached_property
    def _unpaired_frames(self) -> Tensor:
        return torch.tensor([float(clip.shape[-1]) for clip in self.unpaired])

    def speech_window(self, n_frames: int, margin: int, rng: torch.Generator) -> Tensor:
        """Draw unpaired speech (S, n_frames + 2 margin) for a motion of a random step.

        Without a window, it is a whole clip of `n_frames`, and its margins are those of generation.
        A window that is longer than its clip continues with another one.
        """
        if self.own_lengths:
            clips = [clip for clip in self.unpaired if clip.shape[-1] == n_frames]
            clip = clips[int(torch.randint(len(clips), (), generator=rng))]
            return reflect(clip[:, :], margin)
        missing = n_frames + 2 * margin
        if not self.n_speech:
            return torch.empty(0, missing)
        parts = []
        while missing:
            which = int(torch.multinomial(self._unpaired_frames, 1, generator=rng))
            clip = self.unpaired[which]
            slack = max(0, clip.shape[-1] - missing)
            start = int(torch.randint(slack + 1, (), generator=rng))
            parts.append(clip[:, start : start + missing])
            missing -= parts[-1].shape[-1]
        return torch.cat(parts, dim=-1)


def _cuts(values: Sequence[Sequence[int]] | None) -> tuple[Cut, ...] | None:
    """Return the inverse of their plain values."""
    return None if values is None else tuple((i, start, stop) for i, start, stop in values)
