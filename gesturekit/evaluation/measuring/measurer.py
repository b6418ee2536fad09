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
from gesturekit.evaluation.measuring.pooled import PooledMetrics
from gesturekit.evaluation.measuring.samples import TrainingMotion
from gesturekit.evaluation.measuring.set_metrics import (
    SetMeasurement,
    SetMetrics,
    frechet_metrics,
)
from gesturekit.evaluation.pairs import Excluded, ItemInterval, Items, Pair, Window, recordings
from gesturekit.evaluation.results import ClipResult, Interval, MetricResult
from gesturekit.evaluation.statistics.model_metrics import OTHER_SOUND
from gesturekit.workers import Failure, in_processes

if TYPE_CHECKING:
    from gesturekit.evaluation.metrics.frechet.feature_model import Extractor


MISMATCHED = 3
"""Number of other recordings that a clip is also compared with, for the mismatched level."""
FRECHET_PART, POOLED_PART = PARTS = ("frechet", "pooled")
"""Halves of the metrics of a set, which are computed independently."""
IN_PROCESS_SECONDS = 4.0
"""Measuring that takes longer gets worker processes; starting them takes about as long."""

Progress = Callable[[Iterable[Any], int, str], Iterable[Any]]
"""Wraps an iterable of finished portions, such as in a progress bar, given number and label."""


@dataclass(frozen=True)
class ClipIndex:
    """A clip, by the label of its model and its index among its pairs."""

    label: str
    index: int


@dataclass(frozen=True)
class SetPart:
    """One of `PARTS` of the metrics of the set of clips of one model."""

    label: str
    part: str


Target = ClipIndex | SetPart
"""Unit that is measured, stored and read as one."""
Portion = tuple[Target, ...]
"""Portion that one process measures: clips of a recording, or sets one after the other."""
Measurement = ClipResult | Excluded | SetMeasurement
"""Result of measuring a target; a clip that cannot be read is `Excluded`."""


