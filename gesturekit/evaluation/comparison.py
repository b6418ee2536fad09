"""`evaluate`: measure folders of generated motion against recordings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
from gesturekit.evaluation.measuring.alike import (
    joints_to_leave_out,
    keep_common_recordings,
    mark_unlike,
)
from gesturekit.evaluation.measuring.baselines import baseline_pairs
from gesturekit.evaluation.measuring.clip_metrics import ClipMetrics, ReferenceStatistics
from gesturekit.evaluation.measuring.clips import LENGTH_TOLERANCE, forget_files, read_motion
from gesturekit.evaluation.measuring.measurer import (
    FRECHET_PART,
    MISMATCHED,
    POOLED_PART,
    Measured,
    Measurer,
    Progress,
    measure_all,
)
from gesturekit.evaluation.metrics.inputs import RULE
from gesturekit.evaluation.pairs import (
    WINDOW_SECONDS,
    Excluded,
    Items,
    Pair,
    Pairs,
    find_pairs,
    recordings,
)
from gesturekit.evaluation.results import ClipResult, Evaluation, Interval, ModelResult
from gesturekit.evaluation.statistics.intervals import interval_over_samples
from gesturekit.evaluation.statistics.model_metrics import metric_results
from gesturekit.evaluation.statistics.questions import answer_questions
from gesturekit.field_docs import build_options
from gesturekit.motion import Motion
from gesturekit.wording import listed

if TYPE_CHECKING:
    from gesturekit.evaluation.metrics.frechet.feature_model import Extractor

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
        EvaluationError: an unknown protocol.
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
        if self.protocol not in PROTOCOLS:
            known = ", ".join(filter(None, PROTOCOLS))
            raise EvaluationError(f"protocol {self.protocol!r}; expected one of {known}")
        if self.seed < 0:
            raise EvaluationError(f"seed is {self.seed}: give a whole number from 0")

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
    reference, split = _recordings(reference, chosen)
    takes = _takes(reference, chosen)
    pairs = _pairs(folders, reference, chosen, takes)
    fps = _frame_rate(next(iter(pairs.values())))
    pairs |= baseline_pairs(chosen.baselines, pairs, reference, fps)
    measurer, statistics = _measurer(pairs, reference, fps, takes, chosen)
    measured = measure_all(measurer, chosen.workers, chosen.progress)
    models = [ModelResult(label, folders.get(label, Path(label))) for label in pairs]
    for model in models:
        _fill(model, pairs[model.label], measured[model.label], measurer, chosen)
    _judge(models, reference, chosen.protocol)
    first = measured[models[0].label].sets[POOLED_PART]
    models[0].excluded += [*statistics.excluded, *first.training_excluded]
    return Evaluation(
        models=models,
        reference=reference.path if isinstance(reference, Items) else reference,
        fps=fps,
        protocol=chosen.protocol,
        settings=chosen.to_json(split),
        recorded_speeds=first.recorded_speeds,
        recorded_wrists=first.recorded_wrists,
    )


def _judge(models: Sequence[ModelResult], reference: Path | Items, protocol: str) -> None:
    """Answer the three questions, and add notes on models and recordings that flatter them."""
    if POOLED in PROTOCOLS[protocol]:
        answer_questions(models)
    mark_unlike(models)
    if isinstance(reference, Items) and reference.split:
        beside = neighbours((*reference.items, *reference.others), reference.split)
        models[0].notes += [beside] if beside else []


def _takes(reference: Path | Items, options: EvaluationOptions) -> dict[str, str]:
    """Return {recording: take} of those that the options give a take."""
    names = list(recordings(reference, all_splits=True))
    return takes_of(names, options.take_pattern, options.take_table)


def _about_takes(pairs: Sequence[Pair], takes: Mapping[str, str]) -> list[str]:
    """Return what is to be said on the takes of the recordings of clips."""
    if takes:
        return merged_speakers((pair.stem, pair.speaker, pair.take) for pair in pairs)
    own = {pair.stem: pair.reference for pair in pairs if pair.take == pair.stem}
    return pieces_of_takes({name: partial(read_motion, source) for name, source in own.items()})


def _pairs(
    folders: Mapping[str, Path],
    reference: Path | Items,
    options: EvaluationOptions,
    takes: Mapping[str, str],
) -> dict[str, Pairs]:
    """Return {label: clips of the recordings that all models have}."""
    audio, semantic = (p if p is None else Path(p) for p in (options.audio, options.semantic))
    found = {
        label: find_pairs(folder, reference, audio=audio, semantic=semantic)
        for label, folder in folders.items()
    }
    keep_common_recordings(found)
    for pairs in found.values():
        pairs.pairs = [
            replace(pair, take=takes.get(pair.stem) or pair.take) for pair in pairs.pairs
        ]
    first = next(iter(found.values()))
    first.notes += _about_takes(first.pairs, takes)
    return found


def _measurer(
    pairs: Mapping[str, Pairs],
    reference: Path | Items,
    fps: float,
    takes: Mapping[str, str],
    options: EvaluationOptions,
) -> tuple[Measurer, ReferenceStatistics]:
    """Return all that is to be measured, and the statistics of the recordings."""
    # In Table 4 of Alexanderson et al. 2023 sets are compared with the full dataset: all splits.
    compared = recordings(reference, all_splits=options.protocol == "lda")
    statistics = ReferenceStatistics.of(compared, fps)
    measurer = Measurer(
        measure=ClipMetrics(statistics, options.groups, options.variants, options.cheap),
        pairs={label: some.pairs for label, some in pairs.items()},
        recordings={key: compared[key] for key in statistics.recordings},
        reference=reference,
        fps=fps,
        length=MULTIRES_LENGTH if options.protocol == "multires" else 1.0,
        features=options.features,
        seed=options.seed,
        without=joints_to_leave_out(pairs, fps),
        takes=takes,
    )
    return measurer, statistics


def _recordings(
    reference: str | Path | Items, options: EvaluationOptions
) -> tuple[Path | Items, str | None]:
    """Return the recordings of a path, of a manifest as `Items`, and their split.

    Raises:
        CorpusError: the manifest cannot be read, or has no item of the split.
        EvaluationError: a split is given without a manifest, or sound beside one.
    """
    if not isinstance(reference, Items) and Path(reference).suffix.lower() == ".jsonl":
        reference = Items.of_manifest(Path(reference), options.split or "test")
    elif options.split is not None:
        raise EvaluationError(
            f"split={options.split!r} chooses items of a manifest (.jsonl): {reference}"
        )
    if not isinstance(reference, Items):
        return Path(reference), None
    if reference.split and options.audio is not None:
        raise EvaluationError(f"{reference.path} already gives the sound: leave audio out")
    return reference, reference.split or None


def _frame_rate(pairs: Pairs) -> float:
    """Return the frame rate of the first generated clip that can be read."""
    reasons = []
    for pair in pairs.pairs:
        try:
            if isinstance(pair.generated, Path):
                return Motion.load(pair.generated).fps
        except GestureKitError as error:
            reasons.append(str(error))
    raise EvaluationError(f"no generated clip can be read: {reasons[0]}")


def _fill(
    result: ModelResult,
    pairs: Pairs,
    measured: Measured,
    measurer: Measurer,
    options: EvaluationOptions,
) -> None:
    """Fill in the results of a model, from the measurements of its clips and of their set.

    Raises:
        EvaluationError: no clip could be measured.
    """
    result.excluded, result.notes = list(pairs.excluded), list(pairs.notes)
    problems: dict[tuple[str, str], list[str]] = {}
    for clip in measured.clips:
        if isinstance(clip, Excluded):
            result.excluded.append(clip)
            continue
        for key, reason in clip.problems:
            problems.setdefault((key, reason), []).append(clip.pair.name)
        result.clips.append(clip)
    if not result.clips:
        reasons = "; ".join(item.reason for item in result.excluded[:3])
        raise EvaluationError(f"{result.path}: no clip could be measured: {reasons}")
    likeness = measurer.likeness(result.label, result.clips)
    whole, frechet = (measured.sets[part] for part in (POOLED_PART, FRECHET_PART))
    for clip, values in zip(result.clips, whole.by_clip):
        clip.metrics |= values
    of_set = whole.metrics | frechet.metrics
    result.metrics = metric_results(result.clips, of_set, measurer.ceilings, likeness)
    if PATCHES in options.groups:
        result.by_recording = _by_recording(result.clips)
    result.speeds, result.wrists = whole.speeds, whole.wrists
    result.notes += _protocol_notes(result, options.protocol)
    for key, reason in (*frechet.problems, *whole.problems):
        problems.setdefault((key, reason), []).append("the whole set")
    for (key, reason), names in problems.items():
        title = DEFINITIONS[key].name if key in DEFINITIONS else key
        result.excluded.append(Excluded(listed(names, 3), reason, title))


def _by_recording(clips: Sequence[ClipResult]) -> dict[str, dict[str, Interval]]:
    """Average the patch metrics over the samples of each recording (eq. 18)."""
    samples: dict[str, list[Mapping[str, float]]] = {}
    for clip in clips:
        samples.setdefault(clip.pair.stem, []).append(clip.metrics)
    patches = [definition for definition in DEFINITIONS.values() if definition.group == PATCHES]
    return {
        stem: {
            d.key: interval_over_samples([m[d.key] for m in metrics if d.key in m], d.within)
            for d in patches
            if any(d.key in m for m in metrics)
        }
        for stem, metrics in sorted(samples.items())
    }


def _protocol_notes(result: ModelResult, protocol: str) -> list[str]:
    """Return notes on clips that differ from the protocol in number or length."""
    counts = Counter(clip.pair.of for clip in result.clips)
    wanted = {"multires": MULTIRES_SAMPLES, "lda": LDA_SAMPLES}.get(protocol)
    other = [f"{stem}: {n}" for (stem, _), n in counts.items() if n != wanted]
    notes = []
    if wanted and other:
        what = "window" if protocol == "lda" else "recording"
        notes.append(f"the protocol takes {wanted} samples of each {what}; {listed(other, 3)}")
    if protocol == "lda":
        odd = [c for c in result.clips if abs(c.seconds - WINDOW_SECONDS) > LENGTH_TOLERANCE]
        if odd:
            notes.append(
                f"the protocol takes clips of {WINDOW_SECONDS:g} s; {len(odd)} of "
                f"{len(result.clips)} are of another length and are cut into such clips for "
                "Fréchet distances"
            )
    return notes
