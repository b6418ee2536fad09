"""`evaluate`: measure folders of generated motion against recordings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from audio_features.errors import check_values
from gesturekit.corpus.takes import merged_speakers, neighbours, pieces_of_takes, takes_of
from gesturekit.errors import EvaluationError, GestureKitError, gesturekit_errors
from gesturekit.evaluation.definitions import (
    DEFINITIONS,
    FRECHET,
    GROUPS,
    MOVEMENT,
    PATCHES,
    POOLED,
    SPEECH,
    Variants,
)
from gesturekit.evaluation.measuring.clip_metrics import ClipMetrics, ReferenceStatistics
from gesturekit.evaluation.measuring.clips import (
    LENGTH_TOLERANCE,
    RETARGETED,
    SHORTER,
    forget_files,
    load_clip,
    without_namespace,
)
from gesturekit.evaluation.measuring.made_motion import baseline_pairs
from gesturekit.evaluation.measuring.measurer import (
    MISMATCHED,
    Measurer,
    Progress,
    measure_all,
)
from gesturekit.evaluation.measuring.set_metrics import SetMeasurement
from gesturekit.evaluation.metrics.inputs import RULE
from gesturekit.evaluation.pairs import (
    WINDOW_SECONDS,
    Excluded,
    Items,
    Pair,
    Pairs,
    Window,
    find_pairs,
    grouped,
)
from gesturekit.evaluation.results import ClipResult, Evaluation, Interval, ModelResult
from gesturekit.evaluation.statistics.intervals import interval_over_samples
from gesturekit.evaluation.statistics.model_metrics import metric_results
from gesturekit.evaluation.statistics.questions import answer_questions
from gesturekit.field_docs import build_options
from gesturekit.motion.parts import body_joints
from gesturekit.wording import counted, listed

if TYPE_CHECKING:
    from gesturekit.evaluation.metrics.frechet.feature_model import Extractor

SAME_LENGTH = 0.1
"""Largest relative difference of the clips of two models for one recording."""
PROTOCOLS = {
    "": GROUPS,
    "multires": (MOVEMENT, PATCHES),
    "lda": (SPEECH, MOVEMENT, FRECHET),
}
"""Groups of metrics that a protocol takes; "" takes all."""
CHEAP = {d.taken_with for d in DEFINITIONS.values() if d.cheap}
"""Groups that have cheap metrics."""
MULTIRES_SAMPLES = 200
MULTIRES_LENGTH = 2.0
"""Samples of each training sequence, and their length relative to the sequence."""
LDA_SAMPLES = 3
"""Samples of each 10 s window."""


@dataclass(frozen=True, kw_only=True)
class EvaluationOptions:
    """Options of `evaluate`.

    Raises:
        EvaluationError: an unknown protocol, or a seed below 0.
    """

    split: str | None = None
    """The split of a manifest to measure; None for "test"."""
    audio: str | Path | None = None
    """Folder or file of the recordings' sound; without it, speech metrics are left out. Items of a
    manifest have their own."""
    semantic: str | Path | None = None
    """Folder or file of semantic tracks, for SRGR."""
    take_pattern: str | None = None
    """Regular expression to search for in the name of each recording, for takes (recording
    sessions) that were cut into files: the take is its group, see
    `gesturekit.corpus.takes.take_in`. By default items of a manifest have their takes, and each
    file of a folder is a take of its own."""
    take_table: str | Path | None = None
    """CSV table with the columns id and take, instead of a pattern or beside it."""
    protocol: str = ""
    """ "", or "multires" or "lda", the evaluations of the two papers."""
    cheap: bool = False
    """Take only the cheap metrics (`cheap` in `definitions`): all that the verdict rests on."""
    variants: Variants = Variants()
    """Variants of the metrics."""
    features: Extractor | None = None
    """The feature extractor of `gesturekit fit-features`, or BEAT2's (`load_extractor`); without
    it, FGD is left out."""
    baselines: Sequence[str] = ()
    """Baselines to compare with, made from the recordings: "mean_pose" and "other_utterance". The
    label of a model says that it is one too."""
    seed: int = 0
    """Seed of the bootstrap intervals and of subsamples."""
    workers: int = 1
    """Number of processes; the results are the same for any number."""
    progress: Progress = lambda portions, total, label: portions
    """Wraps the portions as they are done, such as in a progress bar, given number and label."""

    def __post_init__(self) -> None:
        known = f"one of {', '.join(filter(None, PROTOCOLS))}"
        checks: list[tuple[str, object, bool, str]] = [
            ("protocol", self.protocol, self.protocol in PROTOCOLS, known),
            ("seed", self.seed, self.seed >= 0, "a whole number from 0"),
        ]
        check_values(EvaluationError, "", checks)

    @property
    def groups(self) -> tuple[str, ...]:
        """Groups of metrics to take."""
        groups = PROTOCOLS[self.protocol]
        return tuple(group for group in groups if group in CHEAP) if self.cheap else groups

    def to_json(self, split: str | None) -> dict[str, Any]:
        """Return the settings of the report as plain values; `split` is the one measured."""
        return {
            "seed": self.seed,
            "baselines": list(self.baselines),
            "audio": None if self.audio is None else str(self.audio),
            "semantic": None if self.semantic is None else str(self.semantic),
            "features": self.features and self.features.fingerprint,
            "split": split,
            "variants": asdict(self.variants),
            "mismatched": MISMATCHED,
            "resampling": RULE,
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
        reference: folder or file of recordings, or a manifest (corpus.jsonl, or `Items` of it);
            Fréchet distances use all items of the split, with protocol lda of all splits.
        options: the fields of `EvaluationOptions`, such as `audio` and `protocol`.

    Returns:
        the metrics, and everything that was left out with the reason.

    Raises:
        CorpusError: an empty folder, or names that do not match.
        EvaluationError: no clip could be measured, or an option is wrong.

    Examples:
        >>> gk.load("demo").generate(seconds=3).save(folder / "recorded" / "a.bvh")
        >>> (model,) = gk.evaluate(folder / "recorded", folder / "recorded").models
        >>> model.metrics["arm_speed"].interval.value == model.metrics["arm_speed"].recording
        True
    """
    chosen = build_options(EvaluationOptions, options, "evaluate")
    forget_files()
    if not isinstance(generated, Mapping):
        generated = {"generated": generated}
    folders = {label: Path(folder) for label, folder in generated.items()}
    reference = _recordings(reference, chosen)
    pairs, itself = _pairs(folders, reference, chosen)
    fps = _frame_rate(next(iter(pairs.values())))
    pairs |= baseline_pairs(chosen.baselines, pairs, reference, fps)
    measurer = _measurer(pairs, reference, fps, itself, chosen)
    measured = measure_all(measurer, chosen.workers, chosen.progress)
    models = [
        _model_result(label, folders.get(label, Path(label)), some, measured[label], measurer)
        for label, some in pairs.items()
    ]
    _judge(models, reference, chosen.protocol)
    whole = measured[models[0].label][1]
    models[0].excluded += [*measurer.measure.statistics.excluded, *whole.training_excluded]
    return Evaluation(
        models=models,
        reference=reference.path,
        fps=fps,
        protocol=chosen.protocol,
        settings=chosen.to_json(reference.split or None),
        recorded_speeds=whole.recorded_speeds,
        recorded_wrists=whole.recorded_wrists,
    )


