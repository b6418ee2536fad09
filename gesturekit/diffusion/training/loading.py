"""Loading of training data from a corpus: motion, features, paths, events and styles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gesturekit.corpus.speech import SpeechConditioner
from gesturekit.diffusion.conditions import Conditions
from gesturekit.diffusion.config import DiffusionConfig
from gesturekit.diffusion.model import DiffusionModel
from gesturekit.diffusion.motion_vector import DeltaRepresentation, Normaliser, measured_state
from gesturekit.diffusion.training.data import (
    Cut,
    TrainingData,
    TrainingSequence,
    motion_of,
    sequences_of,
    with_state,
)
from gesturekit.diffusion.training.recordings import (
    Corpus,
    VariantArrays,
    phase_item,
    read_corpus,
)
from gesturekit.errors import ConfigError
from gesturekit.state.channels import StateChannels
from gesturekit.state.process import RecordedState, StateProcess
from gesturekit.training.arrays import Array, ArrayInMemory, StoredFrames, names_of, stored_arrays
from gesturekit.training.config import to_dict
from gesturekit.training.features import SpeechArrays, feature_values, speech_frames
from gesturekit.training.origin import (
    check_conditions,
    check_rig,
    check_settings,
    model_of,
)
from gesturekit.training.recordings import Excerpt

_STEP_FLOORS = np.array([0.03, 0.015, 0.015])
"""Least scale of turn, forward and lateral displacement: radians and metres per second."""


def load_training_data(
    config: DiffusionConfig, device: str = "cpu", *, trial: bool = False
) -> TrainingData:
    """Read the corpus of a run, or in a trial an excerpt of it; extract features on a device, and
    normalise. The data of a long corpus stay on disk, and statistics are those of a sample.

    Raises:
        CorpusError: no training item with what the run needs, rigs that differ, or a file that
            cannot be read.
        ConfigError, ModelError: see `_known_model`.
    """
    # First, so that wrong settings fail before anything is read.
    features, fps = config.features, config.fps
    speech = None if features is None else SpeechArrays.open(features, fps, device)
    like = _known_model(config)
    start = None if config.start_from is None else like
    corpus = read_corpus(config, trial=trial)
    conditions = _conditions(config, corpus, speech, start)
    representation = _representation(config, corpus, like)
    conditions, *makers = _makers(config, corpus, conditions, representation)
    motion, unpaired = _encoded(corpus, *makers)
    conditioner, spoken = _speech(config, corpus, motion, speech, conditions.conditioner)
    conditions, frames = replace(conditions, conditioner=conditioner), list[StoredFrames]()
    if conditioner is not None:
        lengths = [n_frames for array in motion for n_frames in array.facts["lengths"]]
        frames = speech_frames(spoken, conditioner, lengths)
    width, arrays = representation.n_features, [*motion, *unpaired]
    recordings = sequences_of(arrays, frames, conditions, width, len(motion))
    sampled = stored = None
    if corpus.is_in_memory:
        recordings = tuple(recording.in_memory() for recording in recordings)
    else:
        sampled = _sampled(corpus, recordings, fps)
        kinds = {"motion": motion, "speech": spoken, "unpaired": unpaired}
        stored = {kind: names_of(arrays) for kind, arrays in kinds.items()}
    normaliser = _normaliser(like, representation, motion_of(recordings, sampled), fps)
    process = None
    if config.state:
        process = _fit_state(config, corpus, recordings, sampled, conditions, representation)
        recordings = tuple(with_state(r, process, representation) for r in recordings)
        conditions = replace(conditions, state=process.channels)
    seconds = [sum((a.facts["seconds"] for a in m), 0.0) for m in (motion, unpaired)]
    seconds = [*corpus.recordings.lengths] if trial else seconds
    return TrainingData(
        recordings=recordings,
        seconds=seconds[0],
        unpaired_seconds=seconds[1],
        representation=representation,
        conditions=conditions,
        normaliser=normaliser,
        state_process=process,
        speakers=corpus.recordings.speakers,
        sources=corpus.recordings.sources([array.facts["fps"] for array in motion]),
        recorded_fps=corpus.recordings.recorded_fps,
        start={} if start is None else start.network.state_dict(),
        sampled=sampled,
        stored=stored,
    )


def _known_model(config: DiffusionConfig) -> DiffusionModel | None:
    """Load the model of `start_from` or `moves_like`, whose motion vectors this run uses.

    Raises:
        ConfigError: its settings differ from those of the run.
        ModelError: it cannot be read.
    """
    setting = "moves_like" if config.start_from is None else "start_from"
    if (folder := getattr(config, setting)) is None:
        return None
    weights = None if config.features is None else config.features.encoder_places
    model = DiffusionModel.load(model_of(folder), weights=weights)
    check_settings(setting, folder, {"fps": model.fps}, {"fps": config.fps})
    if setting == "start_from":
        for name, known in (("network", model.network.config), ("noise", model.noise_config)):
            values = {f"{name}.{k}": v for k, v in to_dict(known).items() if k != "dropout"}
            wanted = {f"{name}.{k}": v for k, v in to_dict(getattr(config, name)).items()}
            check_settings(setting, folder, values, wanted)
    elif model.representation.makes_root == config.path:
        follows = "follows a path" if config.path else "moves its root itself"
        raise ConfigError(f"moves_like: this run {follows} and {folder} does not")
    return model


def _representation(
    config: DiffusionConfig, corpus: Corpus, like: DiffusionModel | None
) -> DeltaRepresentation:
    """Return the representation of a model, checked against the rig of the corpus, or a new one.

    A model to start from gets the bones and body shape of the corpus. With `moves_like` they stay,
    because motion vectors of experts must have the same unit of length.
    """
    motions = [motion for _, motion in corpus.phases]
    if like is None:
        return DeltaRepresentation.fit(motions, config.joints, root=not config.path)
    setting = "moves_like" if config.start_from is None else "start_from"
    where = getattr(config, setting)
    check_rig(setting, where, like.skeleton, motions[0].skeleton, config.corpus)
    known = like.representation
    return known if setting == "moves_like" else known.on_bones_of(motions)


def _conditions(
    config: DiffusionConfig,
    corpus: Corpus,
    speech: SpeechArrays | None,
    start: DiffusionModel | None,
) -> Conditions:
    """Return the conditions of the model to start from, or new ones that nothing is fitted to."""
    new = Conditions(None, config.path, corpus.events, corpus.recordings.styles)
    if start is None or config.start_from is None:
        return new
    wanted = new.to_values()
    if speech is not None:
        wanted["features"] = feature_values(speech)
    check_conditions(config.start_from, start.conditions.to_values(), wanted)
    if start.state_process is not None and not config.state:
        raise ConfigError(f"start_from: {config.start_from} has state: true, this run none")
    return replace(start.conditions, state=None)


def _makers(
    config: DiffusionConfig,
    corpus: Corpus,
    conditions: Conditions,
    representation: DeltaRepresentation,
) -> tuple[Conditions, VariantArrays, VariantArrays]:
    """Return the conditions, and what encodes paired and unpaired recordings.

    Unless a model to start from has them, mean and scale of the paths' displacements are fitted to
    the recordings that were read.
    """
    rig = corpus.recordings.rig(config, config.parts)
    paired = VariantArrays(config, rig, representation, conditions)
    alone = replace(paired, rig=corpus.unpaired_rig)
    if config.path and config.start_from is None:
        deltas = np.concatenate(
            [
                maker.path(*phase).scaled(1 / representation.scale).deltas()
                for maker, recordings in ((paired, corpus.read), (alone, corpus.unpaired))
                for recording in recordings
                for phase in recording.phases
            ]
        )
        scale = np.maximum(deltas.std(axis=0), _STEP_FLOORS / config.fps)
        conditions = replace(conditions, path_mean=deltas.mean(axis=0), path_scale=scale)
    without_speech = replace(conditions, conditioner=None)
    paired, alone = (replace(maker, conditions=without_speech) for maker in (paired, alone))
    return conditions, paired, alone


def _encoded(
    corpus: Corpus, paired: VariantArrays, alone: VariantArrays
) -> Sequence[Sequence[Array]]:
    """Return arrays of the recordings and of unpaired motion; on disk, missing ones are made."""
    if corpus.is_in_memory:
        both = (paired, corpus.read), (alone, corpus.unpaired)
        return [[ArrayInMemory(*maker.encode(r)) for r in recordings] for maker, recordings in both]
    wanted = [(paired, corpus.recordings.items), (alone, corpus.recordings.unpaired)]
    return stored_arrays(paired.config.arrays_folder, wanted, paired.config.workers)


def _speech(
    config: DiffusionConfig,
    corpus: Corpus,
    motion: Sequence[Array],
    speech: SpeechArrays | None,
    known: SpeechConditioner | None,
) -> tuple[SpeechConditioner | None, Sequence[Array]]:
    """Return a conditioner, and the arrays of the speech of each phase.

    Args:
        config: of the run.
        corpus: of the run.
        motion: arrays of its recordings.
        speech: extracts features; None for a model without speech input.
        known: see `SpeechArrays.fit`.
    """
    if speech is None:
        return None, []
    phases = [
        phase_item(item, number, start)
        for item, array in zip(corpus.recordings.items, motion, strict=True)
        for number, start in enumerate(array.facts["starts"])
    ]
    if corpus.is_in_memory:
        held = speech.in_memory(phases)
        return speech.fit([(array, 0, array.shape[0]) for array in held], known), held
    (spoken,) = stored_arrays(config.arrays_folder, [(speech, phases)], config.workers)
    counts = [len(array.facts["lengths"]) for array in motion]
    clips = []
    for excerpt in corpus.recordings.excerpts or ():
        first = spoken[sum(counts[: excerpt.index])]
        n_frames = min(first.shape[0], motion[excerpt.index].facts["lengths"][0])
        clips.append((first, *excerpt.frames(speech.fps, n_frames)))
    return speech.fit(clips, known), spoken


def _sampled(corpus: Corpus, recordings: Sequence[TrainingSequence], fps: float) -> tuple[Cut, ...]:
    """Return the parts of recordings on disk from which statistics are computed."""
    sample: dict[int, list[Excerpt]] = {}
    for excerpt in corpus.recordings.excerpts or ():
        sample.setdefault(excerpt.index, []).append(excerpt)
    for excerpt in corpus.unpaired_excerpts:
        sample.setdefault(len(corpus.recordings.items) + excerpt.index, []).append(excerpt)
    return tuple(
        (i, *excerpt.frames(fps, recording.n_frames))
        for i, recording in enumerate(recordings)
        # The other phases of an excerpt are almost the same motion.
        for excerpt in sample.get(recording.recording, ()) * (recording.phase == 0)
    )


def _fit_state(
    config: DiffusionConfig,
    corpus: Corpus,
    recordings: Sequence[TrainingSequence],
    sampled: Sequence[Cut] | None,
    conditions: Conditions,
    representation: DeltaRepresentation,
) -> StateProcess:
    """Return the process of the state of movement in paired recordings, or in a sample of them.

    Mirrored copies are left out. The conditions of the recordings have no state yet.
    """
    items, fps = corpus.recordings.items, config.fps
    channels = StateChannels.find(representation.skeleton, representation.joints)
    recorded = []
    for i, start, stop in sampled or [(i, 0, r.n_frames) for i, r in enumerate(recordings)]:
        sequence = recordings[i]
        if sequence.mirrored or not sequence.is_paired:
            continue
        item = items[sequence.recording]
        values = measured_state(sequence.motion[start:stop], representation, channels, fps)
        speech = sequence.condition[start:stop][:, conditions.columns["speech"]]
        style = conditions.styles.index(item.style or "") if conditions.styles else None
        recorded.append(RecordedState(values, speech.T, item.take, (item.speaker, style)))
    return StateProcess.fit(channels, recorded, fps, conditions.conditioner)


def _normaliser(
    like: DiffusionModel | None,
    representation: DeltaRepresentation,
    motion: Sequence[np.ndarray],
    fps: float,
) -> Normaliser:
    """Return mean and scale of a model, or of motion vectors (T, X) with a least scale."""
    if like is not None:
        return like.normaliser
    floors = np.full(representation.n_features, 0.01)  # radians
    floors[representation.height_column] = 2e-3  # metres of the reference body
    if representation.makes_root:
        floors[representation.root_columns] = _STEP_FLOORS / fps
    return Normaliser.fit(motion, floors)
