"""Values, levels and rows of tables in words: common to the page, the terminal and files."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from gesturekit.evaluation.definitions import GROUPS, Definition
from gesturekit.evaluation.results import Evaluation, Interval, Level, MetricResult, ModelResult
from gesturekit.evaluation.statistics.intervals import Takes
from gesturekit.evaluation.statistics.levels import level_name
from gesturekit.evaluation.statistics.paired import Contest, contests

ARROWS = {
    "higher": ("↑", "higher is nearer to the recordings' own value"),
    "lower": ("↓", "lower is nearer to the recordings' own value"),
    "reference": ("", "the recordings' own value is the goal"),
}
"""Sign and meaning of the better direction."""


def number(value: float) -> str:
    """Format a value with about three significant digits."""
    size = abs(value)
    if size < 1e-6:
        return "0"
    if size >= 1000:
        return f"{value:,.0f}".replace(",", "\u202f")
    if size >= 100:
        return f"{value:.0f}"
    if size >= 10:
        return f"{value:.1f}"
    return f"{value:.2f}" if size >= 0.1 else f"{value:.2g}"


def bounds(interval: Interval | None, form: str = "{} … {}") -> str:
    """Return the bounds of an interval as text; "" without an interval."""
    if interval is None or interval.low is None or interval.high is None:
        return ""
    return form.format(number(interval.low), number(interval.high))


def spread_in_words(interval: Interval) -> str:
    """Return an interval in words, such as "95 % interval 0.4 to 0.6"."""
    return bounds(interval, "95 % interval {} to {}") or "no interval"


def value_text(result: MetricResult | None) -> str:
    """Return a value with its interval, such as "0.50 [0.40, 0.60]"."""
    if result is None:
        return "–"
    if not result.informative:
        return f"{number(result.interval.value)} (not informative)"
    return number(result.interval.value) + bounds(result.interval, " [{}, {}]")


def level_in_words(level: Level) -> str:
    """Return a level in words, such as "another speaker 0.41 ± 0.06 (4 takes)"."""
    spread = "" if level.spread is None else f" ± {number(level.spread)}"
    unit = "piece" if level.pieces else "take"
    count = f" ({level.n} {unit}{'s' if level.n > 1 else ''})" if level.n else ""
    return f"{level_name(level)} {number(level.value)}{spread}{count}"


@dataclass(frozen=True)
class Row:
    """A metric with the results of all models.

    Attributes:
        definition: of the metric.
        results: results of each model; None where it was not measured.
        contest: order of the models; None without a value of the recordings.
        best: index of the model whose value is bold, or None.
    """

    definition: Definition
    results: tuple[MetricResult | None, ...]
    contest: Contest | None = None
    best: int | None = None

    @property
    def known(self) -> list[MetricResult]:
        """The results of the models that have any."""
        return [result for result in self.results if result is not None]

    @property
    def direction(self) -> tuple[str, str]:
        """Sign and meaning of the better direction; no sign where a model is beyond that value."""
        return ARROWS[self.definition.better if self.contest is None else self.contest.direction]

    @property
    def recorded(self) -> MetricResult | None:
        """The first result that has the recordings' own value."""
        return next((result for result in self.known if result.recording is not None), None)

    @property
    def shared_remarks(self) -> list[str]:
        """The remarks that hold for every model; they stand once, at the name of the metric."""
        first, *others = map(remarks, self.known)
        return [remark for remark in first if all(remark in other for other in others)]

    def cells(self, best: Callable[[str], str], escaped: Callable[[str], str] = str) -> list[str]:
        """Return name, direction, the models' values, that of the recordings, and chance as text.

        Args:
            best: marks the value that is bold.
            escaped: changes each text before.
        """
        chance = [v for f in self.known[:1] for v in (f.chance, f.mismatched) if v is not None]
        recorded = [f.recording for f in self.known if f.recording is not None]
        values = [escaped(value_text(result)) for result in self.results]
        if self.best is not None:
            values[self.best] = best(values[self.best])
        arrow = "" if self.contest is None else self.direction[0]
        own = number(recorded[0]) if recorded else ""
        others = (own, number(max(chance)) if chance else "")
        return [self.definition.title, escaped(arrow), *values, *map(escaped, others)]


def remarks(result: MetricResult) -> list[str]:
    """Return what is to be known about a value: how informative it is, its basis, and its note."""
    informative = "" if result.informative else "not informative here"
    bare = "no interval" if result.interval.low is None else ""
    return list(filter(None, (informative, bare, result.interval.count, result.note)))


def rows_by_group(evaluation: Evaluation) -> dict[str, list[Row]]:
    """Return {group of metrics: its rows} of the groups that have any."""
    decided = contests(evaluation.models)
    labels = [model.label for model in evaluation.models]
    groups: dict[str, list[Row]] = {group: [] for group in GROUPS}
    for definition in evaluation.definitions():
        contest = decided.get(definition.key)
        best = None if contest is None or contest.best is None else labels.index(contest.best)
        results = tuple(model.metrics.get(definition.key) for model in evaluation.models)
        groups[definition.group].append(Row(definition, results, contest, best))
    return {group: rows for group, rows in groups.items() if rows}


def interval_warnings(evaluation: Evaluation) -> Iterator[str]:
    """Yield warnings about intervals that are missing, with the data that would give them."""

    def warning(model: ModelResult) -> str:
        takes = Takes.of([clip.pair for clip in model.clips])
        if takes.count >= takes.needed:
            return ""
        return (
            f"the clips come from {takes.in_words}: no intervals and no tests. "
            "Differences between takes (recording sessions) cannot be estimated from fewer than "
            f"{takes.needed}; more clips or samples (seeds) of the same takes do not change that. "
            f"Hold out {takes.needed} or more takes"
        )

    said = by_text((text, model.label) for model in evaluation.models if (text := warning(model)))
    for text, labels in said.items():
        yield text if len(said) == 1 else f"{', '.join(labels)}: {text}"


def by_text(pairs: Iterator[tuple[str, str]]) -> dict[str, list[str]]:
    """Return {text: labels of the models that it is said of}, in order."""
    said: dict[str, list[str]] = {}
    for text, label in pairs:
        said.setdefault(text, []).append(label)
    return said
