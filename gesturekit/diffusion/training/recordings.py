"""Recordings of a run: read from its corpus, and as motion vectors and conditions.

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
from gesturekit.corpus.item import Item, file_fingerprint
from gesturekit.corpus.layouts import HANDED
from gesturekit.corpus.manifest import Manifest
from gesturekit.corpus.speech import style_track
from gesturekit.diffusion.conditions import Conditions, smooth_path
from gesturekit.diffusion.config import DiffusionConfig
from gesturekit.diffusion.motion_vector import DeltaRepresentation
from gesturekit.errors import ConfigError, CorpusError, MotionError
from gesturekit.motion.contacts import floor_height
from gesturekit.motion.motion import Motion, can_be_mirrored
from gesturekit.motion.retarget import retarget
from gesturekit.motion.retarget.body_frames import standing_pose
from gesturekit.motion.root_path import RootPath, follow_path
from gesturekit.training.recordings import (
    Excerpt,
    Recordings,
    Rig,
    load_recordings,
    motion_origin,
    systematic_sample,
    training_items,
)

_WORDS = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|[^A-Za-z]+|[A-Z]")
_OTHER_SIDE = {"left": "right", "right": "left", "l": "r", "r": "l"}


class Recording(NamedTuple):
    """A recording at the model's frame rate.

    Attributes:
        item: of the manifest.
        fps: frame rate of its file.
        seconds: its length.
        phases: items and motions; n of a recording at n times the model's frame rate.
    """

    item: Item
    fps: float
    seconds: float
    phases: list[tuple[Item, Motion]]

    @classmethod
    def of(cls, item: Item, motion: Motion, fps: float) -> Recording:
        """Resample a motion to `fps`; at n times that rate, take all n decimations of it.

        The first phase is `motion.resample(fps)`. The others start later, and so do their speech,
        path and events.
        """
        ratio = motion.fps / fps
        n = round(ratio) if abs(ratio - round(ratio)) < 1e-6 * ratio else 1
        phases = [(item, motion.resample(fps))]
        for k in range(1, min(n, motion.n_frames)):
            phase = phase_item(item, k, k / motion.fps)
            phases.append((phase, motion[k:].resample(fps)))
        return cls(item, motion.fps, motion.duration, phases)


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
        corpus: the manifest of the run, for messages.
        source: that of the unpaired motion.
        parts: joints of body parts, see `Skeleton.parts`.
        usual: a recording of the corpus.
    """

    corpus: Path
    source: Path
    parts: dict[str, str]
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
            rig = self.usual.skeleton.with_parts(self.parts)
            motion = retarget(motion, rig, pose=self._standing_pose)
            motion = replace(motion, skeleton=self.usual.skeleton)
        except MotionError as error:
            raise CorpusError(
                f"{self.source}: item {item.id}: cannot be retargeted to the rig of {self.corpus}: "
                f"{error}"
            ) from None
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
            "parts": self.parts,
            "rig": [list(skeleton.names), list(skeleton.parents), usual.hexdigest()],
        }

    @cached_property
    def _standing_pose(self) -> np.ndarray:
        return standing_pose(self.usual)

    @cached_property
    def _floor_height(self) -> float:
        return floor_height(self.usual)


@dataclass(frozen=True)
class Corpus:
    """Recordings of a corpus with what the diffusion system adds to them.

    Attributes:
        recordings: of which `motions` are not used any more.
        read: the recordings or excerpts that were read.
        events: names of the events of all recordings.
        unpaired_rig: reads the recordings without speech.
        unpaired_excerpts: a sample of these; all of them, whole, of a corpus held in memory.
        unpaired: the excerpts that were read: all in memory, and of a long corpus those that a path
            condition is fitted to.
    """

    recordings: Recordings
    read: list[Recording]
    events: tuple[str, ...]
    unpaired_rig: UnpairedRig
    unpaired_excerpts: list[Excerpt]
    unpaired: list[Recording]

    @property
    def is_in_memory(self) -> bool:
        """Return True if all recordings were read."""
        return self.recordings.excerpts is None

    @property
    def phases(self) -> list[tuple[Item, Motion]]:
        """Items and motions of all that was read."""
        return [phase for recording in self.read for phase in recording.phases]


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
    motions, read = recordings.motions, []
    rig = UnpairedRig(config.corpus, _unpaired_corpus(config), dict(config.parts), motions[0])
    for i, item in enumerate(recordings.read):
        read.append(Recording.of(item, motions[i], config.fps))
        # Motion at the rate of its file is released: that of a large corpus fills memory.
        motions[i] = read[-1].phases[0][1]
    excerpts, unpaired = systematic_sample(recordings.unpaired, 60 * config.in_memory), []
    if recordings.excerpts is None or (config.path and config.start_from is None):
        for item in (excerpt.of(recordings.unpaired) for excerpt in excerpts):
            unpaired.append(Recording.of(item, rig.load(item), config.fps))
    names: set[str] = set()
    if config.events:
        names.update(event.name for item in recordings.items for event in item.load_events())
        if not names:
            raise CorpusError(
                f"{config.corpus}: no training item has events; put STEM.events.csv beside the "
                "recordings and run gesturekit prepare again, or train without (events=false)"
            )
    return Corpus(recordings, read, tuple(sorted(names)), rig, excerpts, unpaired)


