"""Loading of training data from a corpus: motion, features, paths, events and styles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gesturekit.corpus.item import Item
from gesturekit.corpus.speech import SpeechConditioner
from gesturekit.diffusion.conditions import Conditions
from gesturekit.diffusion.config import DiffusionConfig
from gesturekit.diffusion.model import DiffusionModel
from gesturekit.diffusion.motion_vector import DeltaRepresentation, Normaliser
from gesturekit.diffusion.training.augmentation import phase_item
from gesturekit.diffusion.training.corpus import Corpus, phases_of, read_corpus
from gesturekit.diffusion.training.data import (
    Cut,
    StoredCorpus,
    TrainingData,
    TrainingSequence,
    motion_of,
    stored_variants,
    with_state,
)
from gesturekit.diffusion.training.state import fit_state
from gesturekit.diffusion.training.variants import VariantArrays
from gesturekit.errors import ConfigError
from gesturekit.motion.motion import Motion
from gesturekit.motion.root_path import RootPath
from gesturekit.training.config import to_dict
from gesturekit.training.data.arrays import Maker, StoredArray, stored_arrays
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
from gesturekit.training.recordings import Excerpt, systematic_sample

_STEP_FLOORS = np.array([0.03, 0.015, 0.015])
"""Least scale of turn, forward and lateral displacement: radians and metres per second."""


@dataclass(frozen=True, eq=False)
class _Read:
    """Recordings and conditions of a run.

    `parts` are those to which the state of movement is fitted; other fields as in `TrainingData`.
    """

    recordings: tuple[TrainingSequence, ...]
    conditions: Conditions
    seconds: tuple[float, float]
    rates: Sequence[float]
    parts: Sequence[tuple[Item, Cut]]
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
    start = _start(config)
    like = _like(config) if start is None else start
    corpus = read_corpus(config, speech=speech is not None, trial=trial)
    conditions = _conditions(config, corpus, speech, start)
    if like is None:
        motions = corpus.motions
        representation = DeltaRepresentation.fit(motions, config.joints, root=not config.path)
    else:
        representation = _same_rig(like, corpus.motions, config)
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
        process = fit_state(recordings, read.parts, conditions, representation, config.fps)
        recordings = tuple(with_state(own, process, representation) for own in recordings)
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
    if speech is not None and config.features is not None:
        wanted["features"] = feature_values(speech.extractor, config.features)
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
    config, n_paired = paired.config, len(corpus.items)
    takes = [paired.take(*one) for one in zip(corpus.items, corpus.motions, strict=True)]
    alone, unpaired_seconds = replace(paired, rig=corpus.unpaired_rig), 0.0
    for item in corpus.unpaired:
        motion = alone.rig.load(item)
        unpaired_seconds += motion.duration
        takes += [alone.take(*phase) for phase in phases_of(item, motion, config.fps)]
    if fits and config.path:
        conditions = _with_path_scale(conditions, [take.path for take in takes], paired)
    speeches: list[np.ndarray | None] = [None] * len(takes)
    if speech is not None and config.features is not None:
        lengths = [motion.n_frames for motion in corpus.motions]
        conditioner, speeches[:n_paired] = extract_features(
            corpus.items,
            lengths,
            speech.extractor,
            config.fps,
            config.features,
            conditions.conditioner,
        )
        conditions = replace(conditions, conditioner=conditioner)
    own = replace(conditions, conditioner=None)
    makers = [replace(paired, conditions=own)] * n_paired
    makers += [replace(alone, conditions=own)] * (len(takes) - n_paired)
    n_speech = conditions.columns["speech"].stop
    plain, mirrored = [], []
    for maker, take, features in zip(makers, takes, speeches, strict=True):
        rows = maker.rows(take)
        if features is None:
            features = np.zeros((len(rows), n_speech), np.float32)
        plain.append(maker.sequence(take.name, rows, features))
        if maker.is_mirrored(take.style):
            rows = maker.mirrored_rows(take, rows)
            mirrored.append(maker.sequence(f"{take.name} (mirrored)", rows, features))
    seconds = corpus.seconds, unpaired_seconds
    parts = [(item, (i, 0, plain[i].n_frames)) for i, item in enumerate(corpus.items)]
    return _Read((*plain, *mirrored), conditions, seconds, corpus.recordings.rates, parts)


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
    alone = replace(paired, rig=corpus.unpaired_rig)
    others = systematic_sample(corpus.unpaired, 60 * config.in_memory)
    if fits and config.path:
        paths = [paired.take(*one).path for one in zip(corpus.items, corpus.motions, strict=True)]
        for item in (excerpt.of(corpus.unpaired) for excerpt in others):
            phases = phases_of(item, alone.rig.load(item), config.fps)
            paths += [alone.take(*phase).path for phase in phases]
        conditions = _with_path_scale(conditions, paths, paired)
    own = replace(conditions, conditioner=None)
    wanted: list[tuple[Maker, Sequence[Item]]] = [
        (replace(paired, conditions=own), items),
        (replace(alone, conditions=own), corpus.unpaired),
    ]
    motion, unpaired = stored_arrays(config.arrays_folder, wanted, config.workers)
    spoken: list[StoredArray] = []
    if speech is not None:
        pieces = [
            phase_item(item, number, start)
            for item, array in zip(items, motion, strict=True)
            for number, start in enumerate(array.facts["starts"])
        ]
        (spoken,) = stored_arrays(config.arrays_folder, [(speech, pieces)], config.workers)
    sample: dict[int, list[Excerpt]] = {}
    for excerpt in corpus.recordings.excerpts or ():
        sample.setdefault(excerpt.index, []).append(excerpt)
    if speech is not None and conditions.conditioner is None:
        conditions = replace(conditions, conditioner=_fitted(speech, motion, spoken, sample))
    for excerpt in others:
        sample.setdefault(len(items) + excerpt.index, []).append(excerpt)
    stored = StoredCorpus(
        *([array.path.stem for array in arrays] for arrays in (motion, spoken, unpaired))
    )
    recordings = stored.sequences(config, conditions, paired.representation.n_features)
    variants = stored_variants([*motion, *unpaired])
    sampled = tuple(
        (i, *excerpt.frames(config.fps, recordings[i].n_frames))
        for i, variant in enumerate(variants)
        # The other phases of an excerpt are almost the same motion.
        for excerpt in sample.get(variant.which, ()) * (variant.phase == 0)
    )
    plain = [(variants[cut[0]], cut) for cut in sampled if not variants[cut[0]].mirrored]
    parts = [(items[own.which], cut) for own, cut in plain if own.which < len(items)]
    seconds = [sum(array.facts["seconds"] for array in arrays) for arrays in (motion, unpaired)]
    rates = [array.facts["fps"] for array in motion]
    return _Read(recordings, conditions, (seconds[0], seconds[1]), rates, parts, sampled, stored)


def _fitted(
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
            part = excerpt.frames(speech.fps, min(first.shape[0], lengths[0]))
            clips.append(raw_speech(first, *part))
    return fit_conditioner(clips, speech.extractor, speech.fps, speech.settings)


def _start(config: DiffusionConfig) -> DiffusionModel | None:
    if config.start_from is None:
        return None
    weights = None if config.features is None else config.features.encoder_places
    start = DiffusionModel.load(model_of(config.start_from), weights=weights)
    check_settings("start_from", config.start_from, {"fps": start.fps}, {"fps": config.fps})
    for name, known in (("network", start.network.config), ("noise", start.noise_config)):
        values = {f"{name}.{k}": v for k, v in to_dict(known).items() if k != "dropout"}
        wanted = {f"{name}.{k}": v for k, v in to_dict(getattr(config, name)).items()}
        check_settings("start_from", config.start_from, values, wanted)
    return start


def _like(config: DiffusionConfig) -> DiffusionModel | None:
    """Load the model of `moves_like`, whose motion vectors this run uses."""
    if config.moves_like is None:
        return None
    weights = None if config.features is None else config.features.encoder_places
    like = DiffusionModel.load(model_of(config.moves_like), weights=weights)
    check_settings("moves_like", config.moves_like, {"fps": like.fps}, {"fps": config.fps})
    if like.representation.makes_root == config.path:
        follows = "follows a path" if config.path else "moves its root itself"
        raise ConfigError(f"moves_like: this run {follows} and {config.moves_like} does not")
    return like


def _same_rig(
    like: DiffusionModel, motions: Sequence[Motion], config: DiffusionConfig
) -> DeltaRepresentation:
    """Return the representation of a model, checked against the rig of the corpus.

    A model to start from gets the bones and body shape of the corpus. With `moves_like` they stay,
    because motion vectors of experts must have the same unit of length.
    """
    setting = "start_from" if config.moves_like is None else "moves_like"
    where = getattr(config, setting)
    check_rig(setting, where, like.skeleton, motions[0].skeleton, config.corpus)
    known = like.representation
    return known if setting == "moves_like" else known.on_bones_of(motions)


def _floors(representation: DeltaRepresentation, fps: float) -> np.ndarray:
    """Return the least scale (X,) of each number of a motion vector."""
    values = np.full(representation.n_features, 0.01)  # radians
    values[representation.height_column] = 2e-3  # metres of the reference body
    if representation.makes_root:
        values[representation.root_columns] = _STEP_FLOORS / fps
    return values


def _with_path_scale(
    conditions: Conditions, paths: Sequence[RootPath | None], maker: VariantArrays
) -> Conditions:
    """Return the conditions with mean and scale of the displacements of these paths."""
    size = 1 / maker.representation.scale
    deltas = np.concatenate([path.scaled(size).deltas() for path in paths if path is not None])
    scale = np.maximum(deltas.std(axis=0), _STEP_FLOORS / maker.config.fps)
    return replace(conditions, path_mean=deltas.mean(axis=0), path_scale=scale)
