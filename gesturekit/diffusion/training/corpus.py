"""Recordings of a run, read from its corpus."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from gesturekit.corpus.checks import first_difference
from gesturekit.corpus.item import Item
from gesturekit.corpus.manifest import Manifest
from gesturekit.diffusion.config import DiffusionConfig
from gesturekit.diffusion.training.augmentation import phases
from gesturekit.errors import ConfigError, CorpusError, MotionError
from gesturekit.formats.tables.events import Event
from gesturekit.motion.contacts import floor_height
from gesturekit.motion.motion import Motion
from gesturekit.motion.retarget import retarget
from gesturekit.motion.retarget.standing_pose import standing_pose
from gesturekit.motion.skeleton import Skeleton
from gesturekit.training.data.recordings import (
    item_styles,
    load_motions,
    recorded_rate,
    speaker_skeletons,
    training_items,
)
from gesturekit.training.data.sources import Source


@dataclass(frozen=True)
class Corpus:
    """The recordings of a corpus, read from disk.

    Attributes:
        items: with motion; a recording at n times the model's frame rate gives n items.
        motions: of each item, at the model's frame rate.
        events: of each item.
        unpaired: name and motion of recordings without speech, on the rig of the corpus.
        styles: names of the styles.
        seconds: total length of paired and unpaired recordings.
        speakers: a reference skeleton for each named speaker.
        sources: the recordings with speech, or all for a model without speech input.
        recorded_fps: the most common frame rate of the recordings.
    """

    items: list[Item]
    motions: list[Motion]
    events: list[tuple[Event, ...]]
    unpaired: list[tuple[str, Motion]]
    styles: tuple[str, ...]
    seconds: tuple[float, float]
    speakers: dict[str, Skeleton]
    sources: tuple[Source, ...]
    recorded_fps: float


def read_corpus(config: DiffusionConfig, *, paired: bool) -> Corpus:
    """Read the training items of a run; `paired` selects items with both speech and motion.

    Raises:
        CorpusError, ConfigError: see `load_training_data`.
    """
    manifest = Manifest.load(config.corpus)
    items = training_items(manifest, config.corpus, with_audio=paired)
    styles: tuple[str, ...] = ()
    if config.styles is not None:
        styles, _ = item_styles(items, config.corpus)
        _check_handed(config, styles)
    recorded = load_motions(items, config.corpus, config.fps, config.parts)
    unpaired = _unpaired(config, manifest, recorded[0])
    phased, motions = _phases(items, recorded, config.fps)
    events = [item.load_events() if config.events else () for item in phased]
    if config.events and not any(events):
        raise CorpusError(
            f"{config.corpus}: no training item has events; put STEM.events.csv beside the "
            "recordings and run gesturekit prepare again, or train without (events=false)"
        )
    return Corpus(
        phased,
        motions,
        events,
        unpaired,
        styles,
        (sum(m.duration for m in recorded), sum(m.duration for _, m in unpaired)),
        speaker_skeletons(items, recorded),
        tuple(map(Source.of, items, recorded)),
        recorded_rate(recorded),
    )


def _check_handed(config: DiffusionConfig, styles: Sequence[str]) -> None:
    for name in config.styles.handed if config.styles is not None else ():
        if name not in styles:
            raise ConfigError(
                f"styles.handed: {name!r} is not a style of {config.corpus}, which has "
                f"{', '.join(styles)}"
            )


def _unpaired(
    config: DiffusionConfig, manifest: Manifest, usual: Motion
) -> list[tuple[str, Motion]]:
    """Return name and motion of unpaired recordings, on the rig of the corpus."""
    if config.unpaired is None:
        return []
    where = config.unpaired.corpus or config.corpus
    if config.unpaired.corpus is None:
        items = manifest.motion_alone("train")
    else:
        items = training_items(Manifest.load(where), where, with_audio=False)
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
                    f"{where}: item {item.id}: cannot be retargeted to the rig of {config.corpus}: "
                    f"{error}"
                ) from None
            # The floor of a foreign file is unknown; take that of the corpus.
            lift = floor_height(usual) - floor_height(motion)
            motion = replace(motion, translation=motion.translation + [0.0, lift, 0.0])
        found.append((item.id, motion))
    return found


def _phases(
    items: Sequence[Item], motions: Sequence[Motion], fps: float
) -> tuple[list[Item], list[Motion]]:
    """Return items and motions at `fps`; n phases of a recording at n times that rate."""
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
