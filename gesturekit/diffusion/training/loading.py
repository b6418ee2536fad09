"""From a corpus to what a diffusion run trains on: motion, features, paths, events and styles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gesturekit.corpus.checks import first_difference
from gesturekit.corpus.item import Item
from gesturekit.corpus.manifest import Manifest
from gesturekit.corpus.styles import style_track
from gesturekit.diffusion.conditions import Conditions, smooth_path
from gesturekit.diffusion.config import DiffusionConfig
from gesturekit.diffusion.model import DiffusionModel
from gesturekit.diffusion.motion_vector import DeltaRepresentation
from gesturekit.diffusion.standardiser import Standardiser
from gesturekit.diffusion.training.augmentation import mirror_condition, phases
from gesturekit.diffusion.training.data import Recording, TrainingData
from gesturekit.errors import ConfigError, CorpusError, MotionError
from gesturekit.formats.tables.events import Event
from gesturekit.motion.contacts import floor_height
from gesturekit.motion.mirroring import can_be_mirrored
from gesturekit.motion.motion import Motion
from gesturekit.motion.retarget import retarget
from gesturekit.motion.retarget.path_following import follow_path
from gesturekit.motion.retarget.standing_pose import standing_pose
from gesturekit.motion.root_path import RootPath
from gesturekit.training.config import to_dict
from gesturekit.training.data.features import listen
from gesturekit.training.data.recordings import (
    item_styles,
    load_motions,
    recorded_rate,
    speaker_skeletons,
    training_items,
)
from gesturekit.training.data.sources import Source


@dataclass(frozen=True)
class _Take:
    """A recording on its way: its motion, the path that its root follows, what is told of it."""

    name: str
    motion: Motion
    path: RootPath | None
    speech: np.ndarray | None = None
    events: tuple[Event, ...] = ()
    style: str | None = None
    is_paired: bool = True


def load_training_data(config: DiffusionConfig) -> TrainingData:
    """Read the corpus of a run, extract features, and standardise.

    Raises:
        CorpusError: no training item with what the run needs, rigs that differ, or a file that
            cannot be read.
        ConfigError: a model to start from that is told other things, or one to start from or to
            move like that has another rig.
        ModelError: such a model cannot be read.
    """
    # First: wrong settings are told before anything is read.
    extractor = None if config.features is None else config.features.extractor()
    start = _start(config)
    like = _like(config) if start is None else start
    manifest = Manifest.load(config.corpus)
    items = training_items(manifest, config.corpus, heard=extractor is not None)
    styles: tuple[str, ...] = ()
    if config.styles is not None:
        styles, _ = item_styles(items, config.corpus)
        _check_handed(config, styles)
    recorded = load_motions(items, config.corpus, None, config.parts)
    others = _unpaired(config, manifest, recorded[0])
    speakers = speaker_skeletons(items, recorded)
    sources = tuple(map(Source.of, items, recorded))
    seconds = sum(motion.duration for motion in recorded), sum(m.duration for _, m in others)
    items, motions = _phases(items, recorded, config.fps)
    happens = [item.load_events() if config.events else () for item in items]
    names = tuple(sorted({event.name for events in happens for event in events}))
    if config.events and not names:
        raise CorpusError(
            f"{config.corpus}: no training item has events; put STEM.events.csv beside the "
            "recordings and run gesturekit prepare again, or train without (events=false)"
        )
    conditioner, speeches = None, [None] * len(items)
    if extractor is not None:
        lengths = [motion.n_frames for motion in motions]
        conditioner, speeches = listen(items, lengths, extractor, config.fps, config.features)
    conditions = Conditions(conditioner, config.path, names, styles)
    if start is not None:
        conditions = _same(conditions, start, config)
        if conditions.conditioner is not None:
            speeches = [
                conditions.conditioner(item.load_wave(), len(heard))
                for item, heard in zip(items, speeches, strict=True)
            ]
    if like is None:
        representation = DeltaRepresentation.fit(motions, config.joints, root=not config.path)
    else:
        representation = _same_rig(like, motions[0], config)
    takes = [
        _Take(
            item.id,
            *_on_path(config, representation, motion, item),
            *told,
            style=item.style if styles else None,
        )
        for item, motion, *told in zip(items, motions, speeches, happens, strict=True)
    ]
    takes += [
        _Take(name, *_on_path(config, representation, phase.motion), is_paired=False)
        for name, motion in others
        for phase in phases(motion, config.fps)
    ]
    vectors = [_encode(config, representation, take.motion, take) for take in takes]
    if start is None and config.path:
        conditions = _with_path_scale(conditions, takes, representation.scale)
    told = [_condition(take, conditions, config.fps, representation.scale) for take in takes]
    recordings = [
        Recording(take.name, vector[: len(rows)].astype(np.float32), rows, take.is_paired)
        for take, vector, rows in zip(takes, vectors, told, strict=True)
    ]
    if config.augmentation.mirror and can_be_mirrored(representation.skeleton):
        handed = () if config.styles is None else config.styles.handed
        recordings += [
            _mirrored(config, representation, conditions, take, recording)
            for take, recording in zip(takes, recordings, strict=True)
            if take.style not in handed
        ]
    if like is None:
        standardiser = Standardiser.fit([r.motion for r in recordings], _floors(representation))
    else:
        standardiser = like.standardiser
    return TrainingData(
        recordings=tuple(recordings),
        seconds=seconds,
        representation=representation,
        conditions=conditions,
        standardiser=standardiser,
        speakers=speakers,
        sources=sources,
        recorded_fps=recorded_rate(recorded),
    )


def _start(config: DiffusionConfig) -> DiffusionModel | None:
    if config.start_from is None:
        return None
    weights = None if config.features is None else config.features.weights
    start = DiffusionModel.load(config.start_from, weights=weights)
    for name, known in (("network", start.network_config), ("noise", start.noise_config)):
        known, wanted = to_dict(known), to_dict(getattr(config, name))
        for key in known:
            if key != "dropout" and known[key] != wanted[key]:
                raise ConfigError(
                    f"start_from: {config.start_from} has {name}.{key} {known[key]}, this run "
                    f"{wanted[key]}; set it to what the model has"
                )
    return start


def _like(config: DiffusionConfig) -> DiffusionModel | None:
    """The model whose motion vectors are those of this run."""
    if config.moves_like is None:
        return None
    weights = None if config.features is None else config.features.weights
    like = DiffusionModel.load(config.moves_like, weights=weights)
    if like.representation.makes_root == config.path:
        follows = "follows a path" if config.path else "moves its root itself"
        raise ConfigError(f"moves_like: this run {follows} and {config.moves_like} does not")
    return like


def _check_handed(config: DiffusionConfig, styles: Sequence[str]) -> None:
    for name in config.styles.handed if config.styles is not None else ():
        if name not in styles:
            raise ConfigError(
                f"styles.handed: {name!r} is no style of {config.corpus}, which has "
                f"{', '.join(styles)}"
            )


def _unpaired(
    config: DiffusionConfig, manifest: Manifest, usual: Motion
) -> list[tuple[str, Motion]]:
    """Motion that goes without speech, by name, on the rig of the corpus."""
    if config.unpaired is None:
        return []
    where = config.unpaired.corpus or config.corpus
    if config.unpaired.corpus is None:
        items = manifest.motion_alone("train")
    else:
        items = training_items(Manifest.load(where), where, heard=False)
    if not items:
        raise CorpusError(
            f"{where}: no item of split train is motion alone; name a manifest of motion by "
            "unpaired.corpus, or train without (unpaired=null)"
        )
    found = []
    for item in items:
        motion = item.load_motion()
        if first_difference(motion.skeleton, usual.skeleton):
            try:
                motion = retarget(
                    motion,
                    usual.skeleton,
                    target_parts=config.parts,
                    pose=standing_pose(usual),
                )
            except MotionError as error:
                raise CorpusError(
                    f"{where}: item {item.id}: cannot be put onto the rig of {config.corpus}: "
                    f"{error}"
                ) from None
            # Where the floor of a foreign file lies nobody knows; that of the corpus counts.
            lift = floor_height(usual) - floor_height(motion)
            motion = replace(motion, translation=motion.translation + [0.0, lift, 0.0])
        found.append((item.id, motion))
    return found


def _phases(
    items: Sequence[Item], motions: Sequence[Motion], fps: float
) -> tuple[list[Item], list[Motion]]:
    """All the sequences at `fps` that recordings of a multiple of it hold, each as its own item."""
    found: list[Item] = []
    made: list[Motion] = []
    for item, motion in zip(items, motions, strict=True):
        for k, phase in enumerate(phases(motion, fps)):
            later = replace(
                item,
                id=f"{item.id} (phase {k + 1})",
                motion_start=item.motion_start + phase.start,
                audio_start=item.audio_start + phase.start,
                duration=item.duration - phase.start,
            )
            found.append(later if k else item)
            made.append(phase.motion)
    return found, made


def _same(conditions: Conditions, start: DiffusionModel, config: DiffusionConfig) -> Conditions:
    """The conditions of the model to start from, if they are those of this run."""
    wanted, known = conditions.to_values(), start.conditions.to_values()
    for name in wanted:
        # A corpus may lack some of the styles and events that the model knows.
        lists = isinstance(wanted[name], list) and bool(wanted[name]) == bool(known[name])
        if not (set(wanted[name]) <= set(known[name]) if lists else wanted[name] == known[name]):
            raise ConfigError(
                f"start_from: {config.start_from} has {name} {known[name]}, this run "
                f"{wanted[name]}; what a model is told cannot change"
            )
    return start.conditions


def _same_rig(like: DiffusionModel, motion: Motion, config: DiffusionConfig) -> DeltaRepresentation:
    """The representation of the model to start from, or to move like, if it fits the corpus."""
    setting = "start_from" if config.moves_like is None else "moves_like"
    where = getattr(config, setting)
    if like.fps != config.fps:
        raise ConfigError(f"{setting}: {where} has {like.fps:g} fps; set fps to it")
    different = first_difference(motion.skeleton, like.skeleton)
    if different:
        raise ConfigError(f"{setting}: {where} has another rig than {config.corpus}: {different}")
    return like.representation


def _on_path(
    config: DiffusionConfig,
    representation: DeltaRepresentation,
    motion: Motion,
    item: Item | None = None,
) -> tuple[Motion, RootPath | None]:
    """A motion on what its root follows: the item's path, else its own way.

    As it is, without a path, where the root moves by itself.
    """
    if not config.path:
        return motion, None
    own = representation.path_of(motion)
    given = (
        None if item is None else item.load_path(config.fps, motion.n_frames, representation.scale)
    )
    path = smooth_path(given or own, config.fps, motion.n_frames)
    # A table may begin at an origin of its own, and a model sees but the steps of a path.
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
    recording: Recording,
) -> Recording:
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


def _floors(representation: DeltaRepresentation) -> np.ndarray:
    """(X,) spreads below which a number of a motion vector is scaled as if it had this much."""
    values = np.full(representation.n_features, 0.01)  # radians of a joint
    values[representation.height_column] = 2e-3  # metres of the reference body
    if representation.makes_root:
        values[representation.root_columns] = 1e-3, 5e-4, 5e-4  # radians and metres a frame
    return values


def _with_path_scale(conditions: Conditions, takes: Sequence[_Take], scale: float) -> Conditions:
    paths = [take.path.scaled(1 / scale) for take in takes if take.path is not None]
    deltas = np.concatenate([path.deltas() for path in paths])
    scale = np.maximum(deltas.std(axis=0), (1e-3, 5e-4, 5e-4))
    return replace(conditions, path_mean=deltas.mean(axis=0), path_scale=scale)


def _condition(take: _Take, conditions: Conditions, fps: float, scale: float) -> np.ndarray:
    """(T, C): as many frames as there are of both motion and speech."""
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
