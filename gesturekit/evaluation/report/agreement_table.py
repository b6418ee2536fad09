"""Agreement of metrics with people as text, for the terminal and the report."""

from __future__ import annotations

from collections.abc import Iterator

from gesturekit.evaluation.definitions import DEFINITIONS
from gesturekit.evaluation.results import Evaluation, MetricAgreement, QuestionAgreement
from gesturekit.evaluation.statistics.agreement import conclusion
from gesturekit.wording import counted, printable


def agreement_lines(evaluation: Evaluation) -> list[str]:
    """Return the agreement with a study as lines; none without a study."""
    found = evaluation.agreement
    return [] if found is None else [line for one in found.questions for line in _agreement(one)]


def _agreement(found: QuestionAgreement) -> Iterator[str]:
    """Yield the table of one question of a study, after an empty line."""
    order = sorted(found.scores, key=lambda name: -found.scores[name])
    scores = ", ".join(f"{printable(name)} {found.scores[name]:+.3g}" for name in order)
    question = f" on {printable(found.question)}" if found.question else ""
    yield from (
        "",
        f"Agreement with people{question}: {counted(found.raters, 'rater')}, "
        f"{counted(found.clips, 'clip')}, {counted(found.ratings, 'rating')}.",
        f"People's scores: {scores}.",
    )
    if not found.metrics:
        yield "No metric can be compared: the values, or people's scores, are all equal."
        return
    for n, chance in sorted({(one.n, one.chance) for one in found.metrics}, reverse=True):
        yield (
            f"Chance, {n} systems: 95 % of random orders have a tau between {-chance:+.2f} and "
            f"{chance:+.2f}; pairwise accuracy 50 %."
            + ("" if chance < 1 else " These are too few systems: any order may be chance.")
        )
    yield conclusion(found)
    rows = [_agreement_row(one) for one in found.metrics]
    head = (
        "Metric",
        "Kendall's tau [95 %]",
        "without recordings",
        "p (Holm)",
        "Spearman's rho",
        "pairs in order",
        "systems",
    )
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    for row in (head, *rows):
        yield "  " + "  ".join(f"{cell:<{w}}" for cell, w in zip(row, widths, strict=True)).rstrip()


def _agreement_row(one: MetricAgreement) -> tuple[str, ...]:
    """Return the cells of one metric's agreement with people."""
    interval = "" if one.low is None else f" [{one.low:+.2f}, {one.high:+.2f}]"
    accuracy = "none differ" if one.accuracy is None else f"{one.accuracy:.0%} of {one.pairs}"
    tau = f"{one.kendall:+.2f}{interval}"
    return (
        DEFINITIONS[one.key].name,
        tau,
        "" if one.of_models is None else f"{one.of_models:+.2f}",
        "not informative" if not one.informative else _p(one.p_holm),
        f"{one.spearman:+.2f}",
        accuracy,
        str(one.n),
    )


def _p(p: float | None) -> str:
    return "" if p is None else f"{p:.3f}"
