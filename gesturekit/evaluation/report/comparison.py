"""Evaluate: folders of generated motion against a folder of recordings."""

from __future__ import annotations

import importlib.metadata
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from audio_features import AudioFeaturesError
from gesturekit.errors import EvaluationError, GestureKitError, gesturekit_errors
from gesturekit.evaluation.clip_metrics import Known, Measurer, load_sound
from gesturekit.evaluation.clips import Clip, load_clip
from gesturekit.evaluation.definitions import (
    DEFINITIONS,
    FRECHET,
    GROUPS,
    MOVEMENT,
    PATCHES,
    SPEECH,
    PatchOptions,
)
from gesturekit.evaluation.frame_rate import RULE
from gesturekit.evaluation.intervals import Interval, interval_of
from gesturekit.evaluation.metrics.distributions import SpeedHistogram
from gesturekit.evaluation.metrics.physical import joint_speed
from gesturekit.evaluation.pairs import (
    WINDOW_SECONDS,
    Excluded,
    Items,
    Pair,
    Pairs,
    find_pairs,
    recordings,
)
from gesturekit.evaluation.report.results import ClipResult, Evaluation, Figure, ModelResult
from gesturekit.evaluation.sets import Gathered, pooled, speeds_of, thinned, wrists_of
from gesturekit.motion import Motion
from gesturekit.motion.body_size import body_scale
from gesturekit.motion.defects import MAX_SPEED, format_speed, speed_limit

if TYPE_CHECKING:
    from gesturekit.evaluation.metrics.frechet.feature_model import FeatureModel

PROTOCOLS = {
    "": GROUPS,
    "multires": (MOVEMENT, PATCHES),
    "lda": (SPEECH, MOVEMENT, FRECHET),
}
"""Which groups of measures a protocol takes; "" takes all."""
MULTIRES_SAMPLES = 200
MULTIRES_LENGTH = 2.0
"""Samples of a training sequence, and their length in lengths of the sequence."""
LDA_SAMPLES = 3
"""Samples of each 10 s window."""

MISMATCHED = 3
"""With how many other recordings a clip is also compared."""
LENGTH_TOLERANCE = 0.1
"""Seconds by which a clip and its recording may differ without a note."""
STILL = 1e-4
"""m/s on the reference body; a frame in which no joint is faster stands still."""

Which = tuple[str, int | None]
Progress = Callable[[Sequence[Pair], str], Iterable[Pair]]


@gesturekit_errors()
def evaluate(
    generated: str | Path | Mapping[str, str | Path],
    reference: str | Path | Items,
    *,
    split: str | None = None,
    audio: str | Path | None = None,
    semantic: str | Path | None = None,
    protocol: str = "",
    patches: PatchOptions | None = None,
    features: FeatureModel | None = None,
    seed: int = 0,
    progress: Progress = lambda pairs, label: pairs,
) -> Evaluation:
    """Measure generated motion against recordings, all at the frame rate of the first clip.

    Args:
        generated: folder or file of motion, or {label: folder} of several models; clips belong
            to recordings by name (`pairs`).
        reference: folder or file of recordings, or a manifest (corpus.jsonl, or `Items` of it),
            cut as it says; Fréchet distances go to all of them.
        split: which items of a manifest; None for "test".
        audio: folder or file of the recordings' sound; without it speech is not measured.
            `Items` have their own.
        semantic: folder or file of semantic tracks, for SRGR.
        protocol: "", or "multires" or "lda", the evaluations of the two papers.
        patches: how patches are compared.
        features: what `gesturekit fit-features` made; without it there is no FGD.
        seed: of the bootstrap intervals.
        progress: wraps the pairs of each model, such as in a progress bar.

    Returns:
        the figures, with everything that was left out and why.

    Raises:
        CorpusError: an empty folder, or names that do not pair.
        EvaluationError: no clip could be measured, or an unknown protocol.
    """
    if protocol not in PROTOCOLS:
        known = ", ".join(filter(None, PROTOCOLS))
        raise EvaluationError(f"protocol {protocol!r}; expected one of {known}")
    named = generated if isinstance(generated, Mapping) else {"generated": generated}
    folders = {label: Path(folder) for label, folder in named.items()}
    reference = _recordings(reference, split)
    if isinstance(reference, Items) and reference.split and audio is not None:
        raise EvaluationError(f"{reference.path} says where the sound is: leave audio out")
    audio, semantic = (None if path is None else Path(path) for path in (audio, semantic))
    patches = patches or PatchOptions()
    found = {
        label: find_pairs(folder, reference, audio=audio, semantic=semantic)
        for label, folder in folders.items()
    }
    fps = _frame_rate(next(iter(found.values())))
    known = Known.of(recordings(reference), fps)
    run = _Run(Measurer(known, PROTOCOLS[protocol], patches), fps, seed, protocol, features)
    models = [run.model(label, folders[label], pairs, progress) for label, pairs in found.items()]
    models[0].excluded += known.excluded
    return Evaluation(
        models=models,
        reference=reference.path if isinstance(reference, Items) else reference,
        fps=fps,
        protocol=protocol,
        settings={
            "seed": seed,
            "audio": None if audio is None else str(audio),
            "split": (reference.split or None) if isinstance(reference, Items) else None,
            "semantic": None if semantic is None else str(semantic),
            "patches": asdict(patches),
            "features": None if features is None else features.fingerprint,
            "mismatched": MISMATCHED,
            "resampling": RULE,
        },
        versions=_versions(),
        recorded_speeds=run.recorded_speeds(),
        recorded_wrists=run.recorded_wrists(),
    )


