"""Training data of a multires run: normalised recordings and speech features in memory.

Reconstruction steps and discriminators use paired sequences (speech and motion). Random-generation
steps use unpaired speech only. Without speech input, speech has no channels (0, T), and every
motion is a sequence.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor

import audio_features as af
from gesturekit.corpus.speech import SpeechConditioner
from gesturekit.motion.skeleton import Skeleton
from gesturekit.multires.config import MultiresConfig
from gesturekit.multires.motion_vector import MultiresRepresentation, Normaliser
from gesturekit.multires.network.resampling import reflect, resample
from gesturekit.multires.recall.parts import PassiveChannels
from gesturekit.multires.sampling.conditions import Conditions
from gesturekit.training.data.data_folder import load_data, save_data
from gesturekit.training.data.features import (
    conditioner_tensors,
    conditioner_values,
    load_conditioner,
)
from gesturekit.training.data.sources import TrainedSegment, from_values, to_values
from gesturekit.training.data.start_model import read_start, start_tensors
from gesturekit.training.model_folder import read_speakers, rig_values
from gesturekit.training.seeds import rng_for


@dataclass(frozen=True)
class PairedSequence:
    """Recording with speech features, noise and style.

    Attributes:
        name: id of the manifest item.
        motion: (D, T) normalised motion vectors.
        speech: (S, T) features.
        sigma: (L,) noise scale of each level: RMSE between the level and the upsampled coarser one;
            RMS at the first level.
        z_star: noise at level 1 from which this recording is reconstructed, (T_1,), or (D, T_1)
            with separate noise for each channel.
        passive: (X, T) of the corpus's `PassiveChannels`.
        style: index among the corpus's styles; 0 without styles.
        speaker: its speaker; None if the corpus names none.
        take: its recording session, see `gesturekit.corpus.Item`.
    """

    TENSORS: ClassVar[tuple[str, ...]] = ("motion", "speech", "sigma", "z_star", "passive")

    name: str
    motion: Tensor
    speech: Tensor
    sigma: Tensor
    z_star: Tensor
    passive: Tensor
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
        motion: Tensor,
        speech: Tensor,
        levels: int,
        seed: int,
        *,
        style: int = 0,
        full_noise: bool = False,
    ) -> PairedSequence:
        """Make a sequence; its noise depends on the seed and the name only."""
        sigma = level_sigmas(motion[None], levels)
        n_coarsest = af.level_lengths(motion.shape[-1], levels)[0]
        rng = rng_for(seed, "z_star", name)
        if full_noise:
            noise = torch.randn(len(motion), n_coarsest, generator=rng)
        else:
            noise = torch.randn(n_coarsest, generator=rng) * sigma[0]
        passive = motion.new_zeros(0, motion.shape[-1])
        return cls(name, motion, speech, sigma, noise, passive, style)

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
        passive: joints and face channels that are recalled but not modelled; none without recall.
        start: weights of the generators to start from, by name; empty for random ones.
    """

    paired: tuple[PairedSequence, ...]
    unpaired: tuple[Tensor, ...]
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

    def save(self, folder: Path) -> None:
        """Write the data into a folder, from which a resumed run loads it."""
        tensors = {
            "silence": self.silence,
            "motion.mean": self.normaliser.mean,
            "motion.scale": self.normaliser.scale,
            **conditioner_tensors(self.conditioner),
            **start_tensors(self.start),
        }
        for i, sequence in enumerate(self.paired):
            for name in PairedSequence.TENSORS:
                tensors[f"paired.{i}.{name}"] = getattr(sequence, name).contiguous()
        if not self.unpaired_is_paired:
            tensors |= {f"unpaired.{i}": clip for i, clip in enumerate(self.unpaired)}
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
            joints, expressions = about["passive"]
            paired = tuple(
                PairedSequence(
                    name,
                    *(tensors[f"paired.{i}.{part}"] for part in PairedSequence.TENSORS),
                    *labels,
                )
                for i, (name, *labels) in enumerate(
                    zip(
                        *(about[key] for key in ("names", "style_of", "speaker_of", "take_of")),
                        strict=True,
                    )
                )
            )
            unpaired = tuple(tensors[f"unpaired.{i}"] for i in range(about["unpaired"]))
            skeleton = Skeleton.from_json(about["skeleton"])
            return cls(
                paired=paired,
                unpaired=unpaired or tuple(sequence.speech for sequence in paired),
                silence=tensors["silence"],
                window=about["window"],
                representation=MultiresRepresentation.from_json(skeleton, about["motion"]),
                conditioner=None
                if config.features is None
                else load_conditioner(
                    about["features"], tensors, config.fps, config.features.encoder_places, device
                ),
                styles=tuple(about["styles"]),
                normaliser=Normaliser(tensors["motion.mean"], tensors["motion.scale"]),
                speakers=read_speakers(about),
                unpaired_is_paired=config.features is not None and not unpaired,
                sources=from_values(about["sources"]),
                recorded_fps=about["recorded_fps"],
                passive=PassiveChannels(tuple(joints), expressions),
                start=read_start(tensors),
            )

        return load_data(folder, assemble)

    @property
    def n_speech(self) -> int:
        """Return S, the number of speech features; 0 without speech input."""
        return self.silence.shape[0]

    def conditions(self, config: MultiresConfig) -> Conditions:
        """Return the inputs of the model beside noise."""
        recalls = config.recall is not None
        return Conditions(self.conditioner, self.styles, config.residual, recalls)

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

    def speech_window(self, n_frames: int, margin: int, rng: torch.Generator) -> Tensor:
        """Draw unpaired speech (S, n_frames + 2 margin) for a motion of a random step.

        Without a window, it is a whole clip of `n_frames`, and its margins are those of generation.
        A window that is longer than its clip continues with another one.
        """
        if self.own_lengths:
            clips = [clip for clip in self.unpaired if clip.shape[-1] == n_frames]
            return reflect(clips[int(torch.randint(len(clips), (), generator=rng))], margin)
        missing = n_frames + 2 * margin
        if not self.n_speech:
            return torch.zeros(0, missing)
        frames = torch.tensor([float(clip.shape[-1]) for clip in self.unpaired])
        parts = []
        while missing:
            clip = self.unpaired[int(torch.multinomial(frames, 1, generator=rng))]
            slack = max(0, clip.shape[-1] - missing)
            start = int(torch.randint(slack + 1, (), generator=rng))
            parts.append(clip[:, start : start + missing])
            missing -= parts[-1].shape[-1]
        return torch.cat(parts, dim=-1)
