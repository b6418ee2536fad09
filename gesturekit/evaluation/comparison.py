"""`evaluate`: measure folders of generated motion against recordings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from audio_features import AudioFeaturesError
from gesturekit.errors import EvaluationError, GestureKitError, gesturekit_errors
from gesturekit.evaluation.baselines import baseline_pairs
from gesturekit.evaluation.clip_metrics import ClipMetrics, ReferenceStatistics, load_sound
from gesturekit.evaluation.clips import LENGTH_TOLERANCE, Clip, clip_notes, load_clip
from gesturekit.evaluation.definitions import (
    DEFINITIONS,
    FRECHET,
    GROUPS,
    LIFE,
    MOVEMENT,
    PATCHES,
    SPEECH,
    PatchOptions,
)
from gesturekit.evaluation.frame_rate import RULE
from gesturekit.evaluation.intervals import Interval, interval_of
from gesturekit.evaluation.life.pooled import LifeMetrics, TrainingMotion
from gesturekit.evaluation.life.verdict import verdict
from gesturekit.evaluation.metrics.distributions import SpeedHistogram
from gesturekit.evaluation.pairs import (
    WINDOW_SECONDS,
    Excluded,
    Items,
    Pair,
    Pairs,
    find_pairs,
    recordings,
)
from gesturekit.evaluation.results import ClipResult, Evaluation, MetricResult, ModelResult
from gesturekit.evaluation.set_metrics import SetMetrics, pooled, speeds_of, thinned, wrists_of
from gesturekit.field_docs import build_options
from gesturekit.motion import Motion
from gesturekit.wording import listed

if TYPE_CHECKING:
    from gesturekit.evaluation.metrics.frechet.feature_model import FeatureModel

PROTOCOLS = {
    "": GROUPS,
    "multires": (MOVEMENT, PATCHES),
    "lda": (SPEECH, MOVEMENT, FRECHET),
}
"""Groups of metrics that a protocol takes; "" takes all."""
MULTIRES_SAMPLES = 200
MULTIRES_LENGTH = 2.0
"""Samples of each training sequence, and their length relative to the sequence."""
LDA_SAMPLES = 3
"""Samples of each 10 s window."""

MISMATCHED = 3
"""Number of other recordings that a clip is also compared with, for the mismatched level."""

Window = tuple[str, int | None]
"""A recording and the index of its 10 s window; None for the whole recording."""
Progress = Callable[[Sequence[Pair], str], Iterable[Pair]]


@dataclass(frozen=True, kw_only=True)
class EvaluationOptions:
    """Options of `evaluate`.

    Raises:
        EvaluationError: an unknown protocol.
    """

    split: str | None = None
    """The split of a manifest to measure; None for "test"."""
    audio: str | Path | None = None
    """Folder or file of the recordings' sound; without it, speech metrics are left out. Items of a
    manifest have their own."""
    semantic: str | Path | None = None
    """Folder or file of semantic tracks, for SRGR."""
    protocol: str = ""
    """ "", or "multires" or "lda", the evaluations of the two papers."""
    patches: PatchOptions | None = None
    """Settings of the patch metrics."""
    features: FeatureModel | None = None
    """The feature extractor of `gesturekit fit-features`; without it, FGD is left out."""
    baselines: Sequence[str] = ()
    """Baselines to compare with, made from the recordings: "mean_pose" and "other_utterance"."""
    seed: int = 0
    """Seed of the bootstrap intervals and of subsamples."""
    progress: Progress = lambda pairs, label: pairs
    """Wraps the pairs of each model, such as in a progress bar."""

    def __post_init__(self) -> None:
        if self.protocol not in PROTOCOLS:
            known = ", ".join(filter(None, PROTOCOLS))
            raise EvaluationError(f"protocol {self.protocol!r}; expected one of {known}")

    def to_json(self) -> dict[str, Any]:
        """Return the settings of the report as plain values."""
        return {
            "seed": self.seed,
            "baselines": list(self.baselines),
            "audio": None if self.audio is None else str(self.audio),
            "semantic": None if self.semantic is None else str(self.semantic),
            "features": self.features and self.features.fingerprint,
        }


@gesturekit_errors()
def evaluate(
    generated: str | Path | Mapping[str, str | Path],
    reference: str | Path | Items,
    **options: Any,
) -> Evaluation:
    """Measure generated motion against recordings, all at the frame rate of the first clip.

    Args:
        generated: folder or file of motion, or {label: folder} of several models; clips are
            matched with recordings by name (`pairs`).
        reference: folder or file of recordings, or a manifest (corpus.jsonl, or `Items` of it),
            cut into its items; Fréchet distances compare with all of them.
        options: the fields of `EvaluationOptions`, such as `audio` and `protocol`.

    Returns:
        the metrics, and everything that was left out with the reason.

    Raises:
        CorpusError: an empty folder, or names that do not match.
        EvaluationError: no clip could be measured, or an unknown protocol.
        UnknownOptionError: a keyword that is not an option.
    """
    chosen = build_options(EvaluationOptions, options, "evaluate")
    if not isinstance(generated, Mapping):
        generated = {"generated": generated}
    folders = {label: Path(folder) for label, folder in generated.items()}
    reference = _recordings(reference, chosen.split)
    split = reference.split or None if isinstance(reference, Items) else None
    if split and chosen.audio is not None:
        raise EvaluationError(f"{reference.path} says where the sound is: leave audio out")
    audio, semantic = (p if p is None else Path(p) for p in (chosen.audio, chosen.semantic))
    found = {
        label: find_pairs(folder, reference, audio=audio, semantic=semantic)
        for label, folder in folders.items()
    }
    fps = _frame_rate(next(iter(found.values())))
    found |= baseline_pairs(chosen.baselines, found, reference, fps)
    statistics = ReferenceStatistics.of(recordings(reference), fps)
    patches = chosen.patches or PatchOptions()
    measure = ClipMetrics(statistics, PROTOCOLS[chosen.protocol], patches)
    run = _Comparison(measure, fps, chosen, reference)
    models = [
        run.model(label, folders.get(label, Path(label)), pairs) for label, pairs in found.items()
    ]
    models[0].excluded += [*statistics.excluded, *run.training.excluded]
    return Evaluation(
        models=models,
        reference=reference.path if isinstance(reference, Items) else reference,
        fps=fps,
        protocol=chosen.protocol,
        settings={
            **chosen.to_json(),
            "split": split,
            "patches": asdict(patches),
            "mismatched": MISMATCHED,
            "resampling": RULE,
        },
        recorded_speeds=run.recorded_speeds(),
        recorded_wrists=run.recorded_wrists(),
    )


def _recordings(reference: str | Path | Items, split: str | None) -> Path | Items:
    """Return the recordings of a path, of a manifest as `Items`.

    Raises:
        CorpusError: the manifest cannot be read, or has no item of the split.
        EvaluationError: a split is given without a manifest.
    """
    if not isinstance(reference, Items):
        reference = Path(reference)
        if reference.suffix.lower() == ".jsonl":
            return Items.of_manifest(reference, split or "test")
    if split is not None:
        raise EvaluationError(f"split={split!r} chooses items of a manifest (.jsonl): {reference}")
    return reference


def _frame_rate(pairs: Pairs) -> float:
    """Return the frame rate of the first generated clip that can be read."""
    reasons = []
    for pair in pairs.pairs:
        try:
            return Motion.load(pair.generated).fps
        except GestureKitError as error:
            reasons.append(str(error))
    raise EvaluationError(f"no generated clip can be read: {reasons[0]}")


class _Comparison:
    """Measures models against the same recordings."""

    def __init__(
        self,
        measure: ClipMetrics,
        fps: float,
        options: EvaluationOptions,
        reference: Path | Items,
    ) -> None:
        self.measure = measure
        self.training = TrainingMotion()
        if LIFE in measure.groups:
            self.training = TrainingMotion.of(reference, options.seed)
        self.fps = fps
        self.seed = options.seed
        self.protocol = options.protocol
        self.features = options.features
        self.progress = options.progress
        self._recording_metrics: dict[Window, dict[str, float]] = {}
        self._speeds: dict[Window, SpeedHistogram] = {}
        self._wrists: dict[Window, np.ndarray] = {}
        self._windows: dict[Window, Motion] = {}

    def model(self, label: str, path: Path, found: Pairs) -> ModelResult:
        """Measure the clips of one model.

        Raises:
            EvaluationError: no clip can be measured.
        """
        result = ModelResult(label, path, excluded=list(found.excluded), notes=list(found.notes))
        clip_set = SetMetrics(self.measure, self.seed, LifeMetrics(self.training, self.seed))
        problems: dict[tuple[str, str], list[str]] = {}
        for pair in self.progress(found.pairs, label):
            try:
                clip = load_clip(pair, self.fps)
            except (GestureKitError, AudioFeaturesError) as error:
                result.excluded.append(Excluded(pair.name, str(error)))
                continue
            figures, failed = self.measure.generated(clip)
            self._measure_recording(clip)
            window = (pair.stem, pair.window)
            for key, reason in failed:
                problems.setdefault((key, reason), []).append(pair.name)
            result.clips.append(
                ClipResult(
                    pair,
                    clip.generated.duration,
                    figures,
                    self._recording_metrics[window],
                    self._mismatched(clip, found.pairs),
                    (*clip.notes, *clip_notes(clip, self._length())),
                )
            )
            clip_set.add(clip, self._speeds[window])
        if not result.clips:
            reasons = "; ".join(item.reason for item in result.excluded[:3])
            raise EvaluationError(f"{path}: no clip could be measured: {reasons}")
        self._summarise(result, clip_set)
        for key, reason in clip_set.problems:
            problems.setdefault((key, reason), []).append("the whole set")
        for (key, reason), names in problems.items():
            title = DEFINITIONS[key].name if key in DEFINITIONS else key
            result.excluded.append(Excluded(listed(names, 3), reason, title))
        return result

    def recorded_speeds(self) -> SpeedHistogram:
        """Pool the joint speeds of all recordings that a clip was compared with."""
        return pooled(list(self._speeds.values()))

    def recorded_wrists(self) -> np.ndarray:
        """Return (N,) wrist speeds of the same recordings, m/s."""
        return thinned(list(self._wrists.values()))

    def _measure_recording(self, clip: Clip) -> None:
        """Measure the recording of a clip, once."""
        window = (clip.pair.stem, clip.pair.window)
        if window not in self._recording_metrics:
            self._recording_metrics[window] = self.measure.recording(clip)[0]
            self._speeds[window] = SpeedHistogram.of([speeds_of(clip.recording, clip.joints)])
            self._wrists[window] = wrists_of(clip.recording)
            self._windows[window] = clip.recording

    def _mismatched(self, clip: Clip, pairs: Sequence[Pair]) -> dict[str, float]:
        """Measure the clip with the sounds, and the motion, of other recordings."""
        figures: dict[str, float] = {}
        if SPEECH in self.measure.groups and clip.pair.audio is not None:
            sounds = []
            others = list(dict.fromkeys((p.audio, p.window) for p in pairs if p.audio))
            for path, index in _after(others, (clip.pair.audio, clip.pair.window), MISMATCHED):
                try:
                    sounds.append(load_sound(path, index))
                except AudioFeaturesError:
                    continue  # reported with the clip that it belongs to
            figures |= self.measure.mismatched_sound(clip, sounds)
        recordings = self.measure.statistics.recordings
        for other in _after(list(recordings), clip.pair.stem, 1):
            figures |= self.measure.mismatched_motion(clip, recordings[other])
        return figures

    def _length(self) -> float:
        """Return the length of a clip relative to its recording."""
        return MULTIRES_LENGTH if self.protocol == "multires" else 1.0

    def _summarise(self, result: ModelResult, clip_set: SetMetrics) -> None:
        clips = result.clips
        for key in DEFINITIONS:
            has = [clip for clip in clips if key in clip.figures]
            if not has:
                continue
            stems = [clip.pair.stem for clip in has]
            result.figures[key] = MetricResult(
                key,
                interval_of([clip.figures[key] for clip in has], stems, self.seed),
                recording=_mean(clip.recording.get(key) for clip in has),
                chance=_mean(clip.figures.get(f"{key}_chance") for clip in has),
                mismatched=_mean(clip.mismatched.get(key) for clip in has),
                note="" if len(has) == len(clips) else f"{len(has)} of {len(clips)} clips",
            )
        result.figures |= clip_set.pooled()
        if LIFE in self.measure.groups:
            result.verdict = verdict(result.figures)
        if FRECHET in self.measure.groups:
            full = list(self.measure.statistics.recordings.values())
            whole = {(key, None) for key in self.measure.statistics.recordings}
            seen = {(clip.pair.stem, clip.pair.window) for clip in clips}
            compared = None if seen == whole else [self._windows[window] for window in sorted(seen)]
            result.figures |= clip_set.frechet(full, compared, self.features)
        if PATCHES in self.measure.groups:
            result.by_recording = self._by_recording(result.clips)
        result.speeds = pooled(clip_set.histograms)
        result.wrists = thinned(clip_set.wrists)
        result.notes += self._protocol_notes(result)

    def _by_recording(self, clips: Sequence[ClipResult]) -> dict[str, dict[str, Interval]]:
        """Average the patch metrics over the samples of each recording (eq. 18)."""
        by_recording = {}
        for stem in sorted({clip.pair.stem for clip in clips}):
            figures: dict[str, Interval] = {}
            for key, definition in DEFINITIONS.items():
                values = [
                    clip.figures[key]
                    for clip in clips
                    if clip.pair.stem == stem and key in clip.figures
                ]
                if definition.group == PATCHES and values:
                    figures[key] = interval_of(values, [stem] * len(values), self.seed)
            by_recording[stem] = figures
        return by_recording

    def _protocol_notes(self, result: ModelResult) -> list[str]:
        """Return notes on clips that differ from the protocol in number or length."""
        counts = Counter((clip.pair.stem, clip.pair.window) for clip in result.clips)
        wanted = {"multires": MULTIRES_SAMPLES, "lda": LDA_SAMPLES}.get(self.protocol)
        other = [f"{stem}: {n}" for (stem, _), n in counts.items() if n != wanted]
        notes = []
        if wanted and other:
            what = "window" if self.protocol == "lda" else "recording"
            notes.append(f"the protocol takes {wanted} samples of each {what}; {listed(other, 3)}")
        if self.protocol == "lda":
            odd = [c for c in result.clips if abs(c.seconds - WINDOW_SECONDS) > LENGTH_TOLERANCE]
            if odd:
                notes.append(
                    f"the protocol takes clips of {WINDOW_SECONDS:g} s; {len(odd)} of "
                    f"{len(result.clips)} are of another length and are cut into such clips for "
                    "Fréchet distances"
                )
        return notes


def _after(items: list, item: Any, count: int) -> list:
    """Return up to `count` other items, cyclically from the next one."""
    at = items.index(item) if item in items else 0
    return [items[(at + k) % len(items)] for k in range(1, min(count, len(items) - 1) + 1)]


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
