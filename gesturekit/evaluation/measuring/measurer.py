"""Measure all clips and sets: what is stored is read, the rest is measured on all cores."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from audio_features import AudioFeaturesError
from gesturekit.errors import GestureKitError
from gesturekit.evaluation.definitions import FRECHET, POOLED, SPEECH
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
from gesturekit.evaluation.measuring.floors import floors
from gesturekit.evaluation.measuring.pooled import PooledMetrics, Window
from gesturekit.evaluation.measuring.set_metrics import (
    SetMetrics,
    pooled,
    speeds_of,
    thinned,
    wrists_of,
)
from gesturekit.evaluation.measuring.speakers import TrainingMotion
from gesturekit.evaluation.metrics.distributions import SpeedHistogram
from gesturekit.evaluation.pairs import ItemInterval, Items, Pair
from gesturekit.evaluation.results import Interval, MetricResult
from gesturekit.jobs.workers import Failure, Pool

if TYPE_CHECKING:
    from gesturekit.evaluation.metrics.frechet.feature_model import FeatureModel


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
    """

    measure: ClipMetrics
    pairs: Mapping[str, Sequence[Pair]]
    recordings: Mapping[str, Path | ItemInterval]
    reference: Path | Items
    fps: float
    length: float
    features: FeatureModel | None
    seed: int
    without: frozenset[str] = frozenset()
    local: frozenset[str] = frozenset()
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
            self._own[window] = self.measure.recording(clip)[0]
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

    def set(self, portion: SetPart) -> dict[str, Any]:
        """Compute one part of the metrics of a model's clips."""
        groups = self.measure.groups
        groups = [g for g in groups if (g == FRECHET) == (portion.part == "frechet")]
        measure = ClipMetrics(self.measure.statistics, groups, self.measure.variants)
        training = TrainingMotion()
        if POOLED in groups:
            training = TrainingMotion.of(self.reference, self.seed)
        clip_set = SetMetrics(
            measure, self.seed, PooledMetrics(training, self.seed, self._of_recordings)
        )
        windows, speeds, wrists = {}, {}, {}
        for pair in self.pairs[portion.label]:
            try:
                clip = load_clip(pair, self.fps, self.without)
            except (GestureKitError, AudioFeaturesError):
                continue  # reported by `clip`
            window = (pair.stem, pair.window)
            if window not in windows:
                windows[window] = clip.recording if portion.part == "frechet" else None
                speeds[window] = SpeedHistogram.of([speeds_of(clip.recording, clip.joints)])
                wrists[window] = wrists_of(clip.recording)
            clip_set.add(clip, speeds[window])
        if not windows or not groups:
            metrics: dict[str, MetricResult] = {}
        elif portion.part == "frechet":
            metrics = self._frechet(clip_set, windows)
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

    def floors(self) -> dict[str, tuple[Interval, str]]:
        """Return the recordings' own values (`contest.floors`), stored or computed here."""
        contents = [content_of(source) for source in self.recordings.values()]
        model = self.features and self.features.fingerprint
        own = [Pair(n, n, None, source, source) for n, source in self.recordings.items()]
        parts = [self._settings, "floors", list(self.recordings), contents, model, self.seed]
        parts.append(_nesting(own))
        key = None if None in contents else digest_of(parts)
        stored = self.store.read(key)
        if stored is None:
            motions = self.measure.statistics.recordings
            found = floors(motions, self.recordings, self.measure, self.features, self.seed)
            stored = {name: [asdict(value), note] for name, (value, note) in found.items()}
            self.store.write(key, stored)
        return {name: (Interval(**value), note) for name, (value, note) in stored.items()}

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
        names = list(dict.fromkeys((pair.stem, pair.window) for pair in pairs))
        order = [names.index((pair.stem, pair.window)) for pair in pairs]
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

    def _frechet(self, clip_set: SetMetrics, windows: Mapping[Window, Any]) -> dict[str, Any]:
        full = [load_recording(source, self.fps) for source in self.recordings.values()]
        whole = {(key, None) for key in self.recordings}
        seen = sorted(windows, key=lambda window: (window[0], window[1] or 0))
        compared = None if set(seen) == whole else [windows[window] for window in seen]
        return clip_set.frechet(full, compared, self.features)

    def _mismatched(self, clip: Clip, label: str) -> dict[str, float]:
        """Measure the clip with the sounds, and the motion, of other recordings."""
        metrics: dict[str, float] = {}
        if SPEECH in self.measure.groups and clip.pair.audio is not None:
            sounds = []
            for path, index in self._other_sounds(label, clip.pair):
                try:
                    sounds.append(load_sound(path, index))
                except AudioFeaturesError:
                    continue  # reported with the clip that it belongs to
            metrics |= self.measure.mismatched_sound(clip, sounds)
        for key in self._other_motions(clip.pair):
            other = load_recording(self.recordings[key], self.fps)
            metrics |= self.measure.mismatched_motion(clip, other)
        return metrics

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
        statistics = replace(self.measure.statistics, recordings={})
        measure = ClipMetrics(statistics, self.measure.groups, self.measure.variants)
        pairs = {key: pairs for key, pairs in self.pairs.items() if key not in self.local}
        return replace(self, measure=measure, pairs=pairs)


