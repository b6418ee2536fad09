"""Training data of a multires run: normalised recordings and speech features, in memory or on disk.

Reconstruction steps and discriminators use paired sequences (speech and motion). Random-generation
steps use unpaired speech only. Without speech input, speech has no channels (0, T), and every
motion is a sequence.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gesturekit.corpus.speech import SpeechConditioner
from gesturekit.motion.skeleton import Skeleton
from gesturekit.multires.config import MultiresConfig, NetworkConfig
from gesturekit.multires.motion_vector import MultiresRepresentation, Normaliser
from gesturekit.multires.pyramid import Conditions
from gesturekit.multires.resampling import reflect, resample
from gesturekit.multires.retrieval import PassiveChannels
from gesturekit.state.channels import StateChannels
from gesturekit.training.arrays import Array, ArrayFolder, Frames, StoredFrames
from gesturekit.training.features import conditioner_values, load_conditioner, speech_frames
from gesturekit.training.model_folder import (
    fitted_tensors,
    load_data,
    read_speakers,
    rig_values,
    save_data,
)
from gesturekit.training.origin import (
    TrainedSegment,
    from_values,
    read_start,
    start_tensors,
)
from gesturekit.training.seeds import rng_for

Cut = tuple[int, int, int]
"""Index of a paired sequence, first frame and end."""
_LABELS = {"names": "name", "style_of": "style", "speaker_of": "speaker", "take_of": "take"}
"""Entries of the saved data: an attribute of each paired sequence."""


@dataclass(frozen=True)
class PairedSequence:
    """Recording with speech features, noise and style.

    Attributes:
        name: id of the manifest item.
        motion: (D, T) normalised motion vectors.
        speech: (S, T) features.
        sigma: (L,) noise scale of each level: RMSE between the level and the upsampled coarser one;
            RMS at the first level. Recordings on disk share those of the sample.
        z_star: noise at level 1 from which this recording is reconstructed, (T_1,), or (D, T_1)
            with separate noise for each channel.
        passive: (X, T) of the corpus's `PassiveChannels`.
        style: index among the corpus's styles; 0 without styles.
        speaker: its speaker; None if the corpus names none.
        take: its recording session, see `gesturekit.corpus.Item`.
    """

    name: str
    network: NetworkConfig
    motion: Frames
    speech: Frames
    sigma: Tensor
    z_star: Tensor
    passive: Frames
    style: int = 0
    speaker: str | None = None
    take: str = ""

    @property
    def n_frames(self) -> int:
        """Return T, at the full rate."""
        return self.motion.shape[-1]

    @property
    def lengths(self) -> list[int]:
        """Return T_i, frames of each level."""
        return self.network.lengths(self.n_frames)

    @classmethod
    def make(
        cls,
        name: str,
        motion: Frames,
        speech: Frames,
        network: NetworkConfig,
        seed: int,
        *,
        full_noise: bool = False,
        sigma: Tensor | None = None,
        **about: Any,
    ) -> PairedSequence:
        """Make a sequence; its noise depends on the seed and the name only.

        `sigma` (L,) is computed from the motion if it is None; `about` are other fields.
        """
        if sigma is None:
            sigma = level_sigmas(motion[:, :][None], network)
        channels, n_frames = motion.shape
        n_coarsest = network.lengths(n_frames)[0]
        rng = rng_for(seed, "z_star", name)
        if full_noise:
            noise = torch.randn(channels, n_coarsest, generator=rng)
        else:
            noise = torch.randn(n_coarsest, generator=rng) * sigma[0]
        about = {"passive": torch.empty(0, n_frames), **about}
        return cls(name, network, motion, speech, sigma, noise, **about)

    def cut(self, start: int, stop: int) -> PairedSequence:
        """Return frames `start` to `stop` in memory, with their part of z*."""
        frames = slice(start, stop)
        n_coarsest = self.network.lengths(stop - start)[0]
        z_star = self.z_star_window(start, n_coarsest)
        return replace(
            self,
            name=f"{self.name}[{start}:{stop}]",
            motion=self.motion[:, frames].contiguous(),
            speech=self.speech[:, frames].contiguous(),
            z_star=z_star if self.z_star.ndim > 1 else z_star[0],
            passive=self.passive[:, frames].contiguous(),
        )

    def z_star_window(self, start: int, n_coarsest: int) -> Tensor:
        """Return the noise (1 or D, T_1) of the window that starts at this full-rate frame."""
        noise = self.z_star.reshape(-1, self.z_star.shape[-1])
        first = round(start * noise.shape[-1] / self.n_frames)
        first = max(0, min(first, noise.shape[-1] - n_coarsest))
        window = noise[:, first : first + n_coarsest]
        # A window as long as its sequence may come out one coarse frame longer by rounding.
        return resample(window, n_coarsest)


def level_sigmas(motion: Tensor, network: NetworkConfig) -> Tensor:
    """Return sigma_i of all levels (L,) for a normalised motion (1, D, T)."""
    lengths = network.lengths(motion.shape[-1])
    pyramid = [resample(motion, n) for n in lengths]
    sigmas = [pyramid[0].square().mean().sqrt()]
    for coarse, fine in zip(pyramid, pyramid[1:], strict=False):
        sigmas.append((fine - resample(coarse, fine.shape[-1])).square().mean().sqrt())
    return torch.stack(sigmas)


class CorpusFrames(NamedTuple):
    """Channels of a corpus, in memory or on disk.

    Attributes:
        motion: (D, T) normalised motion vectors of each recording.
        speech: (S, T) features of each recording.
        passive: (X, T) passive channels of each recording.
        unpaired: (S, T) features of speech without motion.
    """

    motion: Sequence[Frames]
    speech: Sequence[Frames]
    passive: Sequence[Frames]
    unpaired: Sequence[Frames]

    @classmethod
    def of(
        cls,
        arrays: Mapping[str, Sequence[Array]],
        normaliser: Normaliser,
        conditioner: SpeechConditioner | None,
    ) -> CorpusFrames:
        """Return the channels of arrays; none of them is read yet.

        Recordings are as long as the shorter of motion and speech.

        Args:
            arrays: `motion` (T, D + X), `speech` and `unpaired` speech, see `SpeechArrays`.
            normaliser: of motion vectors.
            conditioner: of speech features; None without speech input.
        """
        width, motion = len(normaliser.mean), arrays["motion"]
        lengths = [array.shape[0] for array in motion]
        if conditioner is None:
            spoken: list[Frames] = [torch.empty(0, n_frames) for n_frames in lengths]
        else:
            lengths = [min(n, a.shape[0]) for n, a in zip(lengths, arrays["speech"], strict=True)]
            all_lengths = [*lengths, *(array.shape[0] for array in arrays["unpaired"])]
            everything = [*arrays["speech"], *arrays["unpaired"]]
            spoken = [*speech_frames(everything, conditioner, all_lengths)]

        def vectors(rows: np.ndarray) -> Tensor:
            values = torch.from_numpy(np.ascontiguousarray(rows[:, :width]))
            return normaliser.forward(values.T[None])[0]

        def passive(rows: np.ndarray) -> Tensor:
            return transposed(rows[:, width:])

        pairs = list(zip(motion, lengths, strict=True))
        return cls(
            [StoredFrames(array, (width, n), vectors) for array, n in pairs],
            spoken[: len(motion)],
            [StoredFrames(array, (array.shape[1] - width, n), passive) for array, n in pairs],
            spoken[len(motion) :],
        )

    def in_memory(self) -> CorpusFrames:
        """Return the same channels as tensors."""
        return CorpusFrames(*([frames[:, :] for frames in channels] for channels in self))


def paired_sequences(
    config: MultiresConfig,
    labels: Sequence[Mapping[str, Any]],
    frames: CorpusFrames,
    sigmas: Sequence[Tensor | None],
) -> tuple[PairedSequence, ...]:
    """Return the recordings with their labels and noise scales (L,); None computes these.

    Labels are name, style, speaker and take of each.
    """
    make = partial(PairedSequence.make, network=config.network, seed=config.seed)
    make = partial(make, full_noise=config.z_star == "full")
    channels = zip(labels, frames.motion, frames.speech, frames.passive, sigmas, strict=True)
    return tuple(
        make(motion=motion, speech=speech, passive=passive, sigma=sigma, **label)
        for label, motion, speech, passive, sigma in channels
    )


def transposed(rows: np.ndarray) -> Tensor:
    """Return (T, C) as a contiguous (C, T) tensor."""
    return torch.from_numpy(np.ascontiguousarray(rows.T))


@dataclass(frozen=True)
class TrainingData:
    """Training data of a run, on the CPU.

    Attributes:
        paired: recordings with motion.
        unpaired: (S, T) speech without motion; that of `paired` if the corpus has none.
        silence: (S, T) speech features of silence, as long as the longest motion of a step.
        window: frames of a training window; None for whole sequences.
        conditions: inputs of the model beside noise. A model to start from may have more styles
            than the recordings.
        speakers: reference skeleton of each named speaker.
        sources: recordings from which `paired` was read.
        recorded_fps: most common frame rate of the recordings.
        passive: joints and face channels that are played but not modelled; none without `state`.
        start: weights of the generators to start from, by name; empty for random ones.
        spoken: seconds and number of the sounds without motion.
        sampled: parts of `paired` from which statistics are computed; None for all of it.
    """

    paired: tuple[PairedSequence, ...]
    unpaired: tuple[Frames, ...]
    silence: Tensor
    window: int | None
    representation: MultiresRepresentation
    conditions: Conditions
    normaliser: Normaliser
    speakers: dict[str, Skeleton]
    sources: tuple[TrainedSegment, ...]
    recorded_fps: float
    passive: PassiveChannels
    start: Mapping[str, Tensor]
    spoken: tuple[float, int]
    sampled: tuple[Cut, ...] | None = None

    @property
    def unpaired_is_paired(self) -> bool:
        """Return True if the corpus has no unpaired speech for a model with speech input."""
        return self.n_speech > 0 and self.unpaired[0] is self.paired[0].speech

    @property
    def is_stored(self) -> bool:
        """Return True if the recordings are arrays on disk."""
        return isinstance(self.paired[0].motion, StoredFrames)

    @property
    def seconds(self) -> float:
        """Return the length of all recordings."""
        return sum(source.duration for source in self.sources)

    @cached_property
    def sample(self) -> tuple[PairedSequence, ...]:
        """Return recordings or parts of them, in memory, from which statistics are computed."""
        if self.sampled is None:
            return self.paired
        return tuple(self.paired[i].cut(start, stop) for i, start, stop in self.sampled)

    def save(self, folder: Path) -> None:
        """Write the data into a folder, from which a resumed run loads it.

        Of recordings on disk, the names of their arrays are written.
        """
        channels: dict[str, list[Any]] = {
            **{name: [getattr(s, name) for s in self.paired] for name in CorpusFrames._fields[:3]},
            "unpaired": [] if self.unpaired_is_paired else [*self.unpaired],
        }
        conditioner, passive, stored = self.conditions.conditioner, self.passive, None
        tensors = {
            "silence": self.silence,
            "sigma": torch.stack([sequence.sigma for sequence in self.paired]),
            **fitted_tensors(self.normaliser, conditioner, None),
            **start_tensors(self.start),
        }
        if self.is_stored:
            arrays = ("motion", "speech", "unpaired") if self.n_speech else ("motion",)
            stored = {name: [frames.key for frames in channels[name]] for name in arrays}
        else:
            for name, recordings in channels.items():
                tensors |= {f"{name}.{i}": each.contiguous() for i, each in enumerate(recordings)}
        about = {
            **{key: [getattr(s, name) for s in self.paired] for key, name in _LABELS.items()},
            "unpaired": len(channels["unpaired"]),
            "features": None if conditioner is None else conditioner_values(conditioner),
            "styles": self.conditions.styles,
            "sources": [*map(asdict, self.sources)],
            "window": self.window,
            "recorded_fps": self.recorded_fps,
            "passive": [passive.joints, passive.face],
            "spoken": self.spoken,
            "sampled": self.sampled,
            "stored": stored,
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

        def assemble(about: dict[str, Any], tensors: dict[str, Tensor]) -> TrainingData:
            skeleton = Skeleton.from_json(about["skeleton"])
            representation = MultiresRepresentation.from_json(skeleton, about["motion"])
            normaliser = Normaliser(tensors["motion.mean"], tensors["motion.scale"])
            conditioner = None
            if config.features is not None:
                places = config.features.encoder_places
                conditioner = load_conditioner(
                    about["features"], tensors, config.fps, places, device
                )
            rows = zip(*(about[key] for key in _LABELS), strict=True)
            labels = [dict(zip(_LABELS.values(), row, strict=True)) for row in rows]
            if about["stored"] is None:
                counts = (*[len(labels)] * 3, about["unpaired"])
                kept = zip(CorpusFrames._fields, counts, strict=True)
                frames = CorpusFrames(*([tensors[f"{k}.{i}"] for i in range(n)] for k, n in kept))
            else:
                find = ArrayFolder(config.arrays_folder).find_all
                arrays = {name: find(keys) for name, keys in about["stored"].items()}
                frames = CorpusFrames.of(arrays, normaliser, conditioner)
            known, (joints, face), sampled = about["styles"], about["passive"], about["sampled"]
            find = StateChannels.find
            state = find(skeleton, representation.joints) if config.state else None
            return cls(
                paired=paired_sequences(config, labels, frames, list(tensors["sigma"])),
                unpaired=tuple(frames.unpaired or frames.speech),
                silence=tensors["silence"],
                window=about["window"],
                representation=representation,
                conditions=Conditions(conditioner, tuple(known), config.residual, state),
                normaliser=normaliser,
                speakers=read_speakers(about),
                sources=from_values(about["sources"]),
                recorded_fps=about["recorded_fps"],
                passive=PassiveChannels(tuple(joints), tuple(face)),
                start=read_start(tensors),
                spoken=tuple(about["spoken"]),
                sampled=None if sampled is None else tuple(map(tuple, sampled)),
            )

        return load_data(folder, assemble)

    @property
    def n_speech(self) -> int:
        """Return S, the number of speech features; 0 without speech input."""
        return self.silence.shape[0]

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
        shares = torch.zeros(len(self.conditions.styles))
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
        pieces = []
        while missing:
            which = int(torch.multinomial(self._unpaired_frames, 1, generator=rng))
            clip = self.unpaired[which]
            slack = max(0, clip.shape[-1] - missing)
            start = int(torch.randint(slack + 1, (), generator=rng))
            pieces.append(clip[:, start : start + missing])
            missing -= pieces[-1].shape[-1]
        return torch.cat(pieces, dim=-1)