def _check_handed(config: DiffusionConfig, styles: Sequence[str]) -> None:
    for name in config.styles.handed if config.styles is not None else ():
        if name not in styles and name not in HANDED:
            raise ConfigError(
                f"styles.handed: {name!r} is not a style of {config.corpus}, which has "
                f"{', '.join(styles)}"
            )


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
        raise CorpusError(
            f"{where}: no item of split train is motion alone; name a manifest of motion by "
            "unpaired.corpus, or train without (unpaired=null)"
        )
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
        return self.encode(Recording.of(item, self.rig.load(item), self.config.fps))

    def encode(self, recording: Recording) -> tuple[np.ndarray, dict[str, Any]]:
        """Return the rows (N, X + W) float32 of all variants of a recording, and facts of them."""
        is_mirrored = self._is_mirrored(recording.item)
        plain, mirrored = [], []
        for item, motion in recording.phases:
            path = None
            if self.config.path:
                path = self.path(item, motion)
                motion = follow_path(motion, path, self.representation.root)
            vectors = self._vectors(item, motion, path)
            condition = self._condition(item, motion.n_frames, path)
            plain.append(np.concatenate([vectors, condition], axis=1))
            if is_mirrored:
                other_path = None if path is None else path.mirror()
                vectors = self._vectors(item, motion.mirror(), other_path)
                condition = mirror_condition(condition, self.conditions)
                mirrored.append(np.concatenate([vectors, condition], axis=1))
        return np.concatenate([*plain, *mirrored]), {
            "id": recording.item.id,
            "fps": recording.fps,
            "seconds": recording.seconds,
            "starts": [k / recording.fps for k in range(len(plain))],
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
        tables = [name for name, is_used in used.items() if is_used and self._is_paired]
        return {
            **self.rig.origin(item),
            "vectors": [list(known.joints), known.makes_root, known.scale],
            "references": [known.side.tolist(), known.references.tolist()],
            "conditions": conditions.to_values(),
            "path": [conditions.path_mean.tolist(), conditions.path_scale.tolist()],
            "tables": {
                name: file_fingerprint(item.conditions[name])
                for name in tables
                if name in item.conditions
            },
            "style": self._style(item),
            "settings": [self.config.fps, self._is_mirrored(item), self._is_paired],
        }

    def _style(self, item: Item) -> str | None:
        return item.style if self.conditions.styles and self._is_paired else None

    def _is_mirrored(self, item: Item) -> bool:
        """Return whether a recording has mirrored copies."""
        styles = self.config.styles
        handed = styles is not None and styles.is_handed(self._style(item))
        wanted = self.config.augmentation.mirror and not handed
        return wanted and can_be_mirrored(self.representation.skeleton)

    def _vectors(self, item: Item, motion: Motion, path: RootPath | None) -> np.ndarray:
        """Return motion vectors (T, X) float32."""
        try:
            return self.representation.encode(motion, path).astype(np.float32)
        except MotionError as error:
            raise CorpusError(f"{self.config.corpus}: item {item.id}: {error}") from None

    def _condition(self, item: Item, n_frames: int, path: RootPath | None) -> np.ndarray:
        """Return the condition (T, W) float32 beside speech."""
        fps, name = self.config.fps, self._style(item)
        style = None
        if name is not None:
            style = style_track(self.conditions.styles, name, n_frames, fps)
        events = item.load_events() if self.config.events and self._is_paired else ()
        scaled = None if path is None else path.scaled(1 / self.representation.scale)
        return self.conditions.encode(n_frames, fps, path=scaled, events=events, style=style)


def other_side(name: str) -> str:
    """Swap the words left and right (and l and r) in a name: "kickLeft" to "kickRight"."""

    def swap(match: re.Match[str]) -> str:
        word = match[0]
        other = _OTHER_SIDE.get(word.lower(), word)
        if other == word:
            return word
        return other.upper() if word.isupper() else other.title() if word[0].isupper() else other

    return _WORDS.sub(swap, name)


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
            raise ConfigError(
                f"event {name!r}: mirrored it would be {other!r}, which is not an event of the "
                "corpus; rename it, or train without mirror"
            )
        mirrored[:, column] = condition[:, events.start + names.index(other)]
    return mirrored