def _judge(models: Sequence[ModelResult], reference: Items, protocol: str) -> None:
    """Answer the three questions, and add notes on models and recordings that flatter them."""
    for model in models:
        model.notes += _protocol_notes(model, protocol)
    if POOLED in PROTOCOLS[protocol]:
        answer_questions(models)
    _mark_unlike(models)
    if reference.split:
        beside = neighbours((*reference.items, *reference.others), reference.split)
        models[0].notes += [beside] if beside else []


def _pairs(
    folders: Mapping[str, Path], reference: Items, options: EvaluationOptions
) -> tuple[dict[str, Pairs], dict[str, Pair]]:
    """Return {label: clips of the recordings that all models have}, and each recording with itself.

    The latter are of all splits; both have the takes that the options give.
    """
    sources = reference.recordings(all_splits=True)
    takes = takes_of(list(sources), options.take_pattern, options.take_table)
    itself = {k: Pair(k, k, None, s, s, take=takes.get(k, "")) for k, s in sources.items()}
    audio, semantic = (p if p is None else Path(p) for p in (options.audio, options.semantic))
    found = {
        label: find_pairs(folder, reference, audio=audio, semantic=semantic)
        for label, folder in folders.items()
    }
    _keep_common_recordings(found)
    for some in found.values():
        some.pairs = [replace(pair, take=itself[pair.stem].take) for pair in some.pairs]
    first = next(iter(found.values()))
    if takes:
        first.notes += merged_speakers((p.stem, p.speaker, p.take) for p in first.pairs)
    else:
        own = {p.stem: p.reference.load_motion for p in first.pairs if p.take == p.stem}
        first.notes += pieces_of_takes(own)
    return found, itself


