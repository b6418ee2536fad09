"""Reading of a corpus into the training data of a multires run, in memory or as arrays on disk."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

import audio_features as af
from gesturekit.corpus.item import Item
from gesturekit.corpus.speech import SpeechConditioner
from gesturekit.errors import ConfigError, CorpusError, MotionError
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import find_legs, find_parts, is_upper_body, unidentified
from gesturekit.motion.root_path import heading
from gesturekit.motion.skeleton import Skeleton
from gesturekit.multires.config import MultiresConfig
from gesturekit.multires.model import MultiresModel
from gesturekit.multires.motion_vector import MultiresRepresentation, Normaliser
from gesturekit.multires.retrieval import PassiveChannels
from gesturekit.multires.training.data import (
    Cut,
    Labels,
    PairedSequence,
    TrainingData,
    level_sigmas,
    paired_sequences,
    stored_motion,
    stored_sequences,
    transposed,
)
from gesturekit.multires.training.start import (
    check_styles,
    load_start,
    representation_on_bones_of,
)
from gesturekit.training.data.arrays import Frames, Maker, stored_arrays
from gesturekit.training.data.features import (
    SpeechArrays,
    extract_features,
    fit_conditioner,
    raw_speech,
)
from gesturekit.training.data.sources import describe_recordings
from gesturekit.training.recordings import Recordings, Rig, load_recordings, systematic_sample
from gesturekit.training.run_config import LEGLESS, UNIDENTIFIED
from gesturekit.wording import counted, roughly

log = logging.getLogger(__name__)


class _Corpus(NamedTuple):
    """Recordings and speech of a corpus, as in `TrainingData`, and the frame rates of its files."""

    conditioner: SpeechConditioner | None
    paired: tuple[PairedSequence, ...]
    unpaired: Sequence[Frames]
    rates: Sequence[float]
    sampled: tuple[Cut, ...] | None = None


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
    parts = config.parts if start is None else {**start.skeleton.parts, **config.parts}
    recordings = _recordings(config, start, parts, trial)
    motions = [motion.resample(config.fps) for motion in recordings.motions]
    representation = _representation(config, motions, start)
    vectors = [
        encoded(representation, motion, config.face_forward, f"{config.corpus}: item {item.id}")
        for item, motion in zip(recordings.read, motions, strict=True)
    ]
    normaliser = _normaliser(config, vectors, representation, start)
    passive = PassiveChannels()
    if config.state:
        passive = PassiveChannels.find(motions, representation.joints)
    fitted = None if start is None else start.conditions.conditioner
    if recordings.excerpts is None:
        passives = [passive.encode(motion) for motion in motions]
        corpus = _in_memory(config, recordings, vectors, passives, normaliser, extractor, fitted)
    else:
        rig = recordings.rig(config, parts)
        motion = MotionArrays(rig, representation, passive, config.fps, config.face_forward)
        makers: list[Maker] = [motion]
        if extractor is not None and config.features is not None:
            makers.append(SpeechArrays(config.features, config.fps, device, extractor))
        del motions, vectors  # the sample is read again, from the arrays
        corpus = _on_disk(config, recordings, makers, normaliser, extractor, fitted)
    return TrainingData(
        paired=corpus.paired,
        unpaired=tuple(corpus.unpaired) or tuple(sequence.speech for sequence in corpus.paired),
        silence=_silence(config, corpus),
        window=_window(config),
        representation=representation,
        conditioner=corpus.conditioner,
        styles=recordings.styles,
        normaliser=normaliser,
        speakers=recordings.speakers,
        sources=recordings.sources(corpus.rates),
        recorded_fps=recordings.recorded_fps,
        passive=passive,
        start={} if start is None else start.network.state_dict(),
        spoken=(recordings.lengths[1], len(recordings.whole[1])),
        sampled=corpus.sampled,
    )


def _recordings(
    config: MultiresConfig, start: MultiresModel | None, parts: dict[str, str], trial: bool
) -> Recordings:
    """Read the recordings; a model to start from has their styles, and maybe more."""
    recordings = load_recordings(
        config,
        parts,
        speech=config.features is not None,
        styles=config.styles is not None,
        check_styles=lambda styles: check_styles(start, config, styles),
        trial=trial,
    )
    if start is None:
        return recordings
    names = recordings.styles
    numbers = [start.styles.index(names[i]) if names else 0 for i in recordings.style_of]
    return replace(recordings, styles=start.styles, style_of=numbers)


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


def _labels(recordings: Recordings) -> list[Labels]:
    """Return the labels of each item."""
    return [
        (item.id, style, item.speaker, item.take)
        for item, style in zip(recordings.items, recordings.style_of, strict=True)
    ]


def _in_memory(
    config: MultiresConfig,
    recordings: Recordings,
    vectors: Sequence[np.ndarray],
    passives: Sequence[Tensor],
    normaliser: Normaliser,
    extractor: af.Extractor | None,
    fitted: SpeechConditioner | None,
) -> _Corpus:
    """Return all recordings and unpaired speech in memory.

    Args:
        config: of the run.
        recordings: of the corpus.
        vectors: motion vectors (T, D) of each recording.
        passives: passive channels (X, T) of each.
        normaliser: of motion vectors.
        extractor: of speech features; None without speech input.
        fitted: conditioner of a model to start from; None to fit one.
    """
    items, others = recordings.items, recordings.unpaired
    conditioner, unpaired = None, list[Tensor]()
    speeches = [torch.empty(0, len(vector)) for vector in vectors]
    if extractor is not None and config.features is not None:
        most = [*map(len, vectors), *[None] * len(others)]
        conditioner, features = extract_features(
            [*items, *others], most, extractor, config.fps, config.features, fitted
        )
        # Each array is released as soon as it is converted: features of a large corpus fill memory.
        features.reverse()
        tensors = [transposed(features.pop()) for _ in range(len(features))]
        speeches, unpaired = tensors[: len(items)], tensors[len(items) :]
    motions = [
        normaliser.forward(torch.from_numpy(vector[: speech.shape[1]].T).float()[None])[0]
        for vector, speech in zip(vectors, speeches, strict=True)
    ]
    paired = paired_sequences(config, _labels(recordings), motions, speeches, passives)
    return _Corpus(conditioner, paired, unpaired, recordings.rates)


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


def _on_disk(
    config: MultiresConfig,
    recordings: Recordings,
    makers: Sequence[Maker],
    normaliser: Normaliser,
    extractor: af.Extractor | None,
    fitted: SpeechConditioner | None,
) -> _Corpus:
    """Return recordings and unpaired speech on disk; arrays that are missing are made.

    Args:
        config: of the run.
        recordings: items, and the sample that was read.
        makers: of the arrays of motion, and of speech if it is an input.
        normaliser: of motion vectors.
        extractor: of speech features; None without speech input.
        fitted: conditioner of a model to start from; None to fit one to the sample.
    """
    items, others = recordings.items, recordings.unpaired
    wanted = [(maker, items) for maker in makers] + [(maker, others) for maker in makers[1:]]
    motion, *rest = stored_arrays(config.arrays_folder, wanted, config.workers)
    speech, alone = rest or ([], [])
    lengths = [array.shape[0] for array in motion]
    if speech:
        lengths = [min(n, array.shape[0]) for n, array in zip(lengths, speech, strict=True)]
    cuts = tuple(
        (excerpt.index, *excerpt.frames(config.fps, lengths[excerpt.index]))
        for excerpt in recordings.excerpts or ()
    )
    conditioner = fitted
    if conditioner is None and extractor is not None and config.features is not None:
        spoken = [(speech[i], start, stop) for i, start, stop in cuts]
        for excerpt in systematic_sample(others, 60 * config.in_memory):
            array = alone[excerpt.index]
            spoken.append((array, *excerpt.frames(config.fps, array.shape[0])))
        clips = [raw_speech(*excerpt) for excerpt in spoken]
        conditioner = fit_conditioner(clips, extractor, config.fps, config.features)
    sigmas = [
        level_sigmas(
            stored_motion(motion[i], normaliser)[0][:, start:stop][None], config.network.levels
        )
        for i, start, stop in cuts
    ]
    arrays = {"motion": motion, "speech": speech, "unpaired": alone}
    paired, unpaired = stored_sequences(
        config,
        {kind: [array.path.stem for array in made] for kind, made in arrays.items()},
        _labels(recordings),
        normaliser,
        conditioner,
        torch.stack(sigmas).mean(dim=0),
    )
    rates = [array.facts["fps"] for array in motion]
    return _Corpus(conditioner, paired, unpaired, rates, cuts)


def _window(config: MultiresConfig) -> int | None:
    """Return the frames of a training window; None for whole sequences."""
    window = config.training.window
    return None if window is None else max(config.network.levels, round(window * config.fps))


def _silence(config: MultiresConfig, corpus: _Corpus) -> Tensor:
    """Return the features (S, T) of silence as long as the longest motion of a step.

    Raises:
        ConfigError: the longest recording has too few frames.
    """
    longest = max(sequence.n_frames for sequence in corpus.paired)
    if af.level_lengths(longest, config.network.levels)[0] < 2:
        raise ConfigError(
            f"network.levels: {config.network.levels} levels leave one frame of the longest "
            f"recording ({longest / config.fps:.1f} s) at the coarsest; use fewer levels"
        )
    longest = max(longest, *(clip.shape[-1] for clip in corpus.unpaired), 0)
    n_frames = (_window(config) or longest) + 2 * config.random_margin
    if corpus.conditioner is None:
        return torch.empty(0, n_frames)
    return transposed(corpus.conditioner.silence(n_frames))


def adapted(config: MultiresConfig, skeleton: Skeleton, *, quiet: bool) -> MultiresConfig:
    """Return the settings without losses on body parts that the rig lacks; log them."""
    missing = unidentified(skeleton)
    if is_upper_body(skeleton):
        if not quiet:
            log.info(LEGLESS)
        return replace(config, losses=replace(config.losses, contact=0.0))
    if not missing:
        return config
    losses = replace(config.losses, arm_speed=0.0, arm_acceleration=0.0)
    follows = []
    if config.uses_arm_speed:
        follows.append("no losses on the arms")
    if find_legs(skeleton) is None:
        losses = replace(losses, contact=0.0)
        follows += ["no contact labels or loss", "recordings keep their heading"]
    if config.joints == "body":
        follows.append("all joints are modelled")
    if follows and not quiet:
        log.info(UNIDENTIFIED, missing.capitalize(), ", ".join(follows))
    return replace(config, losses=losses)


def warn_of_speech(config: MultiresConfig, data: TrainingData) -> None:
    """Warn of a corpus without unpaired speech, and of clips that are shorter at level 1 than the
    patches of the discriminator."""
    if data.unpaired_is_paired:
        log.warning("The corpus has no unpaired speech: random steps take the paired speech.")
    levels, least = config.network.levels, config.network.n_frames_of_patch
    lengths = [clip.shape[-1] for clip in data.unpaired]
    short = [n for n in lengths if af.level_lengths(n, levels)[0] < least]
    if data.own_lengths and short:
        log.warning(
            "%d of %d clips of unpaired speech have fewer than the %d frames of a discriminator's "
            "patch at level 1, which sees them reflected: of %d levels, clips of %.1f s or more "
            "have enough.",
            *(len(short), len(lengths), least, levels),
            math.ceil((least - 0.5) * (4 / 3) ** (levels - 1)) / config.fps,
        )


def described(config: MultiresConfig, data: TrainingData) -> tuple[list[str], list[str]]:
    """Return the kind of a model in words, and descriptions of its training data."""
    inputs = ["speech"] * bool(data.conditioner) + ["labels"] * bool(data.styles)
    mode = f"{' and '.join(inputs)} mode" if inputs else "no condition"
    contents = [describe_recordings(data.sources, data.seconds, config.fps)]
    if data.conditioner is not None:
        if not data.unpaired_is_paired:
            contents.append(f"{roughly(data.spoken[0])} of unpaired speech")
        contents.append(counted(data.conditioner.dim, "speech feature"))
    if data.styles:
        contents.append(counted(len(data.styles), "style"))
    joints = counted(data.representation.skeleton.n_joints, "joint")
    contents.append(f"{len(data.representation.joints)} of {joints} modelled")
    return ["multires", mode, f"{config.network.levels} levels"], contents
