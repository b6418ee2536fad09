"""Results of an evaluation, and their JSON form."""

from __future__ import annotations

import functools
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, is_dataclass
from pathlib import Path
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np

from audio_features.archive import read_bytes
from audio_features.atomic import write_text
from audio_features.kinds import installed_versions
from gesturekit.errors import EvaluationError
from gesturekit.evaluation.definitions import DEFINITIONS, Definition, Variants
from gesturekit.evaluation.metrics.physical import SpeedHistogram
from gesturekit.evaluation.pairs import Excluded, Pair
from gesturekit.wording import counted

FORMAT = 1
NOT_ASKED = "not asked"
"""State of the answers for a broken motion: its scores say nothing."""
_MOST_BYTES = 256 << 20
OTHER_SPEAKER = "another speaker"
"""Name of the level that motion of other speakers gives."""


@dataclass(frozen=True)
class Interval:
    """A mean and its confidence interval.

    Attributes:
        value: the mean over units.
        low, high: 95 % interval; None with too few takes.
        n: number of clips (windows, for Fréchet distances).
        units: number of units.
        over: kind of unit: "takes" (the mean of a take's clips), or "samples" of one recording.
        speakers: number of speakers of the takes.
    """

    value: float
    low: float | None
    high: float | None
    n: int
    units: int
    over: str
    speakers: int = 1

    @property
    def method(self) -> str:
        """Method of the value and its interval in words, for papers and files of results."""
        if self.over != "takes":
            return "mean over samples" if self.over == "samples" else "one value of the whole set"
        if self.low is None:
            return "mean over takes, without an interval"
        return "mean over takes, with a 95 % interval by Student's t over takes, within speakers"

    @property
    def count(self) -> str:
        """Numbers of takes, speakers and clips, such as "10 takes of 2 speakers, 50 clips"."""
        clips = counted(self.n, "clip")
        if self.over != "takes":
            return clips if self.over == "samples" else f"n = {self.n}"
        return f"{takes_of_speakers(self.units, self.speakers)}, {clips}"


def takes_of_speakers(takes: int, speakers: int) -> str:
    """Return numbers in words, such as "10 takes of 2 speakers"; a single speaker is not named."""
    return counted(takes, "take") + (f" of {counted(speakers, 'speaker')}" if speakers > 1 else "")


@dataclass(frozen=True)
class Level:
    """A floor or the ceiling of a score: the same score of other motion.

    Attributes:
        name: the motion, such as "another speaker".
        value: mean over takes.
        spread: standard deviation over takes, of a ceiling of likeness over sets of takes; None
            with a single one.
        n: number of takes; 0 for a value by definition.
        pieces: True where pieces of one take stand for takes, which flatters a ceiling.
    """

    name: str
    value: float
    spread: float | None = None
    n: int = 1
    pieces: bool = False


@dataclass(frozen=True)
class GroupLikeness:
    """Likeness of a motion to one speaker, or one style of a speaker; see `statistics.likeness`.

    Attributes:
        name: the group, of `statistics.intervals.groups_of`.
        takes: names of the takes that a model has clips of; empty for other motion.
        value: likeness, 0 to 1: the model's score over the speaker's own.
        own: the speaker's own score, 0 to 1.
        aspects: {aspect: credit over the speaker's own, at most 1}.
        without: {take: likeness without it}; empty with a single take.
        without_reference: likeness without each of the takes that these are compared with.
        pieces: True where clips, or pieces of one, stand for takes.
    """

    name: str
    takes: tuple[str, ...]
    value: float
    own: float
    aspects: Mapping[str, float]
    without: Mapping[str, float] = field(default_factory=dict)
    without_reference: tuple[float, ...] = ()
    pieces: bool = False


