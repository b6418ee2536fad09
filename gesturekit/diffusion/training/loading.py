"""Loading of training data from a corpus: motion, features, paths, events and styles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gesturekit.corpus.item import Item
from gesturekit.corpus.styles import style_track
from gesturekit.diffusion.conditions import Conditions, smooth_path
from gesturekit.diffusion.config import DiffusionConfig
from gesturekit.diffusion.model import DiffusionModel
from gesturekit.diffusion.motion_vector import DeltaRepresentation, Normaliser
from gesturekit.diffusion.training.augmentation import mirror_condition, phases
from gesturekit.diffusion.training.corpus import Corpus, read_corpus
from gesturekit.diffusion.training.data import TrainingData, TrainingSequence
from gesturekit.errors import ConfigError, CorpusError, MotionError
from gesturekit.formats.tables.events import Event
from gesturekit.motion.mirroring import can_be_mirrored
from gesturekit.motion.motion import Motion
from gesturekit.motion.root_path import RootPath, follow_path
from gesturekit.training.config import to_dict
from gesturekit.training.data.features import extract_features, feature_values
from gesturekit.training.data.start_model import (
    check_conditions,
    check_rig,
    check_settings,
    model_of,
)

_STEP_FLOORS = np.array([0.03, 0.015, 0.015])
"""Least scale of turn, forward and lateral displacement: radians and metres per second."""


@dataclass(frozen=True)
class _Take:
    """A recording with its inputs: the path of its root, features, events and style."""

    name: str
    motion: Motion
    path: RootPath | None
    speech: np.ndarray | None = None
    events: tuple[Event, ...] = ()
    style: str | None = None
    is_paired: bool = True


def load_training_data(config: DiffusionConfig, device: str = "cpu") -> TrainingData:
    """Read the corpus of a run, extract features on a device, and normalise.

    Raises:
        CorpusError: no training item with what the run needs, rigs that differ, or a file that
            cannot be read.
        ConfigError: a model in `start_from` with other conditions, or one in `start_from` or
            `moves_like` with another rig.
        ModelError: such a model cannot be read.
    """
    # First, so that wrong settings fail before anything is read.
    extractor = None if config.features is None else config.features.extractor(device)
    start = _start(config)
    like = _like(config) if start is None else start
    corpus = read_corpus(config, speech=extractor is not None)
    conditions, speeches = _conditions(config, corpus, extractor, start)
    if like is None:
        motions = corpus.motions
        representation = DeltaRepresentation.fit(motions, config.joints, root=not config.path)
    else:
        representation = _same_rig(like, corpus.motions, config)
    takes = _takes(config, corpus, speeches, representation)
    vectors = [_encode(config, representation, take.motion, take) for take in takes]
    if start is None and config.path:
        conditions = _with_path_scale(conditions, takes, representation.scale, config.fps)
    encoded = [_condition(take, conditions, config.fps, representation.scale) for take in takes]
    recordings = [
        TrainingSequence(take.name, vector[: len(own)].astype(np.float32), own, take.is_paired)
        for take, vector, own in zip(takes, vectors, encoded, strict=True)
    ]
    if config.augmentation.mirror and can_be_mirrored(representation.skeleton):
        handed = () if config.styles is None else config.styles.handed
        recordings += [
            _mirrored(config, representation, conditions, take, recording)
            for take, recording in zip(takes, recordings, strict=True)
            if take.style not in handed
        ]
    if like is None:
        normaliser = Normaliser.fit(
            [r.motion for r in recordings], _floors(representation, config.fps)
        )
    else:
        normaliser = like.normaliser
    return TrainingData(
        recordings=tuple(recordings),
        seconds=corpus.seconds,
        representation=representation,
        conditions=conditions,
        normaliser=normaliser,
        speakers=corpus.recordings.speakers,
        sources=corpus.recordings.sources,
        recorded_fps=corpus.recordings.recorded_fps,
        start={} if start is None else start.network.state_dict(),
    )


def _conditions(
    config: DiffusionConfig, corpus: Corpus, extractor: Any, start: DiffusionModel | None
) -> tuple[Conditions, list[np.ndarray | None]]:
    """Return the conditions of the model, and the speech features (T, S) of each item."""
    names = tuple(sorted({event.name for events in corpus.events for event in events}))
    fitted = None
    if start is not None:
        wanted = Conditions(None, config.path, names, corpus.recordings.styles).to_values()
        if extractor is not None:
            wanted["features"] = feature_values(extractor, config.features)
        check_conditions(config.start_from, start.conditions.to_values(), wanted)
        fitted = start.conditions.conditioner
    conditioner, speeches = None, [None] * len(corpus.items)
    if extractor is not None:
        lengths = [motion.n_frames for motion in corpus.motions]
        conditioner, speeches = extract_features(
            corpus.items, lengths, extractor, config.fps, config.features, fitted
        )
    if start is not None:
        return start.conditions, speeches
    return Conditions(conditioner, config.path, names, corpus.recordings.styles), speeches


def _takes(
    config: DiffusionConfig,
    corpus: Corpus,
    speeches: Sequence[np.ndarray | None],
    representation: DeltaRepresentation,
) -> list[_Take]:
    """Return all recordings with their inputs, unpaired motion last."""
    inputs = zip(corpus.items, corpus.motions, speeches, corpus.events, strict=True)
    takes = [
        _Take(
            item.id,
            *_on_path(config, representation, motion, item),
            speech,
            events,
            style=item.style if corpus.recordings.styles else None,
        )
        for item, motion, speech, events in inputs
    ]
    return takes + [
        _Take(name, *_on_path(config, representation, phase.motion), is_paired=False)
        for name, motion in corpus.unpaired
        for phase in phases(motion, config.fps)
    ]


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


def _on_path(
    config: DiffusionConfig,
    representation: DeltaRepresentation,
    motion: Motion,
    item: Item | None = None,
) -> tuple[Motion, RootPath | None]:
    """Move a motion onto its item's path, or onto its smoothed root path.

    Without path condition, return the motion as it is and no path.
    """
    if not config.path:
        return motion, None
    own = representation.path_of(motion)
    given = (
        None if item is None else item.load_path(config.fps, motion.n_frames, representation.scale)
    )
    path = smooth_path(given or own, config.fps, motion.n_frames)
    # A table may have another origin; a model only gets the displacements of a path.
    apart = (own.positions - path.positions).mean(axis=0)
    path = replace(path, positions=path.positions + apart)
    return follow_path(motion, path, representation.root), path


def _encode(
    config: DiffusionConfig,
    representation: DeltaRepresentation,
    motion: Motion,
    take: _Take,
    path: RootPath | None = None,
) -> np.ndarray:
    try:
        return representation.encode(motion, path or take.path)
    except MotionError as error:
        raise CorpusError(f"{config.corpus}: item {take.name}: {error}") from None


def _mirrored(
    config: DiffusionConfig,
    representation: DeltaRepresentation,
    conditions: Conditions,
    take: _Take,
    recording: TrainingSequence,
) -> TrainingSequence:
    path = None if take.path is None else take.path.mirror()
    vector = _encode(config, representation, take.motion.mirror(), take, path)
    columns = conditions.columns
    condition = mirror_condition(
        recording.condition,
        path=columns["path"],
        path_offset=conditions.path_mean / conditions.path_scale,
        events=columns["events"],
        event_names=conditions.events,
    )
    motion = vector[: recording.n_frames].astype(np.float32)
    return replace(recording, name=f"{take.name} (mirrored)", motion=motion, condition=condition)


def _floors(representation: DeltaRepresentation, fps: float) -> np.ndarray:
    """Return the least scale (X,) of each number of a motion vector."""
    values = np.full(representation.n_features, 0.01)  # radians
    values[representation.height_column] = 2e-3  # metres of the reference body
    if representation.makes_root:
        values[representation.root_columns] = _STEP_FLOORS / fps
    return values


def _with_path_scale(
    conditions: Conditions, takes: Sequence[_Take], scale: float, fps: float
) -> Conditions:
    paths = [take.path.scaled(1 / scale) for take in takes if take.path is not None]
    deltas = np.concatenate([path.deltas() for path in paths])
    scale = np.maximum(deltas.std(axis=0), _STEP_FLOORS / fps)
    return replace(conditions, path_mean=deltas.mean(axis=0), path_scale=scale)


def _condition(take: _Take, conditions: Conditions, fps: float, scale: float) -> np.ndarray:
    """Return the condition (T, C), as long as the shorter of motion and speech."""
    n_frames = take.motion.n_frames
    if take.speech is not None:
        n_frames = min(n_frames, len(take.speech))
    return conditions.encode(
        n_frames,
        fps,
        speech=None if take.speech is None else take.speech[:n_frames],
        path=None if take.path is None else take.path.slice(0, n_frames).scaled(1 / scale),
        events=take.events,
        style=None
        if take.style is None
        else style_track(conditions.styles, take.style, n_frames, fps),
    )
