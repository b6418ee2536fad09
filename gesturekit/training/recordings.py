"""Recordings of a run: items of its corpus with motion of one rig, styles and speakers.

Both systems load their corpus by `load_recordings`; each adds its own to what that returns.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mode
from typing import Any

import numpy as np
import torch

from gesturekit.corpus.checks import first_difference
from gesturekit.corpus.manifest import Item, Manifest, file_fingerprint
from gesturekit.corpus.takes import neighbours
from gesturekit.errors import ConfigError, CorpusError, MotionError
from gesturekit.formats.smpl import mean_body, on_body
from gesturekit.motion.model_joints import reference_skeleton
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import find_parts
from gesturekit.motion.skeleton import Skeleton
from gesturekit.training.origin import TrainedSegment
from gesturekit.training.run_config import RunConfig
from gesturekit.training.seeds import rng_for
from gesturekit.wording import counted, listed

log = logging.getLogger(__name__)

_FAR_ABOVE = 1.5
"""Frame rate of the training, as a multiple of the recordings' highest, above which to warn."""


TRIAL_SECONDS = 30.0
"""Length of the excerpt of the corpus that a trial has."""


_LONGEST, _SHORTEST = 60.0, 10.0
"""Seconds of an excerpt: many short ones cover more takes, long ones show how movement changes
within a take."""


@dataclass(frozen=True)
class Excerpt:
    """Part of an item.

    Attributes:
        index: of the item among those of the corpus.
        start: seconds from the item's start.
        duration: seconds.
    """

    index: int
    start: float
    duration: float

    def of(self, items: Sequence[Item]) -> Item:
        """Return the excerpt as an item of its own."""
        item = items[self.index]
        return replace(
            item,
            motion_start=item.motion_start + self.start,
            audio_start=item.audio_start + self.start,
            duration=self.duration,
        )

    def frames(self, fps: float, n_frames: int) -> tuple[int, int]:
        """Return first frame and end of the excerpt of an item that has `n_frames`."""
        length = min(n_frames, max(1, math.floor(self.duration * fps + 0.5)))
        start = min(round(self.start * fps), n_frames - length)
        return start, start + length


def systematic_sample(
    items: Sequence[Item], seconds: float, *, seed: int = 0, every_group: bool = True
) -> list[Excerpt]:
    """Return excerpts of about `seconds` in total, spread over speakers, styles and takes.

    All recordings are laid end to end, in the order of speaker, style and take, and excerpts begin
    at equal distances from a random first place (a systematic sample). So each second is as likely
    as any other to be in the sample, and each part of the corpus has its share of it.

    Args:
        items: of the corpus.
        seconds: total length of the sample; a shorter corpus is returned whole.
        seed: of the first place; the same in all runs, so that they share arrays.
        every_group: add one excerpt of each speaker and style that would be missed.
    """
    total = sum(item.duration for item in items)
    if total <= seconds:
        return [Excerpt(i, 0.0, item.duration) for i, item in enumerate(items)]
    order = sorted(range(len(items)), key=lambda i: (*_group(items[i]), items[i].take, items[i].id))
    groups = {_group(item) for item in items}
    length = min(_LONGEST, max(_SHORTEST, seconds / len(groups)))
    # Items shorter than an excerpt are taken whole, so that more excerpts fit.
    usual = sum(item.duration * min(length, item.duration) for item in items) / total
    step = total / max(1, round(seconds / usual))
    first = step * float(torch.rand((), generator=rng_for(seed, "sample of the corpus")))
    ends = np.cumsum([items[i].duration for i in order])
    places = first + step * np.arange(math.ceil(total / step) + 1)
    chosen = []
    for place in places[places < ends[-1]].tolist():
        k = int(np.searchsorted(ends, place, side="right"))
        part = min(length, items[order[k]].duration)
        start = place - float(ends[k - 1]) if k else place
        chosen.append(Excerpt(order[k], min(start, items[order[k]].duration - part), part))
    missed = groups - {_group(items[excerpt.index]) for excerpt in chosen} if every_group else set()
    for i in order:
        if _group(items[i]) in missed:
            missed.discard(_group(items[i]))
            chosen.append(Excerpt(i, 0.0, min(length, items[i].duration)))
    return sorted(set(chosen), key=lambda excerpt: (excerpt.index, excerpt.start))


def _group(item: Item) -> tuple[str, str]:
    return item.speaker or "", item.style or ""


