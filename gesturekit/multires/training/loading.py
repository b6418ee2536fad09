"""Reading of a corpus into the training data of a multires run."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

import audio_features as af
from gesturekit.corpus.item import Item
from gesturekit.corpus.speech import SpeechConditioner
from gesturekit.errors import ConfigError, MotionError
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import find_parts
from gesturekit.multires.config import MultiresConfig
from gesturekit.multires.model import MultiresModel
from gesturekit.multires.motion_vector import MultiresRepresentation, Normaliser
from gesturekit.multires.retrieval.passive import PassiveChannels
from gesturekit.multires.training.data import TrainingData
from gesturekit.multires.training.sequences import PairedSequence
from gesturekit.multires.training.start import (
    check_styles,
    load_start,
    representation_on_bones_of,
)
from gesturekit.multires.training.stored import (
    CorpusData,
    MotionArrays,
    encoded,
    read_on_disk,
)
from gesturekit.training.data.features import SpeechArrays, extract_features
from gesturekit.training.recordings import Recordings, load_recordings

log = logging.getLogger(__name__)


def load_training_data(
    config: MultiresConfig, device: str = "cpu", *, trial: bool = False
) -> TrainingData:
    """Read the corpus of a run, or in a trial an excerpt of it; extract features on a device, and
    normalise.

    Raises:
        ConfigError: settings that the recordings do not allow, or a model in `start_from` with
            another rig, other settings or other conditions.
        ModelError: such a model cannot be read.
        CorpusError: no training item with what the mode needs, rigs that differ, or a file that
            cannot be read.
    """
    # Wrong extractor settings are reported before any file is read.
    extractor = None if config.features is None else config.features.extractor(device)
    start = load_start(config, extractor)
    recordings = _recordings(config, start, trial)
    motions = [motion.resample(config.fps) for motion in recordings.motions]
    representation = _representation(config, motions, start)
    vectors = _vectors(config, recordings, motions, representation)
    normaliser = _normaliser(config, vectors, representation, start)
    passive = PassiveChannels()
    if config.state:
        passive = PassiveChannels.find(motions, representation.joints)
    fitted = None if start is None else start.conditions.conditioner
    if recordings.excerpts is None:
        others = [passive.encode(motion) for motion in motions]
        read = _in_memory(config, recordings, vectors, others, normaliser, extractor, fitted)
    else:
        rig = recordings.rig(config, _parts(config, start))
        maker = MotionArrays(rig, representation, passive, config.fps, config.face_forward)
        del motions, vectors  # the sample is read again, from the arrays
        speech_maker = None
        if extractor is not None and config.features is not None:
            speech_maker = SpeechArrays(config.features, config.fps, device, extractor)
        read = read_on_disk(config, recordings, maker, normaliser, speech_maker, fitted)
    window = config.training.window
    frames = None if window is None else max(config.network.levels, round(window * config.fps))
    return TrainingData(
        paired=read.paired,
        unpaired=read.unpaired or tuple(sequence.speech for sequence in read.paired),
        silence=_silence(config, read, frames),
        window=frames,
        representation=representation,
        conditioner=read.conditioner,
        styles=recordings.styles,
        normaliser=normaliser,
        speakers=recordings.speakers,
        unpaired_is_paired=read.conditioner is not None and not read.unpaired,
        sources=recordings.sources(read.rates),
        recorded_fps=recordings.recorded_fps,
        passive=passive,
        start={} if start is None else start.network.state_dict(),
        spoken=(recordings.lengths[1], len(recordings.whole[1])),
        sampled=read.sampled,
        stored=read.stored,
    )


def _vectors(
    config: MultiresConfig,
    recordings: Recordings,
    motions: Sequence[Motion],
    representation: MultiresRepresentation,
) -> list[np.ndarray]:
    """Return the motion vectors (T, D) of each recording that was read."""
    return [
        encoded(representation, motion, config.face_forward, f"{config.corpus}: item {item.id}")
        for item, motion in zip(recordings.read, motions, strict=True)
    ]


def _in_memory(
    config: MultiresConfig,
    recordings: Recordings,
    vectors: Sequence[np.ndarray],
    passive: Sequence[Tensor],
    normaliser: Normaliser,
    extractor: af.Extractor | None,
    fitted: SpeechConditioner | None,
) -> CorpusData:
    """Return all recordings and unpaired speech in memory.

    Args:
        config: of the run.
        recordings: of the corpus.
        vectors: motion vectors (T, D) of each recording.
        passive: passive channels (X, T) of each.
        normaliser: of motion vectors.
        extractor: of speech features; None without speech input.
        fitted: conditioner of a model to start from; None to fit one.
    """
    items, lengths = recordings.items, list(map(len, vectors))
    conditioner, speeches, unpaired = _speech(
        config, items, lengths, recordings.unpaired, extractor, fitted
    )
    paired = [
        replace(sequence, passive=rows[:, : sequence.n_frames].contiguous())
        for sequence, rows in zip(
            _paired(config, items, vectors, speeches, recordings.style_of, normaliser),
            passive,
            strict=True,
        )
    ]
    return CorpusData(conditioner, tuple(paired), tuple(unpaired), recordings.rates)


def _silence(config: MultiresConfig, read: CorpusData, window: int | None) -> Tensor:
    """Return the features (S, T) of silence as long as the longest motion of a step.

    Args:
        config: of the run.
        read: its data.
        window: frames of a training window; None for whole sequences.
    """
    longest = max(_longest(config, read.paired), *(clip.shape[-1] for clip in read.unpaired), 0)
    n_frames = (window or longest) + 2 * config.random_margin
    if read.conditioner is None:
        return torch.empty(0, n_frames)
    return _transposed(read.conditioner.silence(n_frames))


def _parts(config: MultiresConfig, start: MultiresModel | None) -> dict[str, str]:
    """Return the body parts that are assigned by hand, with those of a model to start from."""
    return config.parts if start is None else {**start.skeleton.parts, **config.parts}


def _recordings(config: MultiresConfig, start: MultiresModel | None, trial: bool) -> Recordings:
    """Read the recordings; a model to start from gives its parts of the rig and its styles."""
    found = load_recordings(
        config,
        _parts(config, start),
        speech=config.features is not None,
        styles=config.styles is not None,
        check_styles=lambda styles: check_styles(start, config, styles),
        trial=trial,
    )
    if start is None:
        return found
    numbers = [start.styles.index(found.styles[i]) if found.styles else 0 for i in found.style_of]
    return replace(found, styles=start.styles, style_of=numbers)


def _normaliser(
    config: MultiresConfig,
    vectors: Sequence[np.ndarray],
    representation: MultiresRepresentation,
    start: MultiresModel | None,
) -> Normaliser:
    """Return the normaliser of a model to start from, or fit one if the run has one."""
    if start is not None:
        return start.normaliser
    if config.normalise:
        return Normaliser.fit(vectors, representation, config.fps)
    width = representation.n_features
    return Normaliser(torch.zeros(width), torch.ones(width))


def _paired(
    config: MultiresConfig,
    items: Sequence[Item],
    vectors: Sequence[np.ndarray],
    speeches: Sequence[Tensor],
    style_of: Sequence[int],
    normaliser: Normaliser,
) -> list[PairedSequence]:
    """Return the recordings as normalised sequences, cut to the shorter of motion and speech."""
    paired = []
    for item, vector, speech, style in zip(items, vectors, speeches, style_of, strict=True):
        n_frames = min(len(vector), speech.shape[-1])
        motion = normaliser.forward(torch.from_numpy(vector[:n_frames].T).float()[None])[0]
        sequence = PairedSequence.make(
            item.id,
            motion,
            speech[:, :n_frames].contiguous(),
            config.network.levels,
            config.seed,
            full_noise=config.z_star == "full",
        )
        about = replace(sequence, style=style, speaker=item.speaker, take=item.take)
        paired.append(about)
    return paired


def _representation(
    config: MultiresConfig, motions: Sequence[Motion], start: MultiresModel | None
) -> MultiresRepresentation:
    """Fit the motion representation; warn if speech has no upper body to modulate."""
    if start is not None:
        return representation_on_bones_of(start, config, motions)
    representation = MultiresRepresentation.fit(motions, config.joints, config.contact_threshold)
    if config.features is not None and config.network.modulate == "upper":
        try:
            find_parts(representation.skeleton)
        except MotionError as error:
            log.warning(
                "The upper body cannot be identified, so that speech modulates all joints, and the "
                "losses on arms are left out: %s",
                error,
            )
    return representation


def _speech(
    config: MultiresConfig,
    items: Sequence[Item],
    lengths: Sequence[int],
    others: Sequence[Item],
    extractor: af.Extractor | None,
    fitted: SpeechConditioner | None,
) -> tuple[SpeechConditioner | None, list[Tensor], list[Tensor]]:
    """Return the conditioner, and speech features (S, T) of paired items and of `others`, unpaired.

    `lengths` are the frames of the paired items' motion, `fitted` is the conditioner of a model to
    start from. Without an extractor: None, (0, T), none.
    """
    if extractor is None or config.features is None:
        return None, [torch.empty(0, n_frames) for n_frames in lengths], []
    conditioner, features = extract_features(
        [*items, *others],
        [*lengths, *[None] * len(others)],
        extractor,
        config.fps,
        config.features,
        fitted,
    )
    # Each array is released as soon as it is converted: features of a large corpus fill memory.
    features.reverse()
    tensors = [_transposed(features.pop()) for _ in range(len(features))]
    return conditioner, tensors[: len(items)], tensors[len(items) :]


def _longest(config: MultiresConfig, paired: Sequence[PairedSequence]) -> int:
    """Return the frames of the longest recording; raise ConfigError if that has too few."""
    longest = max(sequence.n_frames for sequence in paired)
    if af.level_lengths(longest, config.network.levels)[0] < 2:
        raise ConfigError(
            f"network.levels: {config.network.levels} levels leave one frame of the longest "
            f"recording ({longest / config.fps:.1f} s) at the coarsest; use fewer levels"
        )
    return longest


def _transposed(values: np.ndarray) -> Tensor:
    """Return (T, S) as a contiguous (S, T) tensor."""
    return torch.from_numpy(np.ascontiguousarray(values.T))