def _recordings(reference: str | Path | Items, split: str | None) -> Path | Items:
    """Return the recordings that a path stands for.

    Raises:
        CorpusError: a manifest that cannot be read, or that has no item of the split.
        EvaluationError: a split of what is no manifest.
    """
    if not isinstance(reference, Items):
        reference = Path(reference)
        if reference.suffix.lower() == ".jsonl":
            return Items.of_manifest(reference, split or "test")
    if split is not None:
        raise EvaluationError(f"split={split!r} chooses items of a manifest (.jsonl): {reference}")
    return reference


def _frame_rate(pairs: Pairs) -> float:
    """The frame rate of the first generated clip that can be read: the model's."""
    reasons = []
    for pair in pairs.pairs:
        try:
            return Motion.load(pair.generated).fps
        except GestureKitError as error:
            reasons.append(str(error))
    raise EvaluationError(f"no generated clip can be read: {reasons[0]}")


class _Run:
    """One evaluation: what its models share."""

    def __init__(
        self,
        measurer: Measurer,
        fps: float,
        seed: int,
        protocol: str,
        features: FeatureModel | None,
    ) -> None:
        self.measurer = measurer
        self.fps = fps
        self.seed = seed
        self.protocol = protocol
        self.features = features
        self._figures: dict[Which, dict[str, float]] = {}
        self._speeds: dict[Which, SpeedHistogram] = {}
        self._wrists: dict[Which, np.ndarray] = {}
        self._windows: dict[Which, Motion] = {}

    def model(self, label: str, path: Path, found: Pairs, progress: Progress) -> ModelResult:
        """Measure the clips of one model.

        Raises:
            EvaluationError: none of them can be measured.
        """
        result = ModelResult(label, path, excluded=list(found.excluded), notes=list(found.notes))
        gathered = Gathered(self.measurer, self.seed)
        problems: dict[tuple[str, str], list[str]] = {}
        for pair in progress(found.pairs, label):
            try:
                clip = load_clip(pair, self.fps)
            except (GestureKitError, AudioFeaturesError) as error:
                result.excluded.append(Excluded(pair.name, str(error)))
                continue
            figures, troubles = self.measurer.figures(clip)
            self._see(clip)
            which = (pair.stem, pair.window)
            for key, reason in troubles:
                problems.setdefault((key, reason), []).append(pair.name)
            result.clips.append(
                ClipResult(
                    pair,
                    clip.generated.duration,
                    figures,
                    self._figures[which],
                    self._unlike(clip, found.pairs),
                    (*clip.notes, *self._oddities(clip)),
                )
            )
            gathered.add(clip, self._speeds[which])
        if not result.clips:
            reasons = "; ".join(item.reason for item in result.excluded[:3])
            raise EvaluationError(f"{path}: no clip could be measured: {reasons}")
        self._summarise(result, gathered)
        for key, reason in gathered.problems:
            problems.setdefault((key, reason), []).append("the whole set")
        for (key, reason), names in problems.items():
            title = DEFINITIONS[key].name if key in DEFINITIONS else key
            result.excluded.append(Excluded(_some(names), reason, title))
        return result

    def recorded_speeds(self) -> SpeedHistogram:
        """Of all recordings that a clip was compared with."""
        return pooled(list(self._speeds.values()))

    def recorded_wrists(self) -> np.ndarray:
        """Wrist speeds of the same, m/s."""
        return thinned(list(self._wrists.values()))

    def _see(self, clip: Clip) -> None:
        """Take the recording's own figures, once."""
        which = (clip.pair.stem, clip.pair.window)
        if which not in self._figures:
            self._figures[which] = self.measurer.recording(clip)[0]
            self._speeds[which] = SpeedHistogram.of([speeds_of(clip.recording, clip.joints)])
            self._wrists[which] = wrists_of(clip.recording)
            self._windows[which] = clip.recording

    def _unlike(self, clip: Clip, pairs: Sequence[Pair]) -> dict[str, float]:
        """Figures beside the sounds, and the motion, of other recordings."""
        figures: dict[str, float] = {}
        if SPEECH in self.measurer.groups and clip.pair.audio is not None:
            sounds = []
            others = list(dict.fromkeys((p.audio, p.window) for p in pairs if p.audio))
            for path, window in _after(others, (clip.pair.audio, clip.pair.window), MISMATCHED):
                try:
                    sounds.append(load_sound(path, window))
                except AudioFeaturesError:
                    continue  # told where it is the clip's own sound
            figures |= self.measurer.mismatched(clip, sounds)
        recordings = self.measurer.known.recordings
        for other in _after(list(recordings), clip.pair.stem, 1):
            figures |= self.measurer.unlike(clip, recordings[other])
        return figures

    def _oddities(self, clip: Clip) -> list[str]:
        """What a reader should know of a clip that can be measured."""
        notes = []
        wanted = MULTIRES_LENGTH if self.protocol == "multires" else 1.0
        gap = clip.generated.duration - wanted * clip.recording.duration
        if abs(gap) > max(LENGTH_TOLERANCE, 1.5 / self.fps):
            what = "its recording" if wanted == 1.0 else f"{wanted:g} times its recording"
            notes.append(f"{abs(gap):.2f} s {'longer' if gap > 0 else 'shorter'} than {what}")
        scale = body_scale(clip.generated.skeleton)
        fastest = joint_speed(clip.generated, clip.joints).max(axis=1)
        still = float((fastest < STILL * scale).mean())
        if still > 0.05:
            notes.append(f"stands still in {100 * still:.0f} % of its frames")
        if fastest.max() > (limit := MAX_SPEED * scale):
            at, speed = fastest.argmax() / self.fps, format_speed(fastest.max())
            notes.append(f"jumps at {at:.2f} s ({speed}, {speed_limit(limit)})")
        return notes

    def _summarise(self, result: ModelResult, gathered: Gathered) -> None:
        clips = result.clips
        for key in DEFINITIONS:
            has = [clip for clip in clips if key in clip.figures]
            if not has:
                continue
            stems = [clip.pair.stem for clip in has]
            result.figures[key] = Figure(
                key,
                interval_of([clip.figures[key] for clip in has], stems, self.seed),
                recording=_mean(clip.recording.get(key) for clip in has),
                chance=_mean(clip.figures.get(f"{key}_chance") for clip in has),
                mismatched=_mean(clip.mismatched.get(key) for clip in has),
                note="" if len(has) == len(clips) else f"{len(has)} of {len(clips)} clips",
            )
        result.figures |= gathered.figures()
        if FRECHET in self.measurer.groups:
            full = list(self.measurer.known.recordings.values())
            whole = {(key, None) for key in self.measurer.known.recordings}
            seen = {(clip.pair.stem, clip.pair.window) for clip in clips}
            compared = None if seen == whole else [self._windows[which] for which in sorted(seen)]
            result.figures |= gathered.frechet_figures(full, compared, self.features)
        if PATCHES in self.measurer.groups:
            self._by_recording(result)
        result.speeds = pooled(gathered.histograms)
        result.wrists = thinned(gathered.wrists)
        result.notes += self._protocol_notes(result)

    def _by_recording(self, result: ModelResult) -> None:
        """Eq. 18: the expectation over samples, for each recording."""
        for stem in sorted({clip.pair.stem for clip in result.clips}):
            figures: dict[str, Interval] = {}
            for key, definition in DEFINITIONS.items():
                values = [
                    clip.figures[key]
                    for clip in result.clips
                    if clip.pair.stem == stem and key in clip.figures
                ]
                if definition.group == PATCHES and values:
                    figures[key] = interval_of(values, [stem] * len(values), self.seed)
            result.by_recording[stem] = figures

    def _protocol_notes(self, result: ModelResult) -> list[str]:
        """Where the clips are not what the protocol asks for."""
        counts = Counter((clip.pair.stem, clip.pair.window) for clip in result.clips)
        wanted = {"multires": MULTIRES_SAMPLES, "lda": LDA_SAMPLES}.get(self.protocol)
        other = [f"{stem}: {n}" for (stem, _), n in counts.items() if n != wanted]
        notes = []
        if wanted and other:
            what = "window" if self.protocol == "lda" else "recording"
            notes.append(f"the protocol takes {wanted} samples of each {what}; {_some(other)}")
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
    """Up to `count` other items, from the next one on, round and round."""
    at = items.index(item) if item in items else 0
    return [items[(at + k) % len(items)] for k in range(1, min(count, len(items) - 1) + 1)]


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def _versions() -> dict[str, str]:
    versions = {}
    for name in ("gesturekit", "numpy", "scipy", "scikit-learn", "librosa"):
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = "not installed as a package"
    return versions
