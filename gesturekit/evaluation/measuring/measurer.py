"""Measurements of clips and sets, with the keys by which it is stored."""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from audio_features import AudioFeaturesError
from gesturekit.errors import GestureKitError
from gesturekit.evaluation.definitions import FRECHET, POOLED, SPEECH
from gesturekit.evaluation.measuring.ceilings import ceilings
from gesturekit.evaluation.measuring.clip_metrics import ClipMetrics
from gesturekit.evaluation.measuring.clips import (
    Clip,
    clip_notes,
    load_clip,
    load_recording,
    load_sound,
)
from gesturekit.evaluation.measuring.content import (
    Store,
    content_of,
    digest_of,
    metric_version,
)
from gesturekit.evaluation.measuring.likeness import LikenessMeasurer
from gesturekit.evaluation.measuring.pooled import PooledMetrics, Window
from gesturekit.evaluation.measuring.samples import MotionSample
from gesturekit.evaluation.measuring.set_metrics import (
    SetMetrics,
    pooled,
    speeds_of,
    thinned,
    wrists_of,
)
from gesturekit.evaluation.measuring.speakers import TrainingMotion
from gesturekit.evaluation.metrics.distributions import SpeedHistogram
from gesturekit.evaluation.pairs import ItemInterval, Items, Pair, recordings
from gesturekit.evaluation.results import ClipResult, GroupLikeness, Interval, Level, MetricResult
from gesturekit.evaluation.statistics.levels import OTHER_SOUND

if TYPE_CHECKING:
    from gesturekit.evaluation.metrics.frechet.feature_model import Extractor


MISMATCHED = 3
"""Number of other recordings that a clip is also compared with, for the mismatched level."""
PARTS = ("frechet", "pooled")
"""Halves of the metrics of a set, which are computed independently."""


@dataclass(frozen=True)
class ClipGroup:
    """Indices of clips of one recording, of all models: {label: indices into its pairs}."""

    clips: Mapping[str, Sequence[int]]


@dataclass(frozen=True)
class SetPart:
    """One part of the metrics of the set of clips of one model."""

    label: str
    part: str


Portion = ClipGroup | tuple[SetPart, ...]
"""Portion that one process measures: clips of a recording, or sets one after the other."""


