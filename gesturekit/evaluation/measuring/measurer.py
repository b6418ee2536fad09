"""Measure all clips and sets: what is stored is read, the rest is measured on all cores.

The key of a measurement is a digest of the content of its files, its settings, the source code of
the metrics, and the versions of the numerical libraries; no entry ever has to be removed by hand.
The names and places of files are not part of it.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import itertools
import json
import time
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

import audio_features
from audio_features import AudioFeaturesError
from audio_features.cache import DiskCache, default_folder, size_limit
from audio_features.kinds import digest_of_sources, installed_versions
from gesturekit.corpus.manifest import Item, file_fingerprint
from gesturekit.errors import GestureKitError
from gesturekit.evaluation.definitions import POOLED, SPEECH
from gesturekit.evaluation.measuring.clip_metrics import ClipMetrics
from gesturekit.evaluation.measuring.clips import (
    RecordedSound,
    clip_notes,
    load_clip,
    load_recording,
    load_sound,
)
from gesturekit.evaluation.measuring.set_metrics import SetMeasurement, SetMetrics
from gesturekit.evaluation.measuring.speaker import LikenessMeasurer, ceilings
from gesturekit.evaluation.pairs import Excluded, Pair, Window, grouped
from gesturekit.evaluation.results import ClipResult, Interval, MetricResult, restored
from gesturekit.evaluation.statistics.model_metrics import OTHER_SOUND
from gesturekit.workers import Failure, in_processes

if TYPE_CHECKING:
    from gesturekit.evaluation.metrics.frechet.feature_model import Extractor

MISMATCHED = 3
"""Number of other recordings that a clip is also compared with, for the mismatched level."""
IN_PROCESS_SECONDS = 4.0
"""Measuring that takes longer gets worker processes; starting them takes about as long."""

Progress = Callable[[Iterable[Any], int, str], Iterable[Any]]
"""Wraps an iterable of finished portions, such as in a progress bar, given number and label."""
Target = tuple[str, int | None]
"""Unit that is measured and stored as one: a model's label, and the index of a clip among its
pairs; None for their set."""
Measurement = ClipResult | Excluded | SetMeasurement
"""Result of measuring a target; a clip that cannot be read is `Excluded`."""

_Sound = tuple[Item, int | None]
"""Sound of a recording, and the index of its 10 s window; None for the whole."""
_KIND = "measurements-1"
_NUMERICAL = ("numpy", "scipy", "librosa", "soxr", "torch", "scikit-learn", "soundfile")
_CODE = ("evaluation", "motion", "formats", "corpus")
"""Packages of gesturekit of which an edit may change a measurement."""
_DESCRIPTIVE = frozenset({"id", "speaker", "style", "split", "text", "audio", "motion", "digests"})
_T = TypeVar("_T")


@dataclass(eq=False)
class Measurer:
    """Measures clips and sets; it is handed to worker processes.

    Attributes:
        measure: the metrics of single clips; its statistics need no motion.
        pairs: clips of each model by label, in order.
        itself: pairs of each recording of all splits with itself, by key.
        training: items of the training split, where another one is measured.
        fps: frame rate of all metrics.
        length: expected length of a clip relative to its recording.
        features: the extractor of FGD, or None.
        seed: seed of intervals and subsamples.
        without: bare names of joints that some model lacks, which no model is measured with.
    """

    measure: ClipMetrics
    pairs: Mapping[str, Sequence[Pair]]
    itself: Mapping[str, Pair]
    training: Sequence[Item]
    fps: float
    length: float
    features: Extractor | None
    seed: int
    without: frozenset[str]
    _recorded: dict[Hashable, dict[str, float]] = field(default_factory=dict, init=False)
    _of_recordings: dict[Hashable, Any] = field(default_factory=dict, init=False)

    def __call__(self, portion: Sequence[Target]) -> list[Measurement]:
        """Return the measurements of a portion, which are stored as well.

        Sums of floating-point numbers depend on the number of threads: each process has one.
        """
        from threadpoolctl import threadpool_limits

        found: list[Measurement] = []
        with threadpool_limits(1):
            self._recorded.clear()
            for target in portion:
                label, index = target
                found.append(self._set(label) if index is None else self._clip(label, index))
                if not isinstance(found[-1], Excluded):
                    self._write(self._key(target), found[-1])
        return found

    def stored(self, target: Target) -> Measurement | None:
        """Return a measurement of an earlier evaluation, or None."""
        (label, index), values = target, self._read(self._key(target))
        if values is None or index is None:
            return restored(SetMeasurement, values)
        return ClipResult(**{**values, "pair": self.pairs[label][index]})

    def failed(self, target: Target, reason: str) -> Measurement:
        """Return the measurement of a target whose worker process died."""
        label, index = target
        if index is None:
            return SetMeasurement(problems=[("metrics of the set", reason)])
        return Excluded(self.pairs[label][index].name, reason)

    def _clip(self, label: str, index: int) -> ClipResult | Excluded:
        pair = self.pairs[label][index]
        try:
            clip = load_clip(pair, self.fps, self.without)
        except (GestureKitError, AudioFeaturesError) as error:
            return Excluded(pair.name, str(error))
        found, sounds = self.measure.generated(clip), list[RecordedSound]()
        for path, at in self._others[label, index][0]:
            with suppress(AudioFeaturesError):  # reported with the clip that it belongs to
                sounds.append(load_sound(path, at))
        window = pair.of, clip.joints, clip.is_retargeted  # what its values depend on
        if window not in self._recorded:  # also in time with other recordings' sounds
            own = self.measure.recording(clip)
            as_made = replace(clip, generated=clip.recording)
            other = self.measure.mismatched_sound(as_made, sounds).get("in_time")
            self._recorded[window] = own if other is None else {**own, OTHER_SOUND: other}
        mismatched = self.measure.mismatched_sound(clip, sounds)
        for source in self._others[label, index][1]:
            motion = load_recording(source, self.fps)
            mismatched |= self.measure.mismatched_motion(clip, motion)
        return ClipResult(
            pair,
            clip.generated.duration,
            found.values,
            self._recorded[window],
            mismatched,
            [*clip.notes, *clip_notes(clip, self.length)],
            found.problems,
        )

    def _set(self, label: str) -> SetMeasurement:
        known, settings = self._of_recordings, (self.fps, self.features, self.seed)
        metrics = SetMetrics(self.measure, self.recordings, self.training, *settings, known)
        for pair in self.pairs[label]:
            with suppress(GestureKitError, AudioFeaturesError):  # reported by `_clip`
                metrics.add(load_clip(pair, self.fps, self.without))
        return metrics.measured()

    @functools.cached_property
    def recordings(self) -> dict[str, Item]:
        """Recordings that are compared with and can be read, by key."""
        return {key: self.itself[key].reference for key in self.measure.statistics.recordings}

    @functools.cached_property
    def _others(self) -> dict[Target, tuple[list[_Sound], list[Item]]]:
        """Sounds and motion of other recordings that each clip is also compared with."""
        found: dict[Target, tuple[list[_Sound], list[Item]]] = {}
        speech, recorded = SPEECH in self.measure.groups, list(self.recordings.values())
        places = {key: n for n, key in enumerate(self.recordings)}
        for label, pairs in self.pairs.items():
            every = list(dict.fromkeys((p.audio, p.window) for p in pairs if p.audio and speech))
            at = {sound: n for n, sound in enumerate(every)}
            for index, pair in enumerate(pairs):
                sounds: list[_Sound] = []
                if pair.audio is not None and speech:
                    sounds = _after(every, at[pair.audio, pair.window], MISMATCHED)
                motions = _after(recorded, places.get(pair.stem, 0), 1)
                found[label, index] = sounds, motions
        return found

    @functools.cached_property
    def ceilings(self) -> dict[str, tuple[Interval, str]]:
        """The recordings' own values (`measuring.speaker`), stored or computed here."""
        own = {key: self.itself[key] for key in self.recordings}
        key = self._key_of(["ceilings"], list(own.values()))
        kind = dict[str, tuple[Interval, str]]
        return self._once(key, kind, lambda: ceilings(own, self.fps, self.measure))

    def likeness(self, label: str, clips: Sequence[ClipResult]) -> MetricResult | None:
        """Return the likeness of a model (`measuring.speaker`), stored or computed here."""
        if POOLED not in self.measure.groups:
            return None
        of_set = self._key((label, None))
        every = list(self.itself.values())
        names = [(pair.speaker, pair.take, pair.style) for pair in every]  # stand in the result
        key = of_set and self._key_of(["likeness", of_set, names], every)
        kind = list[MetricResult]
        found = self._once(key, kind, lambda: [*filter(None, [self._likeness(clips)])])
        return found[0] if found else None

    @functools.cached_property
    def _likeness(self) -> LikenessMeasurer:
        every = list(self.itself.values())
        return LikenessMeasurer(self.measure, every, self.fps, self.without, self.seed)

    def _once(self, key: str | None, kind: type[_T], compute: Callable[[], _T]) -> _T:
        """Return what was computed of recordings before, or compute and store it."""
        values = self._read(key)
        if values is not None:
            return restored(kind, values)
        found = compute()
        self._write(key, found)
        return found

    def _key(self, target: Target) -> str | None:
        """Return the key of a measurement; None if it cannot be stored."""
        label, index = target
        if index is not None:
            sounds, motions = self._others[target]
            others = [*(sound for sound, _ in sounds), *motions]
            return self._key_of([w for _, w in sounds], [self.pairs[label][index]], others)
        speakers = [pair.speaker for pair in self.pairs[label]]
        speakers += [item.speaker for item in self.training]
        what = ["set", self.features and self.features.fingerprint, self.seed, speakers]
        others = [*self.training, *self.recordings.values()]
        return self._key_of(what, self.pairs[label], others)

    def _key_of(
        self, what: list[Any], pairs: Sequence[Pair], others: Sequence[Item] = ()
    ) -> str | None:
        """Return a digest of clips, other items, settings and code; None if one has no content."""
        of_pairs = [(p.generated, p.reference, p.audio, p.semantic) for p in pairs]
        files = [*itertools.chain(*of_pairs), *others]
        contents = ["" if file is None else _content(file) for file in files]
        what = [self._settings, what, _nesting(pairs), contents]
        return None if None in contents else _digest_of(what)

    @functools.cached_property
    def _settings(self) -> str:
        """Digest of everything that is common to all keys."""
        measure, root = self.measure, Path(__file__).parents[2]
        folders = [root / name for name in _CODE] + [Path(audio_features.__file__).parent]
        return _digest_of([
            [digest_of_sources(folder) for folder in folders],
            installed_versions(_NUMERICAL),
            [self.fps, self.length, list(measure.groups), measure.cheap, measure.variants],
            [measure.statistics.mean_speed, measure.statistics.limits, sorted(self.without)],
        ])  # fmt: skip

    @functools.cached_property
    def _disk(self) -> DiskCache:
        """Store of the measurements, in the folder of the feature cache."""
        return DiskCache(default_folder(), max_bytes=size_limit())

    def _read(self, key: str | None) -> Any | None:
        """Return a stored measurement, or None if it is not stored or damaged."""
        return None if key is None else self._disk.read(_KIND, key, json.loads)

    def _write(self, key: str | None, values: Any) -> None:
        """Store a measurement, if it has a key."""
        if key is not None:
            self._disk.write(_KIND, key, json.dumps(values, default=_plain).encode())


