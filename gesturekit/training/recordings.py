"""Recordings of a run: items of its corpus with motion of one rig, styles and speakers.

Both systems load their corpus by `load_recordings`; each adds its own to what that returns.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from gesturekit.corpus.checks import first_difference
from gesturekit.corpus.item import Item
from gesturekit.corpus.manifest import Manifest
from gesturekit.corpus.takes import neighbours
from gesturekit.errors import ConfigError, CorpusError, MotionError
from gesturekit.formats.smpl.skeleton import mean_body, on_body
from gesturekit.motion.model_joints import reference_skeleton
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import find_parts
from gesturekit.motion.skeleton import Skeleton
from gesturekit.training.data.sources import TrainedSegment
from gesturekit.training.run_config import RunConfig
from gesturekit.wording import counted, listed

log = logging.getLogger(__name__)

_FAR_ABOVE = 1.5
"""Frame rate of the training, as a multiple of the recordings' highest, above which to warn."""


@dataclass(frozen=True, eq=False)
class Recordings:
    """Training recordings of a corpus, all of one rig.

    Attributes:
        manifest: of the corpus.
        items: with motion, and with audio if speech is an input.
        motions: of each item, at its file's frame rate.
        styles: names of the styles, in alphabetical order; empty for a model without styles.
        style_of: index of each item's style; 0 without styles.
    """

    manifest: Manifest
    items: tuple[Item, ...]
    motions: list[Motion]
    styles: tuple[str, ...]
    style_of: list[int]

    @property
    def recorded_fps(self) -> float:
        """Most common frame rate of the files."""
        rates = Counter(motion.info["recorded_fps"] for motion in self.motions)
        return rates.most_common(1)[0][0]

    @property
    def speakers(self) -> dict[str, Skeleton]:
        """Reference skeleton of each speaker that the corpus names."""
        own: dict[str, list[Motion]] = {}
        for item, motion in zip(self.items, self.motions, strict=True):
            if item.speaker is not None:
                own.setdefault(item.speaker, []).append(motion)
        return {name: reference_skeleton(theirs) for name, theirs in own.items()}

    @property
    def sources(self) -> tuple[TrainedSegment, ...]:
        """Record of the recordings for the model folder."""
        return tuple(map(TrainedSegment.of, self.items, self.motions))


def load_recordings(
    config: RunConfig,
    parts: Mapping[str, str],
    *,
    speech: bool,
    styles: bool,
    check_styles: Callable[[Sequence[str]], object] = lambda styles: None,
) -> Recordings:
    """Read the items of split train, their styles and their motion.

    Args:
        config: of the run.
        parts: joints of body parts, see `Skeleton.parts`.
        speech: whether speech is an input.
        styles: whether styles are a condition.
        check_styles: called with the names of the styles before motion is read.

    Raises:
        CorpusError: no training item with what the run needs, an item without style, rigs that
            differ, or a file that is not as long as its item.
        ConfigError: `parts` names a joint that is not there.
        FormatError: a file cannot be read.
    """
    manifest = Manifest.load(config.corpus)
    if beside := neighbours(manifest):
        log.warning("%s: %s.", config.corpus, beside)
    items = training_items(manifest, config.corpus, with_audio=speech)
    names, style_of = item_styles(items, config.corpus) if styles else ((), [0] * len(items))
    check_styles(names)
    motions = load_motions(items, config.corpus, config.fps, parts)
    return Recordings(manifest, items, motions, names, style_of)


def training_items(manifest: Manifest, corpus: Path, *, with_audio: bool) -> tuple[Item, ...]:
    """Return items of split train: pairs if speech is an input, else all with motion.

    Raises:
        CorpusError: there are none.
    """
    if with_audio:
        items = manifest.paired("train")
        if not items:
            raise CorpusError(
                f"{corpus}: no item of split train has both audio and motion; run "
                "gesturekit prepare on a folder of wav + BVH pairs, or train without speech "
                "(features=null)"
            )
        return items
    items = tuple(item for item in manifest if item.split == "train" and item.motion is not None)
    if not items:
        raise CorpusError(
            f"{corpus}: no item of split train has motion; "
            "run gesturekit prepare --unpaired-motion on a folder of BVH files"
        )
    return items


def item_styles(items: Sequence[Item], corpus: Path) -> tuple[tuple[str, ...], list[int]]:
    """Return style names, in alphabetical order, and the style index of each item.

    Raises:
        CorpusError: an item without style.
    """
    nameless = [item.id for item in items if item.style is None]
    if nameless:
        raise CorpusError(
            f"{corpus}: item {nameless[0]} has no style ({len(nameless)} have none); "
            "gesturekit prepare --style-pattern takes styles from file names"
        )
    styles = tuple(sorted({item.style for item in items if item.style is not None}))
    return styles, [styles.index(item.style) for item in items if item.style is not None]


def load_motions(
    items: Sequence[Item], corpus: Path, fps: float, parts: Mapping[str, str]
) -> list[Motion]:
    """Return the motion of each item at its file's frame rate, `info["recorded_fps"]`.

    Each speaker has one body shape, the mean of the recorded ones; if these differ, a warning is
    logged.

    Args:
        items: with motion.
        corpus: the manifest, for messages.
        fps: frame rate of the training; one that is far above all files' gets a warning.
        parts: joints of body parts, see `Skeleton.parts`.

    Raises:
        CorpusError: rigs that differ, or a file that is not as long as its item.
        ConfigError: `parts` names a joint that is not there.
        FormatError: a file cannot be read.
    """
    motions = []
    for item in items:
        try:
            motion = item.load_motion(parts)
            motion.info["recorded_fps"] = motion.fps
            motions.append(motion)
        except MotionError as error:
            raise ConfigError(f"parts: item {item.id}: {error}") from None
        different = first_difference(motions[-1].skeleton, motions[0].skeleton)
        if different:
            raise CorpusError(f"{corpus}: item {item.id}: another skeleton: {different}")
    if parts:
        try:
            find_parts(motions[0].skeleton)
        except MotionError as error:
            log.warning("parts: %s", error)
    highest = max(motion.fps for motion in motions)
    if fps > _FAR_ABOVE * highest:
        log.warning(
            "fps: %g is far above the recordings' %g: training takes more time and memory, and "
            "the motion gains no detail",
            fps,
            highest,
        )
    return _with_one_body_each(items, motions, corpus)


def _with_one_body_each(
    items: Sequence[Item], motions: Sequence[Motion], corpus: Path
) -> list[Motion]:
    """Return the motions with one body shape for each speaker, the mean of the recorded ones.

    Recordings without a speaker are taken to be of one person.
    """
    own: dict[str | None, list[int]] = {}
    for k, item in enumerate(items):
        own.setdefault(item.speaker, []).append(k)
    found = list(motions)
    for speaker, numbers in own.items():
        shapes = {motions[k].skeleton.body_shape for k in numbers}
        if len(shapes) == 1:
            continue
        body = mean_body([motions[k].skeleton for k in numbers])
        who = f"speaker {speaker}"
        if speaker is None:
            who = "an unnamed speaker (gesturekit prepare --speaker or --style-pattern names them)"
        genders = sorted({shape.gender for shape in shapes if shape.gender is not None})
        among = f" and genders {listed(genders)}" if len(genders) > 1 else ""
        log.warning(
            "%s: %s of %s have %d body shapes%s; the mean of their betas is used%s",
            corpus,
            counted(len(numbers), "recording"),
            who,
            len(shapes),
            among,
            f", as {body.body_shape.gender}" if among else "",
        )
        for k in numbers:
            found[k] = on_body(motions[k], body)
    return found