def _measurer(
    pairs: Mapping[str, Pairs],
    reference: Items,
    fps: float,
    itself: Mapping[str, Pair],
    options: EvaluationOptions,
) -> Measurer:
    """Return all that is to be measured."""
    # In Table 4 of Alexanderson et al. 2023 sets are compared with the full dataset: all splits.
    compared = reference.recordings(all_splits=options.protocol == "lda")
    statistics = ReferenceStatistics.of(compared, fps)
    return Measurer(
        measure=ClipMetrics(statistics, options.groups, options.variants, options.cheap),
        pairs={label: some.pairs for label, some in pairs.items()},
        itself=itself,
        training=reference.training,
        fps=fps,
        length=MULTIRES_LENGTH if options.protocol == "multires" else 1.0,
        features=options.features,
        seed=options.seed,
        without=_joints_to_leave_out(pairs, fps),
    )


def _recordings(reference: str | Path | Items, options: EvaluationOptions) -> Items:
    """Return the recordings of a folder, a file or a manifest.

    Raises:
        CorpusError: there are none, or the manifest cannot be read or has no item of the split.
        EvaluationError: a split is given without a manifest, or sound beside one.
    """
    if not isinstance(reference, Items) and Path(reference).suffix.lower() == ".jsonl":
        reference = Items.of_manifest(Path(reference), options.split or "test")
    elif options.split is not None:
        wrong = f"split={options.split!r} chooses items of a manifest (.jsonl): {reference}"
        raise EvaluationError(wrong)
    if not isinstance(reference, Items):
        return Items.of_folder(Path(reference))
    if reference.split and options.audio is not None:
        raise EvaluationError(f"{reference} already gives the sound: leave audio out")
    return reference


def _frame_rate(pairs: Pairs) -> float:
    """Return the frame rate of the first generated clip that can be read."""
    reasons = []
    for pair in pairs.pairs:
        try:
            return pair.generated.load_motion().fps
        except GestureKitError as error:
            reasons.append(str(error))
    raise EvaluationError(f"no generated clip can be read: {reasons[0]}")


def _model_result(
    label: str,
    path: Path,
    pairs: Pairs,
    measured: tuple[Sequence[ClipResult | Excluded], SetMeasurement],
    measurer: Measurer,
) -> ModelResult:
    """Return the results of a model, from the measurements of its clips and of their set.

    Raises:
        EvaluationError: no clip could be measured.
    """
    clips = [clip for clip in measured[0] if isinstance(clip, ClipResult)]
    excluded = [*pairs.excluded, *(clip for clip in measured[0] if isinstance(clip, Excluded))]
    if not clips:
        reasons = "; ".join(item.reason for item in excluded[:3])
        raise EvaluationError(f"{path}: no clip could be measured: {reasons}")
    likeness, whole = measurer.likeness(label, clips), measured[1]
    for clip, values in zip(clips, whole.by_clip):
        clip.metrics |= values
    named = [
        *((clip.pair.name, clip.problems) for clip in clips),
        ("the whole set", whole.problems),
    ]
    problems = grouped(((key, why), name) for name, several in named for key, why in several)
    for (key, reason), names in problems.items():
        title = DEFINITIONS[key].name if key in DEFINITIONS else key
        excluded.append(Excluded(listed(names, 3), reason, title))
    return ModelResult(
        label,
        path,
        metrics=metric_results(clips, whole.metrics, measurer.ceilings, likeness),
        by_recording=_by_recording(clips) if PATCHES in measurer.measure.groups else {},
        clips=clips,
        excluded=excluded,
        notes=list(pairs.notes),
        speeds=whole.speeds,
        wrists=whole.wrists,
    )


def _by_recording(clips: Sequence[ClipResult]) -> dict[str, dict[str, Interval]]:
    """Average the patch metrics over the samples of each recording (eq. 18)."""
    found: dict[str, dict[str, Interval]] = {}
    for stem, metrics in sorted(grouped((clip.pair.stem, clip.metrics) for clip in clips).items()):
        known = grouped((key, value) for values in metrics for key, value in values.items())
        patches = [d for d in DEFINITIONS.values() if d.group == PATCHES and d.key in known]
        found[stem] = {d.key: interval_over_samples(known[d.key], d.within) for d in patches}
    return found