def measure_all(
    measurer: Measurer, workers: int, progress: Progress
) -> dict[str, tuple[list[ClipResult | Excluded], SetMeasurement]]:
    """Return the measurements of each model, of its pairs and their set, for any number of workers.

    Each is stored as soon as it is computed, so that an interrupted evaluation can continue.

    Args:
        measurer: what to measure.
        workers: number of processes; 1 measures in this one.
        progress: see `Progress`.
    """
    targets: list[Target] = []
    for label, pairs in measurer.pairs.items():
        targets += [(label, index) for index in (*range(len(pairs)), None)]
    found: dict[Target, Any] = {target: measurer.stored(target) for target in targets}
    missing = [target for target in targets if found[target] is None]
    if portions := _portions(measurer, missing, workers):
        done = _done(measurer, portions, workers)
        for portion, results in progress(done, len(portions), "measuring"):
            if isinstance(results, Failure):  # sets done before it are stored
                failed = functools.partial(measurer.failed, reason=str(results))
                results = [measurer.stored(target) or failed(target) for target in portion]
            found |= zip(portion, results, strict=True)
    return {
        label: ([found[label, index] for index in range(len(pairs))], found[label, None])
        for label, pairs in measurer.pairs.items()
    }


def _portions(measurer: Measurer, missing: Sequence[Target], workers: int) -> list[list[Target]]:
    """Return the clips of each recording, and the sets in chains, one for two workers.

    A set holds all motion of its model in memory; while one is computed, clips are measured.
    """
    sets: list[Target] = [target for target in missing if target[1] is None]
    of_window: dict[Window, list[Target]] = grouped(
        (measurer.pairs[label][n].of, (label, n)) for label, n in missing if n is not None
    )
    chains = max(1, workers // 2) if workers > 1 else max(1, len(sets))
    portions = [of_window[of] for of in sorted(of_window, key=lambda of: (of[0], of[1] or -1))]
    return [*portions, *filter(None, (sets[k::chains] for k in range(chains)))]


def _done(
    measurer: Measurer, portions: Sequence[list[Target]], workers: int
) -> Iterator[tuple[list[Target], Any]]:
    """Yield (portion, measurements or `Failure`) as they are done."""
    left = list(portions)
    until = time.monotonic() + IN_PROCESS_SECONDS
    while left and (workers < 2 or time.monotonic() < until):
        portion = left.pop(0)
        yield portion, measurer(portion)
    if left:
        left.sort(key=lambda portion: portion[0][1] is not None)  # the longest first
        yield from in_processes(replace(measurer), left, workers)


def _after(items: Sequence[_T], at: int, count: int) -> list[_T]:
    """Return up to `count` items after a place, cyclically and without its own."""
    return [items[(at + k) % len(items)] for k in range(1, min(count, len(items) - 1) + 1)]


def _nesting(pairs: Sequence[Pair]) -> list[list[int | None]]:
    """Return each clip's window, and numbers of what it belongs to, in order of appearance."""
    seen: list[dict[Any, int]] = [{}, {}, {}, {}]
    found = []
    for pair in pairs:
        names = pair.of, (pair.speaker, pair.take), pair.speaker, pair.style
        numbers = [known.setdefault(n, len(known)) for known, n in zip(seen, names)]
        found.append([pair.window, *numbers])
    return found


def _content(source: Item | Path) -> str | None:
    """Return a digest of the files of a clip or recording, and of how they are read.

    None for motion that is made in memory, and for files that cannot be read.
    """
    try:
        if isinstance(source, Path):
            return file_fingerprint(source)
        values = {f.name: getattr(source, f.name) for f in dataclasses.fields(source)}
        how = [value for name, value in values.items() if name not in _DESCRIPTIVE]
        files = [path and file_fingerprint(path) for path in (source.motion, source.audio)]
        return None if any(map(callable, how)) else _digest_of([files, how])
    except OSError:
        return None


def _digest_of(values: Any) -> str:
    """Return a digest of plain values, records and arrays; paths are taken as text."""
    text = json.dumps(values, sort_keys=True, default=_plain)
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, ClipResult):
        return {name: v for name, v in vars(value).items() if name != "pair"}
    if isinstance(value, Mapping):
        return dict(value)
    is_record = dataclasses.is_dataclass(value) and not isinstance(value, type)
    return dataclasses.asdict(value) if is_record else str(value)
