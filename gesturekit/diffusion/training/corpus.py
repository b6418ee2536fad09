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
from gesturekit.training.recordings import Recordings, load_recordings, training_items


@dataclass(frozen=True)
class Corpus:
    """Recordings of a corpus with what the diffusion system adds to them.

    Attributes:
        recordings: at the frame rates of their files.
        items: a recording at n times the model's frame rate gives n items.
        motions: of each item, at the model's frame rate.
        events: of each item.
        unpaired: name and motion of recordings without speech, on the rig of the corpus.
    """

    recordings: Recordings
    items: list[Item]
    motions: list[Motion]
    events: list[tuple[Event, ...]]
    unpaired: list[tuple[str, Motion]]

    @property
    def seconds(self) -> tuple[float, float]:
        """Total length of paired and of unpaired recordings."""
        paired = sum(motion.duration for motion in self.recordings.motions)
        return paired, sum(motion.duration for _, motion in self.unpaired)


def read_corpus(config: DiffusionConfig, *, speech: bool) -> Corpus:
    """Read the training items of a run; with `speech`, those that have speech too.

    Raises:
        CorpusError, ConfigError: see `load_training_data`.
    """
    recordings = load_recordings(
        config,
        config.parts,
        speech=speech,
        styles=config.styles is not None,
        check_styles=lambda styles: _check_handed(config, styles),
    )
    unpaired = _unpaired(config, recordings.manifest, recordings.motions[0])
    items, motions = _phases(recordings.items, recordings.motions, config.fps)
    events = [item.load_events() if config.events else () for item in items]
    if config.events and not any(events):
        raise CorpusError(
            f"{config.corpus}: no training item has events; put STEM.events.csv beside the "
            "recordings and run gesturekit prepare again, or train without (events=false)"
        )
    return Corpus(recordings, items, motions, events, unpaired)


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
