"""From a corpus to training data: motion, features, paths, events and styles.

Variants of a recording are its phases, and a mirrored copy of each.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gesturekit.corpus.checks import first_difference
from gesturekit.corpus.layouts import HANDED
from gesturekit.corpus.manifest import Item, Manifest, file_fingerprint
from gesturekit.corpus.speech import SpeechConditioner, style_track
from gesturekit.diffusion.conditions import Conditions, smooth_path
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
from gesturekit.errors import ConfigError, CorpusError, MotionError
from gesturekit.motion.contacts import floor_height
from gesturekit.motion.motion import Motion, can_be_mirrored
from gesturekit.motion.retarget import retarget
from gesturekit.motion.retarget.body_frames import standing_pose
from gesturekit.motion.root_path import RootPath, follow_path
from gesturekit.state.channels import StateChannels
from gesturekit.state.process import RecordedState, StateProcess
from gesturekit.training.arrays import Array, ArrayInMemory, names_of, stored_arrays
from gesturekit.training.config import to_dict
from gesturekit.training.features import SpeechArrays, feature_values
from gesturekit.training.origin import check_conditions, check_rig, check_settings, model_of
from gesturekit.training.recordings import (
    Excerpt,
    Recordings,
    Rig,
    load_recordings,
    motion_origin,
    systematic_sample,
    training_items,
)

_STEP_FLOORS = np.array([0.03, 0.015, 0.015])
"""Least scale of turn, forward and lateral displacement: radians and metres per second."""
_WORDS = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|[^A-Za-z]+|[A-Z]")
_OTHER_SIDE = {"left": "right", "Left": "Right", "LEFT": "RIGHT", "l": "r", "L": "R"}
_OTHER_SIDE |= {right: left for left, right in _OTHER_SIDE.items()}


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
    read = corpus.recordings
    conditions = _conditions(corpus, speech, start)
    representation = _representation(corpus, like)
    conditions, motion, unpaired = _encoded(corpus, conditions, representation)
    spoken: Sequence[Array] = []
    if speech is not None:
        conditioner, spoken = _speech(corpus, motion, speech, conditions.conditioner)
        conditions = replace(conditions, conditioner=conditioner)
    width = representation.n_features
    recordings = sequences_of(motion, spoken, unpaired, conditions, width)
    sampled, stored = _sampled(corpus, recordings), None
    if corpus.is_in_memory:
        recordings = tuple(recording.in_memory() for recording in recordings)
    else:
        kinds = {"motion": motion, "speech": spoken, "unpaired": unpaired}
        stored = {kind: names_of(arrays) for kind, arrays in kinds.items()}
    process, normaliser = None, None if like is None else like.normaliser
    if normaliser is None:
        normaliser = _normaliser(representation, motion_of(recordings, sampled), fps)
    if config.state:
        process = _fit_state(corpus, recordings, sampled, conditions, representation)
        recordings = tuple(with_state(r, process, representation) for r in recordings)
        conditions = replace(conditions, state=process.channels)
    seconds = [sum((a.facts["seconds"] for a in arrays), 0.0) for arrays in (motion, unpaired)]
    seconds = [*read.lengths] if trial else seconds
    return TrainingData(
        recordings=recordings,
        seconds=seconds[0],
        unpaired_seconds=seconds[1],
        representation=representation,
        conditions=conditions,
        normaliser=normaliser,
        state_process=process,
        speakers=read.speakers,
        sources=read.sources([array.facts["fps"] for array in motion]),
        recorded_fps=read.recorded_fps,
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


def _representation(corpus: Corpus, like: DiffusionModel | None) -> DeltaRepresentation:
    """Return the representation of a model, checked against the rig of the corpus, or a new one.

    A model to start from gets the bones and body shape of the corpus. With `moves_like` they stay,
    because motion vectors of experts must have the same unit of length.
    """
    config = corpus.config
    motions = [motion for _, phases in corpus.parts[0].read for _, motion in phases]
    if like is None:
        return DeltaRepresentation.fit(motions, config.joints, root=not config.path)
    setting = "moves_like" if config.start_from is None else "start_from"
    where = getattr(config, setting)
    check_rig(setting, where, like.skeleton, motions[0].skeleton, config.corpus)
    known = like.representation
    return known if setting == "moves_like" else known.on_bones_of(motions)


def _conditions(
    corpus: Corpus, speech: SpeechArrays | None, start: DiffusionModel | None
) -> Conditions:
    """Return the conditions of the model to start from, or new ones that nothing is fitted to."""
    config = corpus.config
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


def _encoded(
    corpus: Corpus, conditions: Conditions, representation: DeltaRepresentation
) -> tuple[Conditions, Sequence[Array], Sequence[Array]]:
    """Return arrays of the recordings and of unpaired motion; on disk, missing ones are made.

    With them, the conditions: unless a model to start from has them, mean and scale of the paths'
    displacements are fitted to the recordings that were read.
    """
    config = corpus.config
    makers = [VariantArrays(config, p.rig, representation, conditions) for p in corpus.parts]
    if config.path and config.start_from is None:
        steps = [
            maker.path(*phase).scaled(1 / representation.scale).deltas()
            for maker, part in zip(makers, corpus.parts, strict=True)
            for _, phases in part.read
            for phase in phases
        ]
        deltas = np.concatenate(steps)
        scale = np.maximum(deltas.std(axis=0), _STEP_FLOORS / config.fps)
        conditions = replace(conditions, path_mean=deltas.mean(axis=0), path_scale=scale)
    beside_speech = replace(conditions, conditioner=None)
    makers = [replace(maker, conditions=beside_speech) for maker in makers]
    pairs = list(zip(makers, corpus.parts, strict=True))
    arrays: Sequence[Sequence[Array]]
    if corpus.is_in_memory:
        arrays = [[ArrayInMemory(*maker.encode(r)) for r in part.read] for maker, part in pairs]
    else:
        wanted = [(maker, part.items) for maker, part in pairs]
        arrays = stored_arrays(config.arrays_folder, wanted, config.workers)
    return conditions, arrays[0], arrays[1]


def _speech(
    corpus: Corpus, motion: Sequence[Array], speech: SpeechArrays, known: SpeechConditioner | None
) -> tuple[SpeechConditioner, Sequence[Array]]:
    """Return a conditioner, and the arrays of the speech of each phase.

    Args:
        corpus: of the run.
        motion: arrays of its recordings.
        speech: extracts features.
        known: see `SpeechArrays.fit`.
    """
    phases = [
        phase_item(item, number, start)
        for item, array in zip(corpus.recordings.items, motion, strict=True)
        for number, start in enumerate(array.facts["starts"])
    ]
    if corpus.is_in_memory:
        held = speech.in_memory(phases)
        return speech.fit([(array, 0, array.shape[0]) for array in held], known), held
    (spoken,) = stored_arrays(
        corpus.config.arrays_folder, [(speech, phases)], corpus.config.workers
    )
    counts = [len(array.facts["lengths"]) for array in motion]
    clips = []
    for excerpt in corpus.recordings.excerpts or ():
        first = spoken[sum(counts[: excerpt.index])]
        n_frames = min(first.shape[0], motion[excerpt.index].facts["lengths"][0])
        clips.append((first, *excerpt.frames(speech.fps, n_frames)))
    return speech.fit(clips, known), spoken


def _sampled(corpus: Corpus, recordings: Sequence[TrainingSequence]) -> tuple[Cut, ...]:
    """Return the parts from which statistics are computed: of a corpus on disk, a sample."""
    if corpus.is_in_memory:
        return tuple((i, 0, recording.n_frames) for i, recording in enumerate(recordings))
    sample: dict[int, list[Excerpt]] = {}
    for first, part in zip((0, len(corpus.recordings.items)), corpus.parts, strict=True):
        for excerpt in part.excerpts:
            sample.setdefault(first + excerpt.index, []).append(excerpt)
    return tuple(
        (i, *excerpt.frames(corpus.config.fps, recording.n_frames))
        for i, recording in enumerate(recordings)
        # The other phases of an excerpt are almost the same motion.
        for excerpt in sample.get(recording.recording, ()) * (recording.phase == 0)
    )


def _normaliser(
    representation: DeltaRepresentation, motion: Sequence[np.ndarray], fps: float
) -> Normaliser:
    """Return mean and scale of motion vectors (T, X), with a least scale."""
    floors = np.full(representation.n_features, 0.01)  # radians
    floors[representation.height_column] = 2e-3  # metres of the reference body
    if representation.makes_root:
        floors[representation.root_columns] = _STEP_FLOORS / fps
    return Normaliser.fit(motion, floors)


def _fit_state(
    corpus: Corpus,
    recordings: Sequence[TrainingSequence],
    sampled: Sequence[Cut],
    conditions: Conditions,
    representation: DeltaRepresentation,
) -> StateProcess:
    """Return the process of the state of movement in the sampled parts of paired recordings.

    Mirrored copies are left out. The conditions of the recordings have no state yet.
    """
    items, fps = corpus.recordings.items, corpus.config.fps
    channels = StateChannels.find(representation.skeleton, representation.joints)
    recorded = []
    for i, start, stop in sampled:
        sequence = recordings[i]
        if sequence.mirrored or not sequence.is_paired:
            continue
        item = items[sequence.recording]
        values = measured_state(sequence.motion[start:stop], representation, channels, fps)
        speech = sequence.condition[start:stop][:, conditions.columns["speech"]]
        style = conditions.styles.index(item.style or "") if conditions.styles else None
        recorded.append(RecordedState(values, speech.T, item.take, (item.speaker, style)))
    return StateProcess.fit(channels, recorded, fps, conditions.conditioner)


Recording = tuple[dict[str, Any], list[tuple[Item, Motion]]]
"""Facts about a recording (id, its file's frame rate, seconds), and items and motions of its phases
at the model's frame rate; n phases of a recording at n times that rate."""


def recording_of(item: Item, motion: Motion, fps: float) -> Recording:
    """Resample a motion to `fps`; at n times that rate, take all n decimations of it.

    The first phase is `motion.resample(fps)`. The others start later, and so do their speech, path
    and events.
    """
    ratio = motion.fps / fps
    n = round(ratio) if abs(ratio - round(ratio)) < 1e-6 * ratio else 1
    phases = [(item, motion.resample(fps))]
    for k in range(1, min(n, motion.n_frames)):
        phases.append((phase_item(item, k, k / motion.fps), motion[k:].resample(fps)))
    return {"id": item.id, "fps": motion.fps, "seconds": motion.duration}, phases


def phase_item(item: Item, number: int, start: float) -> Item:
    """Return phase `number` of an item, counted from 0, which begins `start` seconds later."""
    if not number:
        return item
    return replace(
        item,
        id=f"{item.id} (phase {number + 1})",
        motion_start=item.motion_start + start,
        audio_start=item.audio_start + start,
        duration=item.duration - start,
    )


@dataclass(frozen=True, eq=False)
class UnpairedRig:
    """The rig onto which unpaired motion is retargeted.

    Attributes:
        config: of the run.
        usual: a recording of the corpus.
    """

    config: DiffusionConfig
    usual: Motion

    def load(self, item: Item) -> Motion:
        """Read the motion of an item at its file's frame rate, on the rig of the corpus.

        Raises:
            CorpusError: it cannot be retargeted.
            FormatError: the file cannot be read.
        """
        motion = item.load_motion()
        if not first_difference(motion.skeleton, self.usual.skeleton):
            return motion
        try:
            rig = self.usual.skeleton.with_parts(dict(self.config.parts))
            motion = retarget(motion, rig, pose=self._standing_pose)
            motion = replace(motion, skeleton=self.usual.skeleton)
        except MotionError as error:
            why = f"cannot be retargeted to the rig of {self.config.corpus}: {error}"
            where = _unpaired_corpus(self.config)
            raise CorpusError(f"{where}: item {item.id}: {why}") from None
        # The floor of a foreign file is unknown; take that of the corpus.
        lift = self._floor_height - floor_height(motion)
        return replace(motion, translation=motion.translation + [0.0, lift, 0.0])

    def origin(self, item: Item) -> dict[str, Any]:
        """Return all that the motion of an item depends on, as plain values."""
        skeleton, usual = self.usual.skeleton, hashlib.sha256()
        for values in (skeleton.offsets, self.usual.rotations, self.usual.translation):
            usual.update(np.ascontiguousarray(values).tobytes())
        return {
            **motion_origin(item),
            "parts": dict(self.config.parts),
            "rig": [list(skeleton.names), list(skeleton.parents), usual.hexdigest()],
        }

    @cached_property
    def _standing_pose(self) -> np.ndarray:
        return standing_pose(self.usual)

    @cached_property
    def _floor_height(self) -> float:
        return floor_height(self.usual)


class Part(NamedTuple):
    """Paired recordings of a corpus, or unpaired motion.

    Attributes:
        rig: reads the motion of an item.
        items: all of them.
        excerpts: a sample of the items of a long corpus.
        read: the items or excerpts that were read; of unpaired motion of a long corpus only those
            that a path condition is fitted to.
    """

    rig: Rig | UnpairedRig
    items: Sequence[Item]
    excerpts: Sequence[Excerpt]
    read: list[Recording]


class Corpus(NamedTuple):
    """Recordings of a corpus with what the diffusion system adds to them.

    Attributes:
        config: of the run.
        recordings: of which `motions` are not used any more.
        events: names of the events of all recordings.
        parts: paired recordings, and unpaired motion.
    """

    config: DiffusionConfig
    recordings: Recordings
    events: tuple[str, ...]
    parts: tuple[Part, Part]

    @property
    def is_in_memory(self) -> bool:
        """Return True if all recordings were read."""
        return self.recordings.excerpts is None


def read_recordings(config: DiffusionConfig, *, trial: bool) -> Recordings:
    """Read the training items of a run; with speech input, those that have speech too.

    Raises:
        CorpusError, ConfigError: see `load_training_data`.
    """
    return load_recordings(
        config,
        config.parts,
        speech=config.features is not None,
        styles=config.styles is not None,
        check_styles=lambda styles: _check_handed(config, styles),
        others=lambda manifest: _unpaired(config, manifest),
        trial=trial,
    )


def read_corpus(config: DiffusionConfig, *, trial: bool) -> Corpus:
    """Read the recordings of a run with their events; see `read_recordings`."""
    recordings = read_recordings(config, trial=trial)
    motions, items, excerpts = recordings.motions, recordings.unpaired, recordings.excerpts
    rig = UnpairedRig(config, motions[0])
    own_rig = recordings.rig(config, config.parts)
    paired = Part(own_rig, recordings.items, excerpts or (), [])
    for i, item in enumerate(recordings.read):
        facts, phases = recording_of(item, motions[i], config.fps)
        paired.read.append((facts, phases))
        # Motion at the rate of its file is released: that of a large corpus fills memory.
        motions[i] = phases[0][1]
    unpaired = Part(rig, items, systematic_sample(items, 60 * config.in_memory), [])
    if excerpts is None or (config.path and config.start_from is None):
        for item in (excerpt.of(items) for excerpt in unpaired.excerpts):
            unpaired.read.append(recording_of(item, rig.load(item), config.fps))
    names: set[str] = set()
    if config.events:
        names.update(event.name for item in recordings.items for event in item.load_events())
        if not names:
            how = "put STEM.events.csv beside recordings and prepare again, or set events=false"
            raise CorpusError(f"{config.corpus}: no training item has events: {how}")
    return Corpus(config, recordings, tuple(sorted(names)), (paired, unpaired))


def _check_handed(config: DiffusionConfig, styles: Sequence[str]) -> None:
    for name in config.styles.handed if config.styles is not None else ():
        if name not in styles and name not in HANDED:
            known = f"{config.corpus}, which has {', '.join(styles)}"
            raise ConfigError(f"styles.handed: {name!r} is not a style of {known}")


def _unpaired_corpus(config: DiffusionConfig) -> Path:
    """Return the manifest of unpaired motion."""
    return (config.unpaired and config.unpaired.corpus) or config.corpus


def _unpaired(config: DiffusionConfig, manifest: Manifest) -> tuple[Item, ...]:
    """Return the items of unpaired motion of a run on the corpus of this manifest."""
    if config.unpaired is None:
        return ()
    where = _unpaired_corpus(config)
    if config.unpaired.corpus is None:
        items = manifest.motion_alone("train")
    else:
        items = training_items(Manifest.load(where), where, with_audio=False)
    if not items:
        how = "name a manifest of motion by unpaired.corpus, or train without (unpaired=null)"
        raise CorpusError(f"{where}: no item of split train is motion alone; {how}")
    return items


@dataclass(frozen=True, eq=False)
class VariantArrays:
    """Makes arrays (N, X + W): motion vectors, not normalised, and conditions beside speech.

    The variants of a recording follow one another: its phases, then their mirrored copies. They are
    the same rows in memory and on disk.

    Attributes:
        config: of the run.
        rig: of the corpus, or of unpaired motion.
        representation: of motion.
        conditions: the layout of conditions, without speech.
    """

    config: DiffusionConfig
    rig: Rig | UnpairedRig
    representation: DeltaRepresentation
    conditions: Conditions

    @property
    def _is_paired(self) -> bool:
        """Return False for unpaired motion, which has no conditions but its path."""
        return isinstance(self.rig, Rig)

    def make(self, item: Item) -> tuple[np.ndarray, dict[str, Any]]:
        """Read an item and encode its variants."""
        return self.encode(recording_of(item, self.rig.load(item), self.config.fps))

    def encode(self, recording: Recording) -> tuple[np.ndarray, dict[str, Any]]:
        """Return the rows (N, X + W) float32 of all variants of a recording, and facts of them."""
        facts, phases = recording
        is_mirrored = self._is_mirrored(phases[0][0])
        plain, mirrored = list[np.ndarray](), list[np.ndarray]()
        for item, motion in phases:
            path = None
            if self.config.path:
                path = self.path(item, motion)
                motion = follow_path(motion, path, self.representation.root)
            scaled = None if path is None else path.scaled(1 / self.representation.scale)
            events = item.load_events() if self.config.events and self._is_paired else ()
            style, about = self._style(item), (motion.n_frames, self.config.fps)
            styles = None if style is None else style_track(self.conditions.styles, style, *about)
            condition = self.conditions.encode(*about, path=scaled, events=events, style=styles)
            variants = [(plain, motion, path, condition)]
            if is_mirrored:
                way = None if path is None else path.mirror()
                given = mirror_condition(condition, self.conditions)
                variants.append((mirrored, motion.mirror(), way, given))
            for rows, moved, way, given in variants:
                try:
                    vectors = self.representation.encode(moved, way).astype(np.float32)
                except MotionError as error:
                    raise CorpusError(f"{self.config.corpus}: item {item.id}: {error}") from None
                rows.append(np.concatenate([vectors, given], axis=1))
        return np.concatenate([*plain, *mirrored]), facts | {
            "starts": [k / facts["fps"] for k in range(len(plain))],
            "lengths": list(map(len, plain)),
            "mirrored": is_mirrored,
        }

    def path(self, item: Item, motion: Motion) -> RootPath:
        """Return the path of the item's table, or the smoothed root path of the motion."""
        fps, n_frames, scale = self.config.fps, motion.n_frames, self.representation.scale
        recorded = self.representation.path_of(motion)
        given = item.load_path(fps, n_frames, scale) if self._is_paired else None
        path = smooth_path(given or recorded, fps, n_frames)
        # A table may have another origin; a model only gets the displacements of a path.
        apart = (recorded.positions - path.positions).mean(axis=0)
        return replace(path, positions=path.positions + apart)

    def origin(self, item: Item) -> dict[str, Any]:
        """Return all that the rows of an item depend on."""
        known, conditions = self.representation, self.conditions
        used = {"path": self.config.path, "events": self.config.events}
        tables = item.conditions.items() if self._is_paired else ()
        return {
            **self.rig.origin(item),
            "vectors": [list(known.joints), known.makes_root, known.scale],
            "references": [known.side.tolist(), known.references.tolist()],
            "conditions": conditions.to_values(),
            "path": [conditions.path_mean.tolist(), conditions.path_scale.tolist()],
            "tables": {name: file_fingerprint(path) for name, path in tables if used.get(name)},
            "style": self._style(item),
            "settings": [self.config.fps, self._is_mirrored(item), self._is_paired],
        }

    def _style(self, item: Item) -> str | None:
        return item.style if self.conditions.styles and self._is_paired else None

    def _is_mirrored(self, item: Item) -> bool:
        """Return whether a recording has mirrored copies."""
        styles, style = self.config.styles, self._style(item)
        names = () if styles is None else styles.handed
        handed = any(style in HANDED.get(name, (name,)) for name in names)
        wanted = self.config.augmentation.mirror and not handed
        return wanted and can_be_mirrored(self.representation.skeleton)


def other_side(name: str) -> str:
    """Swap the words left and right (and l and r) in a name: "kickLeft" to "kickRight"."""
    return _WORDS.sub(lambda match: _OTHER_SIDE.get(match[0], match[0]), name)


def mirror_condition(condition: np.ndarray, layout: Conditions) -> np.ndarray:
    """Mirror a condition: negate turn and lateral displacement, and swap left and right events.

    Args:
        condition: (T, C); other columns are kept.
        layout: its columns and the scale of its path.

    Returns:
        (T, C), a copy.

    Raises:
        ConfigError: an event of one side without one of the other side, see `other_side`.
    """
    mirrored, names = condition.copy(), layout.events
    path, events = layout.columns["path"], layout.columns["events"]
    if layout.path:
        sign, offset = np.array([-1.0, 1.0, -1.0]), layout.path_mean / layout.path_scale
        mirrored[:, path] = sign * (condition[:, path] + offset) - offset
    for name, column in zip(names, range(events.start, events.stop), strict=True):
        other = other_side(name)
        if other not in names:
            how = "which is not an event of the corpus; rename it, or train without mirror"
            raise ConfigError(f"event {name!r}: mirrored it would be {other!r}, {how}")
        mirrored[:, column] = condition[:, events.start + names.index(other)]
    return mirrored