@dataclass(frozen=True, eq=False)
class Recordings:
    """Training recordings of a corpus, all of one rig.

    Attributes:
        items: with motion, and with audio if speech is an input.
        excerpts: those that were read of a corpus longer than `RunConfig.in_memory`; None if all
            items were read.
        motions: of each item or excerpt, at its file's frame rate.
        styles: names of the styles, in alphabetical order; empty for a model without styles.
        style_of: index of each item's style; 0 without styles.
        unpaired: items of speech without motion, or `others` of `load_recordings`.
        whole: all items of the corpus with motion, and those without; others than `items` and
            `unpaired` in a trial, which has an excerpt of the corpus only.
    """

    items: tuple[Item, ...]
    excerpts: tuple[Excerpt, ...] | None
    motions: list[Motion]
    styles: tuple[str, ...]
    style_of: list[int]
    unpaired: tuple[Item, ...]
    whole: tuple[tuple[Item, ...], tuple[Item, ...]]

    @property
    def read(self) -> tuple[Item, ...]:
        """Items or excerpts whose motion was read."""
        if self.excerpts is None:
            return self.items
        return tuple(excerpt.of(self.items) for excerpt in self.excerpts)

    @property
    def rates(self) -> list[float]:
        """Frame rate of each file that was read."""
        return [motion.info["recorded_fps"] for motion in self.motions]

    @property
    def recorded_fps(self) -> float:
        """Most common frame rate of the files."""
        return mode(self.rates)

    @property
    def lengths(self) -> tuple[float, float]:
        """Seconds of the whole corpus: of items with motion, and of those without."""
        first, second = (sum(item.duration for item in items) for items in self.whole)
        return first, second

    def is_long(self, config: RunConfig) -> bool:
        """Return True if the corpus is longer than what is held in memory."""
        return sum(self.lengths) > 60 * config.in_memory

    @property
    def speakers(self) -> dict[str, Skeleton]:
        """Reference skeleton of each speaker that the corpus names."""
        motions: dict[str, list[Motion]] = {}
        for item, motion in zip(self.read, self.motions, strict=True):
            if item.speaker is not None:
                motions.setdefault(item.speaker, []).append(motion)
        return {name: reference_skeleton(theirs) for name, theirs in motions.items()}

    def sources(self, rates: Sequence[float]) -> tuple[TrainedSegment, ...]:
        """Return the record of the items, with the frame rates of their files, for the model
        folder; in a trial, of the whole corpus without the content of its files."""
        if self.whole[0] is self.items:
            return tuple(map(TrainedSegment.of, self.items, rates))
        rate = self.recorded_fps
        return tuple(TrainedSegment.of(item, rate, read=False) for item in self.whole[0])

    def rig(self, config: RunConfig, parts: Mapping[str, str]) -> Rig:
        """Return what motion of the other items is read with; `parts` as in `load_motions`."""
        bodies = {
            item.speaker: motion.skeleton
            for item, motion in zip(self.read, self.motions, strict=True)
            if motion.skeleton.body_shape is not None
        }
        return Rig(config.corpus, dict(parts), self.motions[0].skeleton, bodies)


def motion_origin(item: Item) -> dict[str, Any]:
    """Return all that `Item.load_motion` depends on beside body parts, as plain values."""
    assert item.motion is not None
    return {
        "motion": file_fingerprint(item.motion),
        "interval": [item.motion_start, item.duration],
        "mirror": item.mirror,
        "reading": dict(item.reading),
    }


@dataclass(frozen=True, eq=False)
class Rig:
    """The rig of a corpus, on which its motion is read item by item.

    Attributes:
        corpus: the manifest, for messages.
        parts: joints of body parts, see `Skeleton.parts`.
        skeleton: of one recording.
        bodies: the body shape of each speaker; empty on a rig without body shapes.
    """

    corpus: Path
    parts: dict[str, str]
    skeleton: Skeleton
    bodies: dict[str | None, Skeleton]

    def load(self, item: Item) -> Motion:
        """Read the motion of an item at its file's frame rate, on its speaker's body.

        Raises:
            CorpusError, ConfigError, FormatError: see `load_motions`.
        """
        motion = _load(item, self.parts, self.skeleton, self.corpus)
        body = self.bodies.get(item.speaker)
        return motion if body is None else on_body(motion, body)

    def origin(self, item: Item) -> dict[str, Any]:
        """Return all that the motion of an item depends on, as plain values."""
        body = self.bodies.get(item.speaker)
        return {
            **motion_origin(item),
            "parts": self.parts,
            "rig": [list(self.skeleton.names), list(self.skeleton.parents)],
            "body": None if body is None else [float(beta) for beta in body.body_shape.betas],
        }