def _after(items: list, item: Any, count: int) -> list:
    """Return up to `count` other items, cyclically from the next one."""
    at = items.index(item) if item in items else 0
    return [items[(at + k) % len(items)] for k in range(1, min(count, len(items) - 1) + 1)]


IN_PROCESS_SECONDS = 4.0
"""Measuring that takes longer gets worker processes; starting them takes about as long."""

Progress = Callable[[Iterable[Any], int, str], Iterable[Any]]
"""Wraps an iterable of finished portions, such as in a progress bar, given number and label."""


@dataclass
class Measured:
    """Measurements of all models.

    Attributes:
        clips: {label: measurement of each pair}, see `Measurer.clip`.
        sets: {label: {part: metrics of the set}}, see `Measurer.set`.
    """

    clips: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    sets: dict[str, dict[str, dict[str, Any]]] = field(default_factory=dict)


def measure_all(measurer: Measurer, workers: int, progress: Progress) -> Measured:
    """Return the measurements of all clips and sets, the same for any number of workers.

    Each result is stored as soon as it is computed, so that an interrupted evaluation can continue.

    Args:
        measurer: what to measure.
        workers: number of processes; 1 measures in this one.
        progress: see `Progress`.
    """
    found = Measured()
    clip_groups = _read_clips(measurer, found)
    portions = [*clip_groups, *_chains(measurer, _read_sets(measurer, found), workers)]
    if not portions:
        return found
    for portion, results in progress(
        _done(measurer, portions, workers), len(portions), "measuring"
    ):
        if isinstance(results, Failure):
            results = _failed(measurer, portion, str(results))
        if not isinstance(portion, ClipGroup):
            for one, values in zip(portion, results, strict=True):
                found.sets[one.label][one.part] = values
            continue
        for label, index, values in results:
            found.clips[label][index] = values
    return found


def _read_clips(measurer: Measurer, found: Measured) -> list[ClipGroup]:
    """Read the stored clips into `found`; return a portion for each recording with other clips."""
    missing: dict[tuple[bool, str, int], dict[str, list[int]]] = {}
    for label, pairs in measurer.pairs.items():
        stored = [measurer.store.read(measurer.clip_key(label, i)) for i in range(len(pairs))]
        found.clips[label] = [values or {} for values in stored]
        for i, pair in enumerate(pairs):
            if stored[i] is None:
                window = (
                    label in measurer.local,
                    pair.stem,
                    -1 if pair.window is None else pair.window,
                )
                missing.setdefault(window, {}).setdefault(label, []).append(i)
    return [ClipGroup(clips) for _, clips in sorted(missing.items())]


def _read_sets(measurer: Measurer, found: Measured) -> list[SetPart]:
    """Read the stored metrics of sets into `found`; return portions for the others."""
    portions = []
    for label in measurer.pairs:
        found.sets[label] = {}
        for part in PARTS:
            portion = SetPart(label, part)
            stored = measurer.store.read(measurer.set_key(portion))
            if stored is None:
                portions.append(portion)
            else:
                found.sets[label][part] = stored
    return portions


def _chains(
    measurer: Measurer, portions: Sequence[SetPart], workers: int
) -> list[tuple[SetPart, ...]]:
    """Return the metrics of sets in chains, one for two workers, each done by one process.

    A set holds all motion of its model in memory; while one is computed, clips are measured.
    """
    chains = []
    for portable in (True, False):
        some = [portion for portion in portions if measurer.is_portable((portion,)) == portable]
        count = max(1, workers // 2) if workers > 1 else len(some)
        chains += [tuple(some[k::count]) for k in range(count) if some[k::count]]
    return chains


def _done(measurer: Measurer, portions: Sequence[Any], workers: int) -> Iterator[tuple[Any, Any]]:
    """Yield (portion, results) as they are done; those that cannot be handed over are done here."""
    here = [portion for portion in portions if not measurer.is_portable(portion)]
    left = [portion for portion in portions if measurer.is_portable(portion)]
    until = time.monotonic() + IN_PROCESS_SECONDS
    while left and (workers < 2 or time.monotonic() < until):
        portion = left.pop(0)
        yield portion, measurer(portion)
    if left:
        left.sort(key=lambda portion: isinstance(portion, ClipGroup))  # the longest first
        yield from Pool(measurer.portable(), workers).map(left, lambda _: None)
    for portion in here:
        yield portion, measurer(portion)


def _failed(measurer: Measurer, portion: Portion, reason: str) -> list[Any]:
    """Return the results of a portion whose worker process died; sets done before it are stored."""
    if not isinstance(portion, ClipGroup):
        failed = {"metrics": {}, "problems": [("metrics of the set", reason)]}
        return [measurer.store.read(measurer.set_key(one)) or failed for one in portion]
    return [(label, i, {"reason": reason}) for label, at in portion.clips.items() for i in at]


def _nesting(pairs: Sequence[Pair]) -> list[tuple[int, ...]]:
    """Return the numbers of each clip's take, speaker and style, in order of appearance."""
    styles = list(dict.fromkeys(pair.style for pair in pairs))
    takes = list(dict.fromkeys((pair.speaker, pair.take) for pair in pairs))
    speakers = list(dict.fromkeys(pair.speaker for pair in pairs))
    return [
        (takes.index((p.speaker, p.take)), speakers.index(p.speaker), styles.index(p.style))
        for p in pairs
    ]
