"""Training data of a multires run: normalised recordings and speech features, in memory or on disk.

Reconstruction steps and discriminators use paired sequences (speech and motion). Random-generation
steps use unpaired speech only. Without speech input, speech has no channels (0, T), and every
motion is a sequence.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

import audio_features as af
from gesturekit.corpus.speech import SpeechConditioner
from gesturekit.motion.skeleton import Skeleton
from gesturekit.multires.conditions import Conditions
from gesturekit.multires.config import MultiresConfig
from gesturekit.multires.layers import reflect, resample
from gesturekit.multires.motion_vector import MultiresRepresentation, Normaliser
from gesturekit.multires.retrieval import PassiveChannels
from gesturekit.state.channels import StateChannels
from gesturekit.training.data.arrays import ArrayFolder, Frames, StoredArray, StoredFrames
from gesturekit.training.data.features import (
    conditioner_values,
    load_conditioner,
    stored_speech,
)
from gesturekit.training.data.sources import TrainedSegment, from_values, to_values
from gesturekit.training.data.start_model import read_start, start_tensors
from gesturekit.training.model_folder import (
    fitted_tensors,
    load_data,
    read_speakers,
    rig_values,
    save_data,
)
from gesturekit.training.seeds import rng_for

Cut = tuple[int, int, int]
"""Index of a paired sequence, first frame and end."""
Labels = tuple[str, int, str | None, str]
"""Name, number of the style, speaker and take of a sequence."""
_LABELS = ("names", "style_of", "speaker_of", "take_of")


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

    TENSORS: ClassVar[tuple[str, ...]] = ("motion", "speech", "sigma", "z_star", "passive")

    name: str
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

    @classmethod
    def make(
        cls,
        name: str,
        motion: Frames,
        speech: Frames,
        levels: int,
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
            sigma = level_sigmas(motion[:, :][None], levels)
        channels, n_frames = motion.shape
        n_coarsest = af.level_lengths(n_frames, levels)[0]
        rng = rng_for(seed, "z_star", name)
        if full_noise:
            noise = torch.randn(channels, n_coarsest, generator=rng)
        else:
            noise = torch.randn(n_coarsest, generator=rng) * sigma[0]
        about = {"passive": torch.empty(0, n_frames), **about}
        return cls(name, motion, speech, sigma, noise, **about)

    def cut(self, start: int, stop: int) -> PairedSequence:
        """Return frames `start` to `stop` in memory, with their part of z*."""
        frames = slice(start, stop)
        n_coarsest = af.level_lengths(stop - start, len(self.sigma))[0]
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


def level_sigmas(motion: Tensor, levels: int) -> Tensor:
    """Return sigma_i of all levels (L,) for a normalised motion (1, D, T)."""
    lengths = af.level_lengths(motion.shape[-1], levels)
    pyramid = [resample(motion, n) for n in lengths]
    sigmas = [pyramid[0].square().mean().sqrt()]
    for coarse, fine in zip(pyramid, pyramid[1:], strict=False):
        sigmas.append((fine - resample(coarse, fine.shape[-1])).square().mean().sqrt())
    return torch.stack(sigmas)


def paired_sequences(
    config: MultiresConfig,
    labels: Sequence[Labels],
    motions: Sequence[Frames],
    speeches: Sequence[Frames],
    passives: Sequence[Frames],
    sigma: Tensor | None = None,
) -> tuple[PairedSequence, ...]:
    """Return recordings as long as the shorter of motion and speech; see `PairedSequence`."""
    paired = []
    for label, motion, speech, passive in zip(labels, motions, speeches, passives, strict=True):
        n_frames = min(motion.shape[1], speech.shape[1])
        name, style, speaker, take = label
        sequence = PairedSequence.make(
            name,
            _first(motion, n_frames),
            _first(speech, n_frames),
            config.network.levels,
            config.seed,
            full_noise=config.z_star == "full",
            sigma=sigma,
            passive=_first(passive, n_frames),
            style=style,
            speaker=speaker,
            take=take,
        )
        paired.append(sequence)
    return tuple(paired)


def _first(frames: Frames, n_frames: int) -> Frames:
    """Return the first frames (C, n_frames)."""
    if frames.shape[1] == n_frames:
        return frames
    if isinstance(frames, StoredFrames):
        return frames.first(n_frames)
    return frames[:, :n_frames].contiguous()


def stored_motion(array: StoredArray, normaliser: Normaliser) -> tuple[StoredFrames, StoredFrames]:
    """Return normalised motion (D, T) and passive channels (X, T) of an array (T, D + X)."""
    width, (n_frames, columns) = len(normaliser.mean), array.shape

    def motion(rows: np.ndarray) -> Tensor:
        return normaliser.forward(transposed(rows[:, :width])[None])[0]

    def passive(rows: np.ndarray) -> Tensor:
        return transposed(rows[:, width:])

    return (
        StoredFrames(array, (width, n_frames), motion),
        StoredFrames(array, (columns - width, n_frames), passive),
    )


def transposed(rows: np.ndarray) -> Tensor:
    """Return (T, C) as a contiguous (C, T) tensor."""
    return torch.from_numpy(np.ascontiguousarray(rows.T))


def stored_sequences(
    config: MultiresConfig,
    keys: Mapping[str, Sequence[str]],
    labels: Sequence[Labels],
    normaliser: Normaliser,
    conditioner: SpeechConditioner | None,
    sigma: Tensor,
) -> tuple[tuple[PairedSequence, ...], tuple[StoredFrames, ...]]:
    """Return recordings on disk, and speech without motion (S, T); neither is read yet.

    Args:
        config: of the run.
        keys: names of the arrays in their folder, of `motion`, `speech` and `unpaired` speech.
        labels: of each recording.
        normaliser: of motion vectors.
        conditioner: of speech features; None without speech input.
        sigma: (L,) noise scales of all sequences.

    Raises:
        ConfigError: an array is missing or not whole.
    """
    folder = ArrayFolder(config.arrays_folder)
    arrays = {kind: folder.find_all(names) for kind, names in keys.items()}
    lengths = [array.shape[0] for array in arrays["motion"]]
    speeches: Sequence[Frames] = [torch.empty(0, n_frames) for n_frames in lengths]
    unpaired: Sequence[StoredFrames] = ()
    if conditioner is not None:
        speeches = stored_speech(arrays["speech"], conditioner, lengths)
        unpaired = stored_speech(arrays["unpaired"], conditioner)
    pairs = [stored_motion(array, normaliser) for array in arrays["motion"]]
    motions, passives = zip(*pairs)
    paired = paired_sequences(config, labels, motions, speeches, passives, sigma)
    return paired, tuple(unpaired)


@dataclass(frozen=True)
class TrainingData:
    """Training data of a run, on the CPU.

    Attributes:
        paired: recordings with motion.
        unpaired: (S, T) speech without motion; that of `paired` if the corpus has none.
        silence: (S, T) speech features of silence, as long as the longest motion of a step.
        window: frames of a training window; None for whole sequences.
        conditioner: converts waves to speech features; None without speech input.
        styles: names of the styles, in alphabetical order; empty outside label mode. A model to
            start from may have more styles than the recordings.
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
    conditioner: SpeechConditioner | None
    styles: tuple[str, ...]
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
        """Write the data into a folder, from which a resumed run loads it."""
        tensors: dict[str, Any] = {
            "silence": self.silence,
            **fitted_tensors(self.normaliser, self.conditioner, None),
            **start_tensors(self.start),
        }
        unpaired = () if self.unpaired_is_paired else self.unpaired
        stored = None
        if self.is_stored:
            tensors["sigma"] = self.paired[0].sigma
            stored = {
                "motion": [_key(sequence.motion) for sequence in self.paired],
                "speech": [_key(sequence.speech) for sequence in self.paired if self.n_speech],
                "unpaired": [_key(clip) for clip in unpaired if self.n_speech],
            }
        else:
            for i, sequence in enumerate(self.paired):
                for name in PairedSequence.TENSORS:
                    tensors[f"paired.{i}.{name}"] = getattr(sequence, name).contiguous()
            tensors |= {f"unpaired.{i}": clip for i, clip in enumerate(unpaired)}
        about = {
            "names": [sequence.name for sequence in self.paired],
            "unpaired": len(unpaired),
            "features": None if self.conditioner is None else conditioner_values(self.conditioner),
            "styles": self.styles,
            "style_of": [sequence.style for sequence in self.paired],
            "speaker_of": [sequence.speaker for sequence in self.paired],
            "take_of": [sequence.take for sequence in self.paired],
            "sources": to_values(self.sources),
            "window": self.window,
            "recorded_fps": self.recorded_fps,
            "passive": [self.passive.joints, self.passive.expressions],
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
            normaliser = Normaliser(tensors["motion.mean"], tensors["motion.scale"])
            conditioner = None
            if config.features is not None:
                places = config.features.encoder_places
                conditioner = load_conditioner(
                    about["features"], tensors, config.fps, places, device
                )
            labels = list(zip(*(about[key] for key in _LABELS), strict=True))
            unpaired: Sequence[Frames]
            if about["stored"] is None:
                curves = (
                    {part: tensors[f"paired.{i}.{part}"] for part in PairedSequence.TENSORS}
                    for i in range(len(labels))
                )
                paired = tuple(
                    PairedSequence(name=name, style=style, speaker=speaker, take=take, **frames)
                    for (name, style, speaker, take), frames in zip(labels, curves, strict=True)
                )
                unpaired = [tensors[f"unpaired.{i}"] for i in range(about["unpaired"])]
            else:
                paired, unpaired = stored_sequences(
                    config, about["stored"], labels, normaliser, conditioner, tensors["sigma"]
                )
            joints, expressions = about["passive"]
            sampled = about["sampled"]
            return cls(
                paired=paired,
                unpaired=tuple(unpaired) or tuple(sequence.speech for sequence in paired),
                silence=tensors["silence"],
                window=about["window"],
                representation=MultiresRepresentation.from_json(skeleton, about["motion"]),
                conditioner=conditioner,
                styles=tuple(about["styles"]),
                normaliser=normaliser,
                speakers=read_speakers(about),
                sources=from_values(about["sources"]),
                recorded_fps=about["recorded_fps"],
                passive=PassiveChannels(tuple(joints), expressions),
                start=read_start(tensors),
                spoken=tuple(about["spoken"]),
                sampled=None if sampled is None else tuple(map(tuple, sampled)),
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
        pieces = []
        while missing:
            which = int(torch.multinomial(self._unpaired_frames, 1, generator=rng))
            clip = self.unpaired[which]
            slack = max(0, clip.shape[-1] - missing)
            start = int(torch.randint(slack + 1, (), generator=rng))
            pieces.append(clip[:, start : start + missing])
            missing -= pieces[-1].shape[-1]
        return torch.cat(pieces, dim=-1)


def _key(frames: Frames) -> str:
    """Return the name of the array of a recording on disk."""
    assert isinstance(frames, StoredFrames)
    return frames.array.path.stem
