"""Loading of training data from a corpus: motion, features, paths, events and styles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from gesturekit.corpus.item import Item
from gesturekit.corpus.speech import SpeechConditioner
from gesturekit.diffusion.conditions import Conditions
from gesturekit.diffusion.config import DiffusionConfig
from gesturekit.diffusion.model import DiffusionModel
from gesturekit.diffusion.motion_vector import DeltaRepresentation, Normaliser, measured_state
from gesturekit.diffusion.training.data import (
    ArrayInMemory,
    Cut,
    StoredCorpus,
    TrainingData,
    TrainingSequence,
    VariantArray,
    motion_of,
    sequences_of,
    variants_of,
    with_state,
)
from gesturekit.diffusion.training.recordings import (
    Corpus,
    Recording,
    VariantArrays,
    phase_item,
    read_corpus,
)
from gesturekit.errors import ConfigError
from gesturekit.motion.motion import Motion
from gesturekit.state.channels import StateChannels
from gesturekit.state.process import RecordedState, StateProcess
from gesturekit.training.config import to_dict
from gesturekit.training.data.arrays import Frames, Maker, StoredArray, stored_arrays
from gesturekit.training.data.excerpts import Excerpt, systematic_sample
from gesturekit.training.data.features import (
    SpeechArrays,
    extract_features,
    feature_values,
    fit_conditioner,
    raw_speech,
)
from gesturekit.training.data.start_model import (
    check_conditions,
    check_rig,
    check_settings,
    model_of,
)

_STEP_FLOORS = np.array([0.03, 0.015, 0.015])
"""Least scale of turn, forward and lateral displacement: radians and metres per second."""


@dataclass(frozen=True, eq=False)
class _Read:
    """Recordings and conditions of a run.

    `clips` are those to which the state of movement is fitted; other fields as in `TrainingData`.
    """

    recordings: tuple[TrainingSequence, ...]
    conditions: Conditions
    seconds: tuple[float, float]
    rates: Sequence[float]
    clips: Sequence[tuple[Item, Cut]]
    sampled: tuple[Cut, ...] | None = None
    stored: StoredCorpus | None = None


def load_training_data(
    config: DiffusionConfig, device: str = "cpu", *, trial: bool = False
) -> TrainingData:
    """Read the corpus of a run, or in a trial an excerpt of it; extract features on a device, and
    normalise.

    Raises:
        CorpusError: no training item with what the run needs, rigs that differ, or a file that
            cannot be read.
        ConfigError: a model in `start_from` with other conditions, or one in `start_from` or
            `moves_like` with another rig.
        ModelError: such a model cannot be read.
    """
    # First, so that wrong settings fail before anything is read.
    speech = None
    if config.features is not None:
        speech = SpeechArrays.open(config.features, config.fps, device)
    like = _known_model(config)
    start = None if config.start_from is None else like
    corpus = read_corpus(config, speech=speech is not None, trial=trial)
    conditions = _conditions(config, corpus, speech, start)
    motions = [motion for _, motion in corpus.phases]
    if like is None:
        representation = DeltaRepresentation.fit(motions, config.joints, root=not config.path)
    else:
        representation = _same_rig(like, motions, config)
    rig = corpus.recordings.rig(config, config.parts)
    paired = VariantArrays(config, rig, representation, replace(conditions, conditioner=None))
    read_all = _in_memory if corpus.recordings.excerpts is None else _on_disk
    read = read_all(corpus, paired, conditions, speech, start is None)
    if like is None:
        motion = motion_of(read.recordings, read.sampled)
        normaliser = Normaliser.fit(motion, _floors(representation, config.fps))
    else:
        normaliser = like.normaliser
    recordings, conditions, process = read.recordings, read.conditions, None
    if config.state:
        process = _fit_state(recordings, read.clips, conditions, representation, config.fps)
        recordings = tuple(with_state(r, process, representation) for r in recordings)
        conditions = replace(conditions, state=process.channels)
    return TrainingData(
        recordings=recordings,
        seconds=corpus.recordings.lengths if trial else read.seconds,
        representation=representation,
        conditions=conditions,
        normaliser=normaliser,
        state_process=process,
        speakers=corpus.recordings.speakers,
        sources=corpus.recordings.sources(read.rates),
        recorded_fps=corpus.recordings.recorded_fps,
        start={} if start is None else start.network.state_dict(),
        sampled=read.sampled,
        stored=read.stored,
    )


def _known_model(config: DiffusionConfig) -> DiffusionModel | None:
    """Load the model of `start_from` or `moves_like`, whose motion vectors this run uses."""
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


def _same_rig(
    like: DiffusionModel, motions: Sequence[Motion], config: DiffusionConfig
) -> DeltaRepresentation:
    """Return the representation of a model, checked against the rig of the corpus.

    A model to start from gets the bones and body shape of the corpus. With `moves_like` they stay,
    because motion vectors of experts must have the same unit of length.
    """
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
        wanted["features"] = feature_values(speech.extractor, speech.settings)
    check_conditions(config.start_from, start.conditions.to_values(), wanted)
    if start.state_process is not None and not config.state:
        raise ConfigError(f"start_from: {config.start_from} has state: true, this run none")
    return replace(start.conditions, state=None)


def _in_memory(
    corpus: Corpus,
    paired: VariantArrays,
    conditions: Conditions,
    speech: SpeechArrays | None,
    fits: bool,
) -> _Read:
    """Return all recordings and their variants in memory.

    Args:
        corpus: of the run, read whole.
        paired: encodes its recordings.
        conditions: see `_conditions`.
        speech: extracts features; None without speech input.
        fits: whether conditions are fitted to the recordings.
    """
    alone = replace(paired, rig=corpus.unpaired_rig)
    unpaired = [alone.load(item) for item in corpus.recordings.unpaired]
    conditions, paired, alone = _fit_path(corpus, unpaired, conditions, paired, alone, fits)
    features: list[Frames] = []
    if speech is not None:
        conditioner, extracted = extract_features(
            [item for item, _ in corpus.phases],
            [motion.n_frames for _, motion in corpus.phases],
            speech.extractor,
            speech.fps,
            speech.settings,
            conditions.conditioner,
        )
        conditions = replace(conditions, conditioner=conditioner)
        features = [torch.from_numpy(values.T) for values in extracted]
    motion = [ArrayInMemory(*paired.encode(recording)) for recording in corpus.read]
    others = [ArrayInMemory(*alone.encode(recording)) for recording in unpaired]
    width = paired.representation.n_features
    variants = variants_of([*motion, *others])
    recordings = sequences_of(variants, features, conditions, width, len(motion))
    recordings = tuple(recording.in_memory() for recording in recordings)
    clips = [(item, (i, 0, len(recordings[i].motion))) for i, (item, _) in enumerate(corpus.phases)]
    return _Read(
        recordings,
        conditions,
        _seconds(motion, others),
        [array.facts["fps"] for array in motion],
        clips,
    )


def _on_disk(
    corpus: Corpus,
    paired: VariantArrays,
    conditions: Conditions,
    speech: SpeechArrays | None,
    fits: bool,
) -> _Read:
    """Return all recordings and their variants on disk; arrays that are missing are made.

    Conditions are fitted to a sample; see `_in_memory` for the arguments.
    """
    config, items = paired.config, corpus.recordings.items
    others = corpus.recordings.unpaired
    alone = replace(paired, rig=corpus.unpaired_rig)
    excerpts = systematic_sample(others, 60 * config.in_memory)
    unpaired = []
    if fits and config.path:
        unpaired = [alone.load(excerpt.of(others)) for excerpt in excerpts]
    conditions, paired, alone = _fit_path(corpus, unpaired, conditions, paired, alone, fits)
    wanted: list[tuple[Maker, Sequence[Item]]] = [(paired, items), (alone, others)]
    motion, motion_alone = stored_arrays(config.arrays_folder, wanted, config.workers)
    spoken: list[StoredArray] = []
    sample: dict[int, list[Excerpt]] = {}
    for excerpt in corpus.recordings.excerpts or ():
        sample.setdefault(excerpt.index, []).append(excerpt)
    if speech is not None:
        pieces = [
            phase_item(item, number, start)
            for item, array in zip(items, motion, strict=True)
            for number, start in enumerate(array.facts["starts"])
        ]
        (spoken,) = stored_arrays(config.arrays_folder, [(speech, pieces)], config.workers)
        if conditions.conditioner is None:
            conditioner = _fit_conditioner(speech, motion, spoken, sample)
            conditions = replace(conditions, conditioner=conditioner)
    for excerpt in excerpts:
        sample.setdefault(len(items) + excerpt.index, []).append(excerpt)
    stored = StoredCorpus(
        *([array.path.stem for array in arrays] for arrays in (motion, spoken, motion_alone))
    )
    recordings = stored.sequences(config, conditions, paired.representation.n_features)
    variants = variants_of([*motion, *motion_alone])
    sampled = tuple(
        (i, *excerpt.frames(config.fps, recordings[i].n_frames))
        for i, variant in enumerate(variants)
        # The other phases of an excerpt are almost the same motion.
        for excerpt in sample.get(variant.which, ()) * (variant.phase == 0)
    )
    clips = [
        (items[variants[cut[0]].which], cut)
        for cut in sampled
        if not variants[cut[0]].mirrored and variants[cut[0]].which < len(items)
    ]
    seconds = _seconds(motion, motion_alone)
    return _Read(
        recordings,
        conditions,
        seconds,
        [array.facts["fps"] for array in motion],
        clips,
        sampled,
        stored,
    )


def _fit_path(
    corpus: Corpus,
    unpaired: Sequence[Recording],
    conditions: Conditions,
    paired: VariantArrays,
    alone: VariantArrays,
    fits: bool,
) -> tuple[Conditions, VariantArrays, VariantArrays]:
    """Fit mean and scale of the paths' displacements; return conditions and makers with them.

    Args:
        corpus: with the recordings that were read.
        unpaired: those without speech that were read.
        conditions: see `_conditions`.
        paired: encodes the recordings of the corpus.
        alone: encodes unpaired motion.
        fits: whether conditions are fitted.
    """
    if fits and paired.config.path:
        read = ((paired, corpus.read), (alone, unpaired))
        size = 1 / paired.representation.scale
        deltas = np.concatenate(
            [
                maker.path(*phase).scaled(size).deltas()
                for maker, recordings in read
                for recording in recordings
                for phase in recording.phases
            ]
        )
        scale = np.maximum(deltas.std(axis=0), _STEP_FLOORS / paired.config.fps)
        conditions = replace(conditions, path_mean=deltas.mean(axis=0), path_scale=scale)
    without_speech = replace(conditions, conditioner=None)
    makers = (replace(maker, conditions=without_speech) for maker in (paired, alone))
    return conditions, *makers


def _seconds(
    paired: Sequence[VariantArray], unpaired: Sequence[VariantArray]
) -> tuple[float, float]:
    """Return the total length of the paired and the unpaired recordings."""
    first, second = (
        sum(array.facts["seconds"] for array in arrays) for arrays in (paired, unpaired)
    )
    return first, second


def _fit_conditioner(
    speech: SpeechArrays,
    motion: Sequence[StoredArray],
    spoken: Sequence[StoredArray],
    sample: Mapping[int, Sequence[Excerpt]],
) -> SpeechConditioner:
    """Return a conditioner that is fitted to the excerpts of each recording.

    Args:
        speech: made `spoken`.
        motion: arrays of the recordings.
        spoken: arrays of the speech of their phases.
        sample: excerpts of a recording, by its index.
    """
    clips, arrays = [], iter(spoken)
    for i, array in enumerate(motion):
        lengths = array.facts["lengths"]
        first = [next(arrays) for _ in lengths][0]
        for excerpt in sample.get(i, ()):
            frames = excerpt.frames(speech.fps, min(first.shape[0], lengths[0]))
            clips.append(raw_speech(first, *frames))
    return fit_conditioner(clips, speech.extractor, speech.fps, speech.settings)


def _fit_state(
    recordings: Sequence[TrainingSequence],
    clips: Sequence[tuple[Item, Cut]],
    conditions: Conditions,
    representation: DeltaRepresentation,
    fps: float,
) -> StateProcess:
    """Return the process of the state of movement in parts of recordings.

    The conditions of the recordings have no state yet.

    Args:
        recordings: and their variants.
        clips: the parts, with the items they are of.
        conditions: their layout.
        representation: of their motion vectors.
        fps: frames per second.
    """
    channels = StateChannels.find(representation.skeleton, representation.joints)
    recorded = []
    for item, (i, start, stop) in clips:
        values = measured_state(recordings[i].motion[start:stop], representation, channels, fps)
        speech = recordings[i].condition[start:stop][:, conditions.columns["speech"]]
        style = conditions.styles.index(item.style or "") if conditions.styles else None
        recorded.append(RecordedState(values, speech.T, item.take, (item.speaker, style)))
    return StateProcess.fit(channels, recorded, fps, conditions.conditioner)


def _floors(representation: DeltaRepresentation, fps: float) -> np.ndarray:
    """Return the least scale (X,) of each number of a motion vector."""
    values = np.full(representation.n_features, 0.01)  # radians
    values[representation.height_column] = 2e-3  # metres of the reference body
    if representation.makes_root:
        values[representation.root_columns] = _STEP_FLOORS / fps
    return values
