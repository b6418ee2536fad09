"""Recordings of a run, read from its corpus."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from gesturekit.corpus.checks import first_difference
from gesturekit.corpus.item import Item
from gesturekit.corpus.layouts import HANDED
from gesturekit.corpus.manifest import Manifest
from gesturekit.diffusion.config import DiffusionConfig
from gesturekit.diffusion.training.augmentation import phase_item, phases
from gesturekit.errors import ConfigError, CorpusError, MotionError
from gesturekit.motion.contacts import floor_height
from gesturekit.motion.motion import Motion
from gesturekit.motion.retarget import retarget
from gesturekit.motion.retarget.standing_pose import standing_pose
from gesturekit.training.recordings import (
    Recordings,
    load_recordings,
    motion_origin,
    training_items,
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
        recordings: at the model's frame rate.
        seconds: total length of those that were read.
        items: of the recordings that were read; n times the model's frame rate gives n items.
        motions: of each item, at the model's frame rate.
        events: names of the events of all recordings.
        unpaired: recordings without speech.
        unpaired_rig: what they are read with.
    """

    recordings: Recordings
    seconds: float
    items: list[Item]
    motions: list[Motion]
    events: tuple[str, ...]
    unpaired: tuple[Item, ...]
    unpaired_rig: UnpairedRig


def read_recordings(config: DiffusionConfig, *, speech: bool, trial: bool = False) -> Recordings:
    """Read the training items of a run; with `speech`, those that have speech too.

    Raises:
        CorpusError, ConfigError: see `load_training_data`.
    """
    return load_recordings(
        config,
        config.parts,
        speech=speech,
        styles=config.styles is not None,
        check_styles=lambda styles: _check_handed(config, styles),
        others=lambda manifest: _unpaired(config, manifest),
        trial=trial,
    )


def read_corpus(config: DiffusionConfig, *, speech: bool, trial: bool = False) -> Corpus:
    """Read the recordings of a run with their events; see `read_recordings`."""
    recordings = read_recordings(config, speech=speech, trial=trial)
    rig = UnpairedRig(
        config.corpus, _unpaired_corpus(config), dict(config.parts), recordings.motions[0]
    )
    seconds = sum(motion.duration for motion in recordings.motions)
    items: list[Item] = []
    motions: list[Motion] = []
    for i, item in enumerate(recordings.read):
        found = phases_of(item, recordings.motions[i], config.fps)
        # Motion at the rate of its file is released: that of a large corpus fills memory.
        recordings.motions[i] = found[0][1]
        items += [phase for phase, _ in found]
        motions += [motion for _, motion in found]
    names: set[str] = set()
    if config.events:
        names.update(event.name for item in recordings.items for event in item.load_events())
        if not names:
            raise CorpusError(
                f"{config.corpus}: no training item has events; put STEM.events.csv beside the "
                "recordings and run gesturekit prepare again, or train without (events=false)"
            )
    events = tuple(sorted(names))
    return Corpus(recordings, seconds, items, motions, events, recordings.unpaired, rig)


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


def phases_of(item: Item, motion: Motion, fps: float) -> list[tuple[Item, Motion]]:
    """Return item and motion at `fps` of all phases of a recording at n times that rate."""
    found = enumerate(phases(motion, fps))
    return [(phase_item(item, number, phase.start), phase.motion) for number, phase in found]