@dataclass
class ClipResult:
    """Metrics of one clip and of its recording.

    Attributes:
        pair: names and files.
        seconds: length of the clip.
        metrics: {key of `definitions`: value}, and KEY_chance and KEY_z of speech metrics.
        recording: the same for the recording.
        mismatched: the clip's values with other recordings' sounds (CCA: with another recording).
        notes: for the reader of the report.
        problems: (key, reason) of metrics that could not be computed.
    """

    pair: Pair
    seconds: float
    metrics: dict[str, float]
    recording: dict[str, float]
    mismatched: dict[str, float]
    notes: Sequence[str] = ()
    problems: Sequence[tuple[str, str]] = ()

    def to_json(self) -> dict[str, Any]:
        """Return all of it but its files as plain values."""
        return {
            "name": self.pair.name,
            "recording": self.pair.stem,
            "window": self.pair.window,
            "seconds": round(self.seconds, 4),
            "figures": self.metrics,
            "recording_figures": self.recording,
            "mismatched": self.mismatched,
            "notes": list(self.notes),
        }


@dataclass(frozen=True)
class MetricResult:
    """One metric of one model.

    Attributes:
        key: key of `definitions`.
        interval: the model's mean, with its interval.
        recording: the recordings' own value, or None.
        recording_interval: the same with its interval; None where it has none.
        chance: mean chance level over circular shifts of the sound, or None.
        mismatched: mean over other recordings' sounds or motion, or None.
        note: "" or a remark on how to read the value.
        informative: False where the recordings' own value is at its chance level, or they are too
            short, or no higher than a floor, so that the metric is not informative for these
            recordings.
        ceiling: value of the speaker's other takes; of the three questions only.
        floors: values of motion that should fail; of the three questions only.
        groups: likeness by speaker and style; of likeness only.
    """

    key: str
    interval: Interval
    recording: float | None = None
    chance: float | None = None
    mismatched: float | None = None
    note: str = ""
    recording_interval: Interval | None = None
    informative: bool = True
    ceiling: Level | None = None
    floors: tuple[Level, ...] = ()
    groups: tuple[GroupLikeness, ...] = ()

    @property
    def tested_against_speaker(self) -> bool:
        """True if motion of another speaker is among the floors."""
        return any(level.name == OTHER_SPEAKER for level in self.floors)

    @property
    def levels(self) -> list[Level]:
        """Floors and ceiling."""
        return [*self.floors, *([self.ceiling] if self.ceiling else [])]

    def to_json(self) -> dict[str, Any]:
        """Return all of it as plain values, without nesting the intervals."""
        values = asdict(self)
        del values["key"]
        own = values.pop("recording_interval") or {}
        over_takes = self.interval.over == "takes"
        return {
            **values.pop("interval"),
            **values,
            "unit": DEFINITIONS[self.key].unit,
            "takes": self.interval.units if over_takes else None,
            "method": self.interval.method,
            "recording_low": own.get("low"),
            "recording_high": own.get("high"),
        }


_hints: Callable[[Any], dict[str, Any]] = functools.cache(get_type_hints)


def restored(kind: Any, values: Any) -> Any:
    """Return a value of a type from the plain values that `dataclasses.asdict` and JSON made of it.

    Args:
        kind: a record, or a type of records, lists, mappings, arrays and plain values.
        values: plain values; None stays None.
    """
    kinds = get_args(kind)
    if values is None or kind is Any:
        return values
    if isinstance(kind, UnionType):
        return restored(kinds[0], values)
    if isinstance(kind, type) and is_dataclass(kind):
        return kind(**{name: restored(_hints(kind)[name], v) for name, v in values.items()})
    if kind is np.ndarray:
        return np.array(values)
    if isinstance(values, dict):
        return {key: restored(kinds[1], value) for key, value in values.items()}
    if isinstance(values, list) and get_origin(kind) is tuple:
        kinds = kinds if kinds[-1] is not Ellipsis else [kinds[0]] * len(values)
        return tuple(map(restored, kinds, values))
    return [restored(kinds[0], v) for v in values] if isinstance(values, list) else values