def _protocol_notes(result: ModelResult, protocol: str) -> list[str]:
    """Return notes on clips that differ from the protocol in number or length."""
    if not protocol:
        return []
    counts, notes = Counter(clip.pair.of for clip in result.clips), []
    is_lda = protocol == "lda"
    wanted, what = (LDA_SAMPLES, "window") if is_lda else (MULTIRES_SAMPLES, "recording")
    if other := [f"{stem}: {n}" for (stem, _), n in counts.items() if n != wanted]:
        notes.append(f"the protocol takes {wanted} samples of each {what}; {listed(other, 3)}")
    odd = [c for c in result.clips if abs(c.seconds - WINDOW_SECONDS) > LENGTH_TOLERANCE]
    if is_lda and odd:
        notes.append(
            f"the protocol takes clips of {WINDOW_SECONDS:g} s; {len(odd)} of {len(result.clips)} "
            "are of another length and are cut into such clips for Fréchet distances"
        )
    return notes


def _keep_common_recordings(found: Mapping[str, Pairs]) -> None:
    """Set clips apart that other models have no counterpart of, with a note and the reason.

    A mean over other recordings, or other windows of them, is not comparable.

    Raises:
        EvaluationError: no recording has clips of all models.
    """
    windows = {key: {pair.of for pair in pairs.pairs} for key, pairs in found.items()}
    common = set.intersection(*windows.values())
    if not common:
        counts = "; ".join(f"{key}: {_names_of(seen)}" for key, seen in windows.items())
        raise EvaluationError(
            f"no recording, or window of one, has clips of all models ({counts}), so they cannot "
            "be compared; evaluate each alone, or render the same files"
        )
    for label, pairs in found.items():
        apart = [pair for pair in pairs.pairs if pair.of not in common]
        pairs.pairs = [pair for pair in pairs.pairs if pair.of in common]
        for pair in apart:
            lack = [key for key, seen in windows.items() if pair.of not in seen]
            reason = f"set apart: {listed(lack, 3)} has no clip of this recording"
            pairs.excluded.append(Excluded(pair.name, reason))
        if apart:
            shared = f"the {counted(len(common), 'recording')} that they share"
            lost = f"{counted(len(apart), 'clip')} of {label} set apart"
            pairs.notes.append(f"all models are compared on {shared}; {lost}")


def _joints_to_leave_out(found: Mapping[str, Pairs], fps: float) -> frozenset[str]:
    """Return the bare names of body joints that the first clip of some model lacks.

    All models are measured without them; a note of each model that lacks some says so.
    """
    without: set[str] = set()
    for label, pairs in found.items():
        for pair in pairs.pairs:
            try:
                clip = load_clip(pair, fps)
            except GestureKitError:
                continue  # reported when it is measured
            lost = [n for n in body_joints(clip.recording.skeleton) if n not in clip.joints]
            without |= {without_namespace(name) for name in lost}
            if lost and len(found) > 1:
                lacks = f"{label} lacks {listed(lost, 5)} of the recordings' rig"
                pairs.notes.append(f"{lacks}: all models are measured without")
            break
    return frozenset(without)


def _mark_unlike(models: Sequence[ModelResult]) -> None:
    """Mark models whose clips were retargeted, or have another length than the first model's."""
    first = models[0]
    usual = _lengths(first)
    for model in models:
        changed = sum(RETARGETED in clip.notes for clip in model.clips)
        if changed:
            model.marks.append("retargeted")
            model.notes.append(
                f"{changed} of {counted(len(model.clips), 'clip')} on another rig than the "
                "recording: retargeted to it before anything was measured, so that feet and reach "
                "are partly those of the retargeting"
            )
        short = sum(SHORTER in note for clip in model.clips for note in clip.notes)
        if short:
            model.notes.append(
                f"{short} of {counted(len(model.clips), 'clip')} shorter than the recording, which "
                "is compared as a whole"
            )
        own = _lengths(model)
        shared = [window for window in own if window in usual]
        other = [w for w in shared if abs(own[w] - usual[w]) > SAME_LENGTH * usual[w]]
        if len(other) > len(shared) / 2:
            lengths = [float(np.median([of[w] for w in other])) for of in (own, usual)]
            model.marks.append("other length")
            model.notes.append(
                f"clips of {lengths[0]:.3g} s where those of {first.label} have {lengths[1]:.3g} "
                "s: diversity, coverage, CCA and Fréchet distances depend on length, and do not "
                "rank these models"
            )


def _lengths(model: ModelResult) -> dict[Window, float]:
    """Return the mean length of a model's clips of each recording, seconds."""
    every = grouped((clip.pair.of, clip.seconds) for clip in model.clips)
    return {window: float(np.mean(seconds)) for window, seconds in every.items()}


def _names_of(windows: set[Window]) -> str:
    names = sorted(stem if w is None else f"{stem}, window {w}" for stem, w in windows)
    return listed(names, 2)
