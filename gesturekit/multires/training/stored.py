"""Recordings of a long corpus, whose motion and speech stay on disk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gesturekit.corpus.item import Item
from gesturekit.corpus.speech import SpeechConditioner
from gesturekit.errors import CorpusError
from gesturekit.motion.heading import heading
from gesturekit.motion.motion import Motion
from gesturekit.multires.config import MultiresConfig
from gesturekit.multires.motion_vector import MultiresRepresentation, Normaliser
from gesturekit.multires.retrieval.passive import PassiveChannels
from gesturekit.multires.training.sequences import Cut, PairedSequence, level_sigmas
from gesturekit.training.data.arrays import (
    ArrayFolder,
    Frames,
    Maker,
    StoredArray,
    StoredFrames,
    stored_arrays,
)
from gesturekit.training.data.features import (
    SpeechArrays,
    fit_conditioner,
    raw_speech,
    stored_speech,
)
from gesturekit.training.recordings import Recordings, Rig, systematic_sample


@dataclass(frozen=True)
class MotionArrays:
    """Makes arrays (T, D + X): motion vectors, not normalised, and passive channels.

    Attributes:
        rig: of the corpus.
        representation: of motion.
        passive: joints and face channels that are not modelled.
        fps: frames per second.
        face_forward: see `MultiresConfig.face_forward`.
    """

    rig: Rig
    representation: MultiresRepresentation
    passive: PassiveChannels
    fps: float
    face_forward: bool

    def origin(self, item: Item) -> dict[str, Any]:
        """Return all that the motion vectors of an item depend on."""
        known = self.representation
        return {
            **self.rig.origin(item),
            "joints": list(known.joints),
            "lengths": [known.scale, known.contact_speed],
            "passive": [list(self.passive.joints), self.passive.expressions],
            "settings": [self.fps, self.face_forward],
        }

    def make(self, item: Item) -> tuple[np.ndarray, dict[str, Any]]:
        """Encode the motion of an item."""
        recorded = self.rig.load(item)
        motion = recorded.resample(self.fps)
        vectors = encoded(self.representation, motion, self.face_forward, f"item {item.id}")
        passive = self.passive.encode(motion).numpy().T
        return np.concatenate([vectors, passive], axis=1), {"id": item.id, "fps": recorded.fps}


def encoded(
    representation: MultiresRepresentation, motion: Motion, face_forward: bool, name: str
) -> np.ndarray:
    """Return a recording as motion vectors (T, D), turned to its mean heading if `face_forward`.

    Raises:
        CorpusError: the motion cannot be encoded; the error begins with `name`.
    """
    try:
        return representation.encode(motion, turn=-heading(motion) if face_forward else 0.0)
    except ValueError as error:
        raise CorpusError(f"{name}: {error}") from None


Labels = tuple[str, int, str | None, str]
"""Name, number of the style, speaker and take of a sequence."""


@dataclass(frozen=True)
class StoredCorpus:
    """Names of the arrays of a corpus in their folder.

    Attributes:
        motion: of the recordings.
        speech: of the recordings; empty without speech input.
        unpaired: of speech without motion.
    """

    motion: Sequence[str]
    speech: Sequence[str]
    unpaired: Sequence[str]

    def sequences(
        self,
        config: MultiresConfig,
        labels: Sequence[Labels],
        normaliser: Normaliser,
        conditioner: SpeechConditioner | None,
        sigma: Tensor,
    ) -> tuple[tuple[PairedSequence, ...], tuple[StoredFrames, ...]]:
        """Return the recordings, and speech without motion (S, T); neither is read yet.

        Args:
            config: of the run.
            labels: of each recording.
            normaliser: of motion vectors.
            conditioner: of speech features; None without speech input.
            sigma: (L,) noise scales of all sequences.

        Raises:
            ConfigError: an array is missing or not whole.
        """
        folder = ArrayFolder(config.arrays_folder)
        motion = folder.find_all(self.motion)
        lengths = [array.shape[0] for array in motion]
        speech, alone = folder.find_all(self.speech), folder.find_all(self.unpaired)
        features, unpaired = [], []
        if conditioner is not None:
            features = stored_speech(speech, conditioner, lengths)
            unpaired = stored_speech(alone, conditioner)
        paired = []
        for i, (name, style, speaker, take) in enumerate(labels):
            n_frames = lengths[i]
            spoken: Frames = torch.empty(0, n_frames)
            if self.speech:
                n_frames = min(n_frames, features[i].shape[1])
                spoken = features[i].first(n_frames)
            vectors, passive = _motion(motion[i], n_frames, normaliser)
            made = PairedSequence.make(
                name,
                vectors,
                spoken,
                config.network.levels,
                config.seed,
                full_noise=config.z_star == "full",
                sigma=sigma,
            )
            about = replace(made, passive=passive, style=style, speaker=speaker, take=take)
            paired.append(about)
        return tuple(paired), tuple(unpaired)


@dataclass(frozen=True)
class CorpusData:
    """Recordings and speech of a corpus; most fields as in `TrainingData`.

    Attributes:
        rates: frame rate of each recording's file.
    """

    conditioner: SpeechConditioner | None
    paired: tuple[PairedSequence, ...]
    unpaired: tuple[Frames, ...]
    rates: Sequence[float]
    sampled: tuple[Cut, ...] | None = None
    stored: StoredCorpus | None = None


def read_on_disk(
    config: MultiresConfig,
    recordings: Recordings,
    maker: MotionArrays,
    normaliser: Normaliser,
    speech_maker: SpeechArrays | None,
    fitted: SpeechConditioner | None,
) -> CorpusData:
    """Return recordings and unpaired speech on disk; arrays that are missing are made.

    Args:
        config: of the run.
        recordings: items, and the sample that was read.
        maker: of the arrays of motion.
        normaliser: of motion vectors.
        speech_maker: of the arrays of speech; None without speech input.
        fitted: conditioner of a model to start from; None to fit one to the sample.
    """
    items, others = recordings.items, recordings.unpaired
    fps, levels = config.fps, config.network.levels
    wanted: list[tuple[Maker, Sequence[Item]]] = [(maker, items)]
    if speech_maker is not None:
        wanted += [(speech_maker, items), (speech_maker, others)]
    motion, *rest = stored_arrays(config.arrays_folder, wanted, config.workers)
    speech, alone = rest or ([], [])
    lengths = [array.shape[0] for array in motion]
    if speech:
        lengths = [min(n, array.shape[0]) for n, array in zip(lengths, speech, strict=True)]
    cuts = tuple(
        (excerpt.index, *excerpt.frames(fps, lengths[excerpt.index]))
        for excerpt in recordings.excerpts or ()
    )
    conditioner = fitted
    if conditioner is None and speech_maker is not None and config.features is not None:
        spoken = [(speech[i], start, stop) for i, start, stop in cuts]
        for excerpt in systematic_sample(others, 60 * config.in_memory):
            array = alone[excerpt.index]
            spoken.append((array, *excerpt.frames(fps, array.shape[0])))
        conditioner = fit_conditioner(
            [raw_speech(*part) for part in spoken], speech_maker.extractor, fps, config.features
        )
    sigmas = [
        level_sigmas(_motion(motion[i], lengths[i], normaliser)[0][:, start:stop][None], levels)
        for i, start, stop in cuts
    ]
    sigma = torch.stack(sigmas).mean(dim=0)
    stored = StoredCorpus(*([array.path.stem for array in own] for own in (motion, speech, alone)))
    labels = [
        (item.id, style, item.speaker, item.take)
        for item, style in zip(items, recordings.style_of, strict=True)
    ]
    paired, unpaired = stored.sequences(config, labels, normaliser, conditioner, sigma)
    rates = [array.facts["fps"] for array in motion]
    return CorpusData(conditioner, paired, unpaired, rates, cuts, stored)


def _motion(
    array: StoredArray, n_frames: int, normaliser: Normaliser
) -> tuple[StoredFrames, StoredFrames]:
    """Return normalised motion (D, n_frames) and passive channels (X, n_frames) of an array."""
    width = len(normaliser.mean)

    def motion(rows: np.ndarray) -> Tensor:
        return normaliser.forward(_channels(rows[:, :width])[None])[0]

    def passive(rows: np.ndarray) -> Tensor:
        return _channels(rows[:, width:])

    return (
        StoredFrames(array, (width, n_frames), motion),
        StoredFrames(array, (array.shape[1] - width, n_frames), passive),
    )


def _channels(rows: np.ndarray) -> Tensor:
    """Return (T, C) as a contiguous (C, T) tensor."""
    return torch.from_numpy(np.ascontiguousarray(rows.T))