@dataclass(frozen=True)
class MetricAgreement:
    """Agreement of one metric with people's scores of systems for one question.

    Attributes:
        key: key of `definitions`.
        kendall: Kendall's tau-b over systems; 1 is the order of people.
        of_models: the same without the recordings, which lead people's order and that of most
            metrics; None with fewer than 3 models.
        p_holm: p-value of `of_models`, by Holm's method over the informative metrics of the
            question; None for others.
        informative: False where the metric is not informative for some model.
        low, high: 95 % interval of Kendall's tau over systems, raters and clips; None with fewer
            than 6 systems.
        spearman: Spearman's rho.
        accuracy: share of the pairs of systems whose scores differ significantly that the metric
            orders as people do; ties count half. 0.5 by chance; None without such a pair.
        pairs: number of these pairs.
        n: number of systems.
        chance: 95 % of random orders have a tau between -chance and chance.
    """

    key: str
    kendall: float
    of_models: float | None
    p_holm: float | None
    low: float | None
    high: float | None
    spearman: float
    accuracy: float | None
    pairs: int
    n: int
    chance: float
    informative: bool = True


@dataclass(frozen=True)
class QuestionAgreement:
    """Agreement of all metrics with people for one question of a study.

    Attributes:
        question: its name; "" in studies of one question.
        scores: {system: people's score}: the mean rating less those of raters and clips, or the
            share of comparisons won.
        raters, clips, ratings: their numbers.
        metrics: the closest first.
    """

    question: str
    scores: dict[str, float]
    raters: int
    clips: int
    ratings: int
    metrics: tuple[MetricAgreement, ...]


@dataclass(frozen=True)
class Agreement:
    """Agreement of metrics with people in a study, and notes on what was left out."""

    questions: tuple[QuestionAgreement, ...]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class QuestionAnswer:
    """The answer to one of the three questions that head a report.

    Attributes:
        question: such as "In time with the speech?".
        key: key of `definitions` of its metric.
        state: "yes", "partly", "no", "cannot be answered", "not measured" or "not asked".
        sentence: the answer in words.
    """

    question: str
    key: str
    state: str
    sentence: str


@dataclass
class ModelResult:
    """Metrics of one folder of generated motion.

    Attributes:
        label: name of the model.
        path: its folder.
        verdict: the result in words, one line; "" where nothing is known that it could say.
        answers: answers to the three questions that head the report.
        metrics: {key of `definitions`: result}.
        by_recording: {recording: {key: interval over its samples}} of the patch metrics.
        clips: results of each clip.
        excluded: clips and metrics left out, and why.
        notes: for the reader of the report.
        marks: words on what sets the model apart from the others, such as "retargeted".
        speeds: histogram of joint speeds.
        wrists: (N,) wrist speeds, m/s; a sample of at most some thousands.
    """

    label: str
    path: Path
    verdict: str = ""
    answers: list[QuestionAnswer] = field(default_factory=list)
    metrics: dict[str, MetricResult] = field(default_factory=dict)
    by_recording: dict[str, dict[str, Interval]] = field(default_factory=dict)
    clips: list[ClipResult] = field(default_factory=list)
    excluded: list[Excluded] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    marks: list[str] = field(default_factory=list)
    speeds: SpeedHistogram = field(default_factory=SpeedHistogram)
    wrists: np.ndarray = field(default_factory=lambda: np.empty(0))

    @property
    def heading(self) -> str:
        """The label with the marks, for the head of a table."""
        return f"{self.label} ({', '.join(self.marks)})" if self.marks else self.label


def library_versions() -> dict[str, str]:
    """Return {library: version} of the libraries that the metrics depend on."""
    names = ("gesturekit", "numpy", "scipy", "scikit-learn", "librosa")
    return dict.fromkeys(names, "not installed as a package") | installed_versions(names)