@dataclass
class Measured:
    """Measurements of one model: of each of its pairs, and of their set by part."""

    clips: list[ClipResult | Excluded] = field(default_factory=list)
    sets: dict[str, SetMeasurement] = field(default_factory=dict)


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
    takes: Mapping[str, str] = field(default_factory=dict)
    _recorded: dict[tuple[Window, tuple[str, ...]], dict[str, float]] = field(
        default_factory=dict, init=False
    )
    _of_recordings: dict[Hashable, Any] = field(default_factory=dict, init=False)
    _contents: dict[Pair, str | None] = field(default_factory=dict, init=False)

    def __call__(self, portion: Portion) -> list[Measurement]:
        """Return the measurements of a portion, which are stored as well.

        Sums of floating-point numbers depend on the number of threads: each process has one.
        """
        from threadpoolctl import threadpool_limits

        with threadpool_limits(1):
            self._recorded.clear()
            return [self._measured(target) for target in portion]

    def _measured(self, target: Target) -> Measurement:
        if isinstance(target, SetPart):
            of_set = self._set(target)
            self.store.write(self._key(target), of_set.to_json())
            return of_set
        clip = self._clip(target)
        if isinstance(clip, ClipResult):
            values = {name: value for name, value in vars(clip).items() if name != "pair"}
            self.store.write(self._key(target), values)
        return clip

    def stored(self, target: Target) -> Measurement | None:
        """Return a measurement of an earlier evaluation, or None."""
        values = self.store.read(self._key(target))
        if values is None:
            return None
        if isinstance(target, SetPart):
            return SetMeasurement.from_json(values)
        return ClipResult(self.pairs[target.label][target.index], **values)

    def failed(self, target: Target, reason: str) -> Measurement:
        """Return the measurement of a target whose worker process died."""
        if isinstance(target, SetPart):
            return SetMeasurement(problems=[("metrics of the set", reason)])
        return Excluded(self.pairs[target.label][target.index].name, reason)

    def _clip(self, target: ClipIndex) -> ClipResult | Excluded:
        label, pair = target.label, self.pairs[target.label][target.index]
        try:
            clip = load_clip(pair, self.fps, self.without)
        except (GestureKitError, AudioFeaturesError) as error:
            return Excluded(pair.name, str(error))
        metrics, problems = self.measure.generated(clip)
        window = pair.of, clip.joints
        if window not in self._recorded:
            self._recorded[window] = self._recording(clip, label)
        return ClipResult(
            pair,
            clip.generated.duration,
            metrics,
            self._recorded[window],
            self._mismatched(clip, label),
            [*clip.notes, *clip_notes(clip, self.length)],
            problems,
        )

    def _recording(self, clip: Clip, label: str) -> dict[str, float]:
        """Measure the recording of a clip, also in time with other recordings' sounds."""
        values = self.measure.recording(clip)[0]
        own = replace(clip, generated=clip.recording)
        mismatched = self._mismatched_sound(own, label).get("in_time")
        return values if mismatched is None else {**values, OTHER_SOUND: mismatched}

    def _set(self, target: SetPart) -> SetMeasurement:
        groups, clips = self.measure.groups, self._clips(target.label)
        if target.part == FRECHET_PART:
            if FRECHET not in groups:
                return SetMeasurement()
            kinetic, sources = self.measure.variants.kinetic, self.recordings
            return frechet_metrics(
                clips, sources, self.features, fps=self.fps, kinetic=kinetic, seed=self.seed
            )
        of_reference = POOLED in groups
        training = (
            TrainingMotion.of(self.reference, self.seed) if of_reference else TrainingMotion()
        )
        pooled = PooledMetrics(training, self.seed, self._of_recordings)
        metrics = SetMetrics(self.measure, pooled)
        for clip in clips:
            metrics.add(clip)
        return metrics.measured()

    def _clips(self, label: str) -> Iterator[Clip]:
        for pair in self.pairs[label]:
            try:
                clip = load_clip(pair, self.fps, self.without)
            except (GestureKitError, AudioFeaturesError):
                continue  # reported by `_clip`
            yield clip

    @functools.cached_property
    def ceilings(self) -> dict[str, tuple[Interval, str]]:
        """The recordings' own values (`measuring.ceilings`), stored or computed here."""
        own = {name: self._with_itself(name, source) for name, source in self.recordings.items()}

        def compute() -> dict[str, list]:
            found = ceilings(own, self.fps, self.measure)
            return {name: [asdict(value), note] for name, (value, note) in found.items()}

        stored = self._stored(list(own.values()), ["ceilings", list(own)], compute)
        return {name: (Interval(**value), note) for name, (value, note) in stored.items()}

    def likeness(self, label: str, clips: Sequence[ClipResult]) -> MetricResult | None:
        """Return the likeness of a model (`measuring.likeness`), stored or computed here."""
        if POOLED not in self.measure.groups:
            return None

        def compute() -> list[dict[str, Any]]:
            result = self._likeness(clips)
            return [] if result is None else [asdict(result)]

        of_set = self._key(SetPart(label, POOLED_PART))
        parts, every = ["likeness", of_set], self._likeness.recordings
        found = self._stored(every, parts, compute, known=of_set is not None)
        return MetricResult.from_json(found[0]) if found else None

    @functools.cached_property
    def _likeness(self) -> LikenessMeasurer:
        sources = recordings(self.reference, all_splits=True)
        every = [self._with_itself(name, source) for name, source in sources.items()]
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

    def _key(self, target: Target) -> str | None:
        """Return the key of a measurement; None if it cannot be stored."""
        if isinstance(target, SetPart):
            return self._set_key(target)
        label, pair = target.label, self.pairs[target.label][target.index]
        sounds = [(content_of(path), window) for path, window in self._other_sounds(label, pair)]
        motions = [content_of(self.recordings[key]) for key in self._other_motions(pair)]
        contents = [self._content(pair), *(content for content, _ in sounds), *motions]
        if None in contents:
            return None
        return digest_of([self._settings, contents, [window for _, window in sounds]])

    def _set_key(self, target: SetPart) -> str | None:
        pairs = self.pairs[target.label]
        every = [self._content(pair) for pair in pairs]
        every += [content_of(source) for source in self.recordings.values()]
        if isinstance(self.reference, Items):
            every += [content_of(ItemInterval(item)) for item in self.reference.training]
        if None in every:
            return None
        names: dict[Window, int] = {}
        order = [names.setdefault(pair.of, len(names)) for pair in pairs]
        model = self.features and self.features.fingerprint
        return digest_of(
            [self._settings, target.part, every, order, _nesting(pairs), model, self.seed]
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


def measure_all(measurer: Measurer, workers: int, progress: Progress) -> dict[str, Measured]:
    """Return the measurements by model, the same for any number of workers.

    Each is stored as soon as it is computed, so that an interrupted evaluation can continue.

    Args:
        measurer: what to measure.
        workers: number of processes; 1 measures in this one.
        progress: see `Progress`.
    """
    targets: list[Target] = []
    for label, pairs in measurer.pairs.items():
        targets += [ClipIndex(label, index) for index in range(len(pairs))]
        targets += [SetPart(label, part) for part in PARTS]
    found = {target: measurer.stored(target) for target in targets}
    missing = [target for target in targets if found[target] is None]
    if portions := _portions(measurer, missing, workers):
        done = _done(measurer, portions, workers)
        for portion, results in progress(done, len(portions), "measuring"):
            if isinstance(results, Failure):  # sets done before it are stored
                failed = functools.partial(measurer.failed, reason=str(results))
                results = [measurer.stored(target) or failed(target) for target in portion]
            found |= zip(portion, results, strict=True)
    measured = {label: Measured() for label in measurer.pairs}
    for target, result in found.items():
        if isinstance(target, SetPart):
            assert isinstance(result, SetMeasurement)
            measured[target.label].sets[target.part] = result
        else:
            assert isinstance(result, ClipResult | Excluded)
            measured[target.label].clips.append(result)
    return measured


def _portions(measurer: Measurer, missing: Sequence[Target], workers: int) -> list[Portion]:
    """Return the clips of each recording, and the sets in chains, one for two workers.

    A set holds all motion of its model in memory; while one is computed, clips are measured.
    """
    of_window: dict[tuple[str, int], list[Target]] = {}
    for target in missing:
        if isinstance(target, ClipIndex):
            stem, window = measurer.pairs[target.label][target.index].of
            of_window.setdefault((stem, -1 if window is None else window), []).append(target)
    sets = [target for target in missing if isinstance(target, SetPart)]
    chains = max(1, workers // 2) if workers > 1 else max(1, len(sets))
    portions: list[Sequence[Target]] = [of_window[window] for window in sorted(of_window)]
    portions += [sets[k::chains] for k in range(chains)]
    return [tuple(portion) for portion in portions if portion]


def _done(
    measurer: Measurer, portions: Sequence[Portion], workers: int
) -> Iterator[tuple[Portion, Any]]:
    """Yield (portion, measurements or `Failure`) as they are done."""
    left = list(portions)
    until = time.monotonic() + IN_PROCESS_SECONDS
    while left and (workers < 2 or time.monotonic() < until):
        portion = left.pop(0)
        yield portion, measurer(portion)
    if left:
        left.sort(key=lambda portion: isinstance(portion[0], ClipIndex))  # the longest first
        yield from in_processes(replace(measurer), left, workers)


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