@dataclass(eq=False)
class Measurer:
    """Measures clips and sets; it is handed to worker processes.

    Attributes:
        measure: the metrics of single clips; its statistics need no motion.
        pairs: clips of each model by label, in order.
        recordings: sources of the recordings that can be read, by key.
        reference: the recordings as given, which may have training motion.
        fps: frame rate of all metrics.
        length: expected length of a clip relative to its recording.
        features: the extractor of FGD, or None.
        seed: seed of intervals and subsamples.
        without: bare names of joints that some model lacks, which no model is measured with.
        local: labels of models whose motion is made in memory.
        takes: takes of recordings by name; others have those of `Pair`.
    """

    measure: ClipMetrics
    pairs: Mapping[str, Sequence[Pair]]
    recordings: Mapping[str, Path | ItemInterval]
    reference: Path | Items
    fps: float
    length: float
    features: Extractor | None
    seed: int
    without: frozenset[str] = frozenset()
    local: frozenset[str] = frozenset()
    takes: Mapping[str, str] = field(default_factory=dict)
    _own: dict[tuple[Window, tuple[str, ...]], dict[str, float]] = field(
        default_factory=dict, init=False
    )
    _of_recordings: dict[Hashable, Any] = field(default_factory=dict, init=False)
    _contents: dict[Pair, str | None] = field(default_factory=dict, init=False)

    def __call__(self, portion: Portion) -> list[Any]:
        """Return the results of a portion, which are stored as well; see `clip` and `set`.

        Sums of floating-point numbers depend on the number of threads: each process has one.
        """
        from threadpoolctl import threadpool_limits

        with threadpool_limits(1):
            if not isinstance(portion, ClipGroup):
                return [self.set(one) for one in portion]
            self._own.clear()
            return [(key, i, self.clip(key, i)) for key, at in portion.clips.items() for i in at]

    def clip(self, label: str, index: int) -> dict[str, Any]:
        """Measure a clip; a clip that cannot be read is {"reason": text}."""
        pair = self.pairs[label][index]
        try:
            clip = load_clip(pair, self.fps, self.without)
        except (GestureKitError, AudioFeaturesError) as error:
            return {"reason": str(error)}
        metrics, problems = self.measure.generated(clip)
        window = (pair.stem, pair.window), clip.joints
        if window not in self._own:
            self._own[window] = self._recorded(clip, label)
        values = {
            "seconds": clip.generated.duration,
            "metrics": metrics,
            "recording": self._own[window],
            "mismatched": self._mismatched(clip, label),
            "notes": [*clip.notes, *clip_notes(clip, self.length)],
            "problems": problems,
        }
        self.store.write(self.clip_key(label, index), values)
        return values

    def _recorded(self, clip: Clip, label: str) -> dict[str, float]:
        """Measure the recording of a clip, also in time with other recordings' sounds."""
        values = self.measure.recording(clip)[0]
        own = replace(clip, generated=clip.recording)
        mismatched = self._mismatched_sound(own, label).get("in_time")
        return values if mismatched is None else {**values, OTHER_SOUND: mismatched}

    def set(self, portion: SetPart) -> dict[str, Any]:
        """Compute one part of the metrics of a model's clips."""
        groups = self.measure.groups
        groups = [g for g in groups if (g == FRECHET) == (portion.part == "frechet")]
        measure = replace(self.measure, groups=groups)
        training = TrainingMotion()
        if POOLED in groups:
            training = TrainingMotion.of(self.reference, self.seed)
        clip_set = SetMetrics(
            measure, self.seed, PooledMetrics(training, self.seed, self._of_recordings)
        )
        recorded, speeds, wrists = MotionSample(self.seed), {}, {}
        for pair in self.pairs[portion.label] if groups else ():
            try:
                clip = load_clip(pair, self.fps, self.without)
            except (GestureKitError, AudioFeaturesError):
                continue  # reported by `clip`
            window = (pair.stem, pair.window)
            if window not in speeds:
                if portion.part == "frechet":
                    recorded.add(clip.recording)
                speeds[window] = SpeedHistogram.of([speeds_of(clip.recording, clip.joints)])
                wrists[window] = wrists_of(clip.recording)
            clip_set.add(clip, speeds[window])
        if not speeds:
            metrics: dict[str, MetricResult] = {}
        elif portion.part == "frechet":
            metrics = self._frechet(clip_set, recorded, set(speeds))
        else:
            metrics = clip_set.pooled()
        values = {
            "metrics": {key: asdict(result) for key, result in metrics.items()},
            "problems": clip_set.problems,
            "by_clip": clip_set.pooled_metrics.by_clip() if portion.part == "pooled" else [],
            "speeds": pooled(clip_set.histograms).to_json(),
            "wrists": thinned(clip_set.wrists).tolist(),
            "recorded_speeds": pooled(list(speeds.values())).to_json(),
            "recorded_wrists": thinned(list(wrists.values())).tolist(),
            "training_excluded": [asdict(item) for item in training.excluded],
        }
        self.store.write(self.set_key(portion), values)
        return values

    @functools.cached_property
    def ceilings(self) -> dict[str, tuple[Interval, str]]:
        """The recordings' own values (`measuring.ceilings`), stored or computed here."""
        own = {name: self._with_itself(name, source) for name, source in self.recordings.items()}

        def compute() -> dict[str, list]:
            found = ceilings(own, self.fps, self.measure)
            return {name: [asdict(value), note] for name, (value, note) in found.items()}

        stored = self._stored(list(own.values()), ["ceilings", list(own)], compute)
        return {name: (Interval(**value), note) for name, (value, note) in stored.items()}

    def likeness(
        self, label: str, clips: Sequence[ClipResult]
    ) -> tuple[list[GroupLikeness], dict[str, Level]]:
        """Return the likeness of a model (`measuring.likeness`), stored or computed here."""
        if POOLED not in self.measure.groups:
            return [], {}

        def compute() -> dict[str, Any]:
            groups, levels = self._likeness(clips)
            return {
                "groups": [asdict(group) for group in groups],
                "levels": {name: asdict(level) for name, level in levels.items()},
            }

        parts = ["likeness", self.set_key(SetPart(label, PARTS[1]))]
        stored = self._stored(self._likeness.recordings, parts, compute, known=parts[1] is not None)
        groups = [GroupLikeness(**{**g, "takes": tuple(g["takes"]),
                  "without_reference": tuple(g["without_reference"])})
                  for g in stored["groups"]]  # fmt: skip
        return groups, {name: Level(**values) for name, values in stored["levels"].items()}

    @functools.cached_property
    def _likeness(self) -> LikenessMeasurer:
        recorded = {**recordings(self.reference)}
        if isinstance(self.reference, Items):
            recorded |= {item.id: ItemInterval(item) for item in self.reference.others}
        every = [self._with_itself(name, source) for name, source in recorded.items()]
        return LikenessMeasurer(self.measure, every, self.fps, self.without, self.seed)

    def _with_itself(self, name: str, source: Path | ItemInterval) -> Pair:
        """Return the pair of a recording with itself."""
        return Pair(name, name, None, source, source, take=self.takes.get(name, ""))

    def _stored(
        self, own: Sequence[Pair], parts: Sequence[Any], compute: Callable, known: bool = True
    ) -> Any:
        """Return what was computed of recordings before, or compute and store it."""
        contents = [content_of(pair.reference) for pair in own]
        parts = [self._settings, *parts, contents, self.seed, _nesting(own)]
        key = None if None in contents or not known else digest_of(parts)
        found = self.store.read(key)
        if found is None:
            found = compute()
            self.store.write(key, found)
        return found

    @functools.cached_property
    def store(self) -> Store:
        """Store of the measurements."""
        return Store()

    def clip_key(self, label: str, index: int) -> str | None:
        """Return the key of a clip's measurement; None if it cannot be stored."""
        pair = self.pairs[label][index]
        sounds = [(content_of(path), window) for path, window in self._other_sounds(label, pair)]
        motions = [content_of(self.recordings[key]) for key in self._other_motions(pair)]
        contents = [self._content(pair), *(content for content, _ in sounds), *motions]
        if None in contents:
            return None
        return digest_of([self._settings, contents, [window for _, window in sounds]])

    def set_key(self, portion: SetPart) -> str | None:
        """Return the key of the metrics of a set; None if they cannot be stored."""
        pairs = self.pairs[portion.label]
        every = [self._content(pair) for pair in pairs]
        every += [content_of(source) for source in self.recordings.values()]
        if isinstance(self.reference, Items):
            every += [content_of(ItemInterval(item)) for item in self.reference.training]
        if None in every:
            return None
        names: dict[Window, int] = {}
        order = [names.setdefault((pair.stem, pair.window), len(names)) for pair in pairs]
        model = self.features and self.features.fingerprint
        return digest_of(
            [self._settings, portion.part, every, order, _nesting(pairs), model, self.seed]
        )

    @functools.cached_property
    def _settings(self) -> dict[str, Any]:
        """Everything in a key that is common to all clips."""
        measure = self.measure
        return {
            "version": metric_version(),
            "fps": self.fps,
            "length": self.length,
            "groups": list(measure.groups),
            "cheap": measure.cheap,
            "variants": asdict(measure.variants),
            "statistics": measure.statistics.digest(),
            "without": sorted(self.without),
        }

    def _content(self, pair: Pair) -> str | None:
        """Return a digest of a pair's files; None if one has none."""
        if pair not in self._contents:
            sources = [pair.generated, pair.reference, pair.audio, pair.semantic]
            contents = ["" if source is None else content_of(source) for source in sources]
            known = None not in contents
            self._contents[pair] = digest_of([contents, pair.window]) if known else None
        return self._contents[pair]

    def _frechet(
        self, clip_set: SetMetrics, recorded: MotionSample, seen: AbstractSet[Window]
    ) -> dict[str, MetricResult]:
        """Compute the Fréchet distances of clips; `recorded` are the recordings of the clips."""
        if seen == {(key, None) for key in self.recordings}:
            return clip_set.frechet(recorded, None, self.features)
        full = MotionSample(self.seed)
        for source in self.recordings.values():
            full.add(load_recording(source, self.fps))
        return clip_set.frechet(full, recorded, self.features)

    def _mismatched(self, clip: Clip, label: str) -> dict[str, float]:
        """Measure the clip with the sounds, and the motion, of other recordings."""
        metrics = self._mismatched_sound(clip, label)
        for key in self._other_motions(clip.pair):
            other = load_recording(self.recordings[key], self.fps)
            metrics |= self.measure.mismatched_motion(clip, other)
        return metrics

    def _mismatched_sound(self, clip: Clip, label: str) -> dict[str, float]:
        if SPEECH not in self.measure.groups or clip.pair.audio is None:
            return {}
        sounds = []
        for path, index in self._other_sounds(label, clip.pair):
            try:
                sounds.append(load_sound(path, index))
            except AudioFeaturesError:
                continue  # reported with the clip that it belongs to
        return self.measure.mismatched_sound(clip, sounds)

    def _other_sounds(self, label: str, pair: Pair) -> list[tuple[Path | ItemInterval, int | None]]:
        if pair.audio is None:
            return []
        return _after(self._sounds[label], (pair.audio, pair.window), MISMATCHED)

    def _other_motions(self, pair: Pair) -> list[str]:
        return _after(list(self.recordings), pair.stem, 1)

    @functools.cached_property
    def _sounds(self) -> dict[str, list[tuple[Path | ItemInterval, int | None]]]:
        """Sounds of each model's clips, with their windows."""
        return {
            label: list(dict.fromkeys((p.audio, p.window) for p in pairs if p.audio))
            for label, pairs in self.pairs.items()
        }

    def is_portable(self, portion: Portion) -> bool:
        """Return whether a worker process can measure a portion: its motion is in files."""
        labels = portion.clips if isinstance(portion, ClipGroup) else [one.label for one in portion]
        return self.local.isdisjoint(labels)

    def portable(self) -> Measurer:
        """Return the measurer for worker processes, without motion in memory."""
        pairs = {key: pairs for key, pairs in self.pairs.items() if key not in self.local}
        return replace(self, pairs=pairs)


def _after(items: list, item: Any, count: int) -> list:
    """Return up to `count` other items, cyclically from the next one."""
    at = items.index(item) if item in items else 0
    return [items[(at + k) % len(items)] for k in range(1, min(count, len(items) - 1) + 1)]


def _nesting(pairs: Sequence[Pair]) -> list[tuple[int, ...]]:
    """Return the numbers of each clip's take, speaker and style, in order of appearance."""
    takes: dict[tuple[str | None, str], int] = {}
    speakers: dict[str | None, int] = {}
    styles: dict[str | None, int] = {}
    return [
        (
            takes.setdefault((pair.speaker, pair.take), len(takes)),
            speakers.setdefault(pair.speaker, len(speakers)),
            styles.setdefault(pair.style, len(styles)),
        )
        for pair in pairs
    ]