@dataclass
class Evaluation:
    """The result of `evaluate`.

    Attributes:
        models: the evaluated model, then those it is compared with.
        reference: the folder of recordings, or the manifest.
        fps: frame rate of all metrics.
        protocol: "", "multires" or "lda".
        settings: seeds and options, as plain values.
        recorded_speeds: histogram of joint speeds of the recordings.
        recorded_wrists: (N,) wrist speeds of the recordings, m/s; a sample of some thousands.
        agreement: agreement of the metrics with the ratings of a user study; None without one.
        versions: {library: version}.

    Examples:
        A recording against itself:

        >>> gk.load("demo").generate(seconds=3).save(folder / "recorded" / "a.bvh")
        >>> evaluation = gk.evaluate(folder / "recorded", folder / "recorded", protocol="multires")
        >>> evaluation.is_complete, evaluation.fps
        (True, 30.0)
        >>> evaluation.models[0].metrics["coverage"].interval.value
        100.0
    """

    models: list[ModelResult]
    reference: Path
    fps: float
    protocol: str
    settings: dict[str, Any]
    recorded_speeds: SpeedHistogram
    recorded_wrists: np.ndarray
    agreement: Agreement | None = None
    versions: dict[str, str] = field(default_factory=library_versions)

    @property
    def is_complete(self) -> bool:
        """True if no clip was left out."""
        return not any(item.what == "clip" for model in self.models for item in model.excluded)

    def verdicts(self) -> list[str]:
        """Return the verdict of each model that has one; several models are named."""
        named = len(self.models) > 1
        return [
            f"{m.heading}: {m.verdict}" if named else m.verdict for m in self.models if m.verdict
        ]

    @property
    def basis(self) -> str:
        """A sentence for papers: takes, speakers and clips that the values are computed over."""
        clips = self.models[0].clips
        takes = {(clip.pair.speaker, clip.pair.take) for clip in clips}
        over = takes_of_speakers(len(takes), len({speaker for speaker, _ in takes}))
        seconds = sum(clip.seconds for clip in clips)
        return (
            f"Computed over {over} ({counted(len(clips), 'clip')}, {seconds:.0f} s) at "
            f"{self.fps:g} fps."
        )

    def definitions(self) -> list[Definition]:
        """Return the definitions of all metrics that at least one model has."""
        keys = {key for model in self.models for key in model.metrics}
        variants = Variants(**self.settings["variants"])
        return [DEFINITIONS[key].at(self.fps, variants) for key in DEFINITIONS if key in keys]

    def to_json(self) -> dict[str, Any]:
        """Return plain values: format, versions, settings, definitions, and all metrics."""
        return {
            "format": FORMAT,
            "reference": str(self.reference),
            "fps": self.fps,
            "protocol": self.protocol,
            "basis": self.basis,
            "settings": self.settings,
            "versions": self.versions,
            "definitions": {d.key: d.to_json() for d in self.definitions()},
            "models": [_model(model) for model in self.models],
            "agreement": self.agreement and asdict(self.agreement),
        }

    def json_text(self) -> str:
        """Return `to_json` as text."""
        return json_text(self.to_json())

    def write_json(self, path: str | os.PathLike[str]) -> None:
        """Write `to_json` to a file."""
        write_text(path, self.json_text())


def json_text(values: Any) -> str:
    """Return plain values as JSON that people can read, with names as they are."""
    return json.dumps(values, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _model(model: ModelResult) -> dict[str, Any]:
    """Return the results of a model as plain values."""
    return {
        "label": model.label,
        "path": str(model.path),
        "verdict": model.verdict,
        "answers": [asdict(answer) for answer in model.answers],
        "figures": {key: result.to_json() for key, result in model.metrics.items()},
        "by_recording": {
            stem: {key: asdict(interval) for key, interval in metrics.items()}
            for stem, metrics in model.by_recording.items()
        },
        "clips": [clip.to_json() for clip in model.clips],
        "excluded": [asdict(item) for item in model.excluded],
        "notes": model.notes,
        "marks": model.marks,
    }


def read_results(path: Path) -> dict[str, Any]:
    """Return the values of a results file that `evaluate --json` wrote.

    Raises:
        EvaluationError: it cannot be read, is no such file, or is of a newer format.
    """
    content, problem = read_bytes(path, _MOST_BYTES, EvaluationError), ""
    try:
        values = json.loads(content)
        if isinstance(written := values["format"], int) and written > FORMAT:
            problem = f"format {written} is newer than this gesturekit's ({FORMAT}); update it"
        for model in values["models"]:
            _ = str(model["label"]), [float(f["value"]) for f in model["figures"].values()]
    except (ValueError, RecursionError, KeyError, TypeError, AttributeError) as error:
        problem = problem or f"not a file of evaluate --json ({error})"
    if problem:
        raise EvaluationError(f"{path}: {problem}")
    return values