def load_recordings(
    config: RunConfig,
    parts: Mapping[str, str],
    *,
    speech: bool,
    styles: bool,
    check_styles: Callable[[Sequence[str]], object] = lambda styles: None,
    others: Callable[[Manifest], Sequence[Item]] | None = None,
    trial: bool = False,
) -> Recordings:
    """Read the items of split train, their styles and their motion.

    Args:
        config: of the run.
        parts: joints of body parts, see `Skeleton.parts`.
        speech: whether speech is an input.
        styles: whether styles are a condition.
        check_styles: called with the names of the styles before motion is read.
        others: returns further items, whose length counts towards `RunConfig.in_memory`; by default
            those of unpaired speech, if speech is an input.
        trial: read an excerpt of the corpus only, to time a few steps on it.

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
    unpaired = manifest.unpaired("train") if speech else ()
    if others is not None:
        unpaired = tuple(others(manifest))
    whole = (items, unpaired)
    if trial:
        chosen = systematic_sample(items, TRIAL_SECONDS, every_group=False)
        others_chosen = systematic_sample(unpaired, TRIAL_SECONDS, every_group=False)
        items = tuple(excerpt.of(items) for excerpt in chosen)
        unpaired = tuple(excerpt.of(unpaired) for excerpt in others_chosen)
        style_of = [style_of[excerpt.index] for excerpt in chosen]
    loaded = Recordings(items, None, [], names, style_of, unpaired, whole)
    if loaded.is_long(config) and not trial:
        excerpts = tuple(systematic_sample(items, 60 * config.in_memory))
        loaded = replace(loaded, excerpts=excerpts)
    # In a trial hours of files are not read.
    if changed := sorted({str(file) for item in items for file in item.changed_files}):
        log.warning(
            "%s: %s changed since gesturekit prepare, and may not be what it checked: %s; run it "
            "again",
            *(config.corpus, counted(len(changed), "file"), listed(changed, 4)),
        )
    name, count = str(config.corpus), counted(len(whole[0]), "recording")
    if len(items) < len(whole[0]):
        name += f" (an excerpt of it, {len(items)} of {count})"
    return replace(loaded, motions=load_motions(loaded.read, name, config.fps, parts))


def training_items(manifest: Manifest, corpus: Path, *, with_audio: bool) -> tuple[Item, ...]:
    """Return items of split train: pairs if speech is an input, else all with motion.

    Raises:
        CorpusError: there are none.
    """
    items = manifest.paired("train")
    lacking = (
        "both audio and motion; run gesturekit prepare on a folder of wav + BVH pairs, or train "
        "without speech (features=null)"
    )
    if not with_audio:
        items = tuple(i for i in manifest if i.split == "train" and i.motion is not None)
        lacking = "motion; run gesturekit prepare --unpaired-motion on a folder of BVH files"
    if not items:
        raise CorpusError(f"{corpus}: no item of split train has {lacking}")
    return items


def item_styles(items: Sequence[Item], corpus: Path) -> tuple[tuple[str, ...], list[int]]:
    """Return style names, in alphabetical order, and the style index of each item.

    Raises:
        CorpusError: an item without style.
    """
    named = [item.style for item in items if item.style is not None]
    if len(named) < len(items):
        nameless = next(item.id for item in items if item.style is None)
        raise CorpusError(
            f"{corpus}: item {nameless} has no style ({len(items) - len(named)} have none); "
            "gesturekit prepare --style-pattern takes styles from file names"
        )
    styles = tuple(sorted({*named}))
    return styles, [*map(styles.index, named)]


def load_motions(
    items: Sequence[Item], corpus: Path | str, fps: float, parts: Mapping[str, str]
) -> list[Motion]:
    """Return the motion of each item at its file's frame rate, `info["recorded_fps"]`.

    Each speaker has one body shape, the mean of the recorded ones; if these differ, a warning is
    logged.

    Args:
        items: with motion.
        corpus: name of the manifest in messages.
        fps: frame rate of the training; one that is far above all files' gets a warning.
        parts: joints of body parts, see `Skeleton.parts`.

    Raises:
        CorpusError: rigs that differ, or a file that is not as long as its item.
        ConfigError: `parts` names a joint that is not there.
        FormatError: a file cannot be read.
    """
    motions: list[Motion] = []
    for item in items:
        motions.append(_load(item, parts, motions[0].skeleton if motions else None, corpus))
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
            *(fps, highest),
        )
    return _with_one_body_each(items, motions, corpus)


def _load(
    item: Item, parts: Mapping[str, str], usual: Skeleton | None, corpus: Path | str
) -> Motion:
    """Read the motion of an item at its file's frame rate, and check that it has the usual rig."""
    try:
        motion = item.load_motion(parts)
    except MotionError as error:
        raise ConfigError(f"parts: item {item.id}: {error}") from None
    if usual is not None and (different := first_difference(motion.skeleton, usual)):
        raise CorpusError(f"{corpus}: item {item.id}: another skeleton: {different}")
    motion.info["recorded_fps"] = motion.fps
    return motion


def _with_one_body_each(
    items: Sequence[Item], motions: Sequence[Motion], corpus: Path | str
) -> list[Motion]:
    """Return the motions with one body shape for each speaker, the mean of the recorded ones.

    Recordings without a speaker are taken to be of one person.
    """
    numbers_of: dict[str | None, list[int]] = {}
    for k, item in enumerate(items):
        numbers_of.setdefault(item.speaker, []).append(k)
    on_bodies = list(motions)
    for speaker, numbers in numbers_of.items():
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
            *(corpus, counted(len(numbers), "recording"), who, len(shapes), among),
            f", as {body.body_shape.gender or 'neutral'}" if among else "",
        )
        for k in numbers:
            on_bodies[k] = on_body(motions[k], body)
    return on_bodies
