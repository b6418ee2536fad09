"""Report of a user study: one HTML file, and all figures as JSON."""

from __future__ import annotations

import html
import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from audio_features.atomic import write_text
from gesturekit.study.analysis.alignment import Alignment
from gesturekit.study.analysis.plots import all_plots
from gesturekit.study.analysis.preference import Preference
from gesturekit.study.analysis.result import (
    StudyResult,
    conclusions,
    is_significant,
    p_text,
    reservations,
)
from gesturekit.study.analysis.significance import Estimate
from gesturekit.viewer.pages import plots_section, section, table, write_page

_HERE = Path(__file__).parent / "page"
_SCORES = ("Clear", "Slight", "Equal", "Slight", "Clear")
_METHOD = """<ul>
<li>Merit score (Parizet et al. 2005): 2 for a clear preference, 1 for a slight one, 0 for a tie or
a preference for the other system; mean over all answers in which the system was shown.</li>
<li>p of a pair: test of the mean score (2, 1, 0, -1, -2) against 0 over raters and clips, with the
variance of Cameron, Gelbach and Miller (2011), adjusted by Holm's method for the number of
pairs.</li>
<li>ANOVA and Tukey's test, as in the diffusion paper, take every answer as independent. Answers of
one rater are not, nor are those on one clip: equal systems then differ far too often. Report them
beside p, not in its place.</li>
<li>Bradley-Terry model by logistic regression on weighted wins: clear 4, slight 2, a tie 1 to each
side. Elo = 400 &middot; strength / ln 10 + 1000.</li>
<li>Ratings (sliders of several systems at once, HEMVIP, Jonell et al. 2021): any two systems that a
rater rated for a clip are compared. Means have intervals over raters and clips by the same
variance; p tests the mean difference; for Elo, the higher rating is a slight preference.</li>
<li>Alignment: clear preferences weigh 2, ties half; chance is 50 %. Two systems are compared by the
test of their mean scores over raters and clips.</li>
<li>Intervals of merit, Elo and alignment: bootstrap over raters and clips (Owen 2007), 95 %,
{rounds} rounds, seed {seed}. Intervals of win rates, ties excluded: Wilson's, with the number of
independent answers that the variance over raters and clips amounts to.</li>
</ul>"""


def write_study_report(
    found: StudyResult, path: str | os.PathLike[str], *, title: str = "User study"
) -> None:
    """Write the report of a study.

    Args:
        found: the result of `analyse_study`.
        path: the .html file to write.
        title: its heading.
    """
    sections = [
        section("What may be concluded", "", _list(conclusions(found)) + _notes(found)),
        *(_preference_sections(found.preference, "") if found.preference else ()),
        *(s for name, one in found.by_style.items() for s in _preference_sections(one, name)),
        *([_alignment_section(found.alignment)] if found.alignment else ()),
        plots_section(all_plots(found)),
        _listing("Reasons given", ("Reason", "Answers"), found.reasons),
        _listing("Comments", ("Rater", "Comment"), found.answers.comments),
        _listing("Excluded raters", ("Rater", "Reason"), found.answers.excluded),
        section("Method", "", _METHOD.format(rounds=f"{found.rounds:,}", seed=found.seed)),
    ]
    values = {
        "title": html.escape(title),
        "sections": "\n".join(filter(None, sections)),
    }
    write_page(path, _HERE, values)


def write_json(found: StudyResult, path: str | os.PathLike[str]) -> None:
    """Write all figures of a study as JSON; undefined ones are null."""
    values = {
        "format": 1,
        "answers": len(found.answers.kept),
        "raters": found.raters,
        "clips": found.clips,
        "excluded": found.answers.excluded,
        "conclusions": conclusions(found),
        "reservations": reservations(found),
        "left": asdict(found.left),
        "preference": _figures(found.preference),
        "by_style": {name: _figures(one) for name, one in found.by_style.items()},
        "alignment": asdict(found.alignment) if found.alignment else None,
        "reasons": found.reasons,
        "comments": found.answers.comments,
        "rounds": found.rounds,
        "seed": found.seed,
    }
    text = json.dumps(_plain(values), indent=1, ensure_ascii=False, allow_nan=False)
    write_text(path, text + "\n")


def _figures(preference: Preference | None) -> dict[str, Any] | None:
    if preference is None:
        return None
    anova = preference.anova
    df = anova and [anova.between, anova.within]
    return {
        "systems": [asdict(system) for system in preference.systems],
        "pairs": [asdict(pair) for pair in preference.pairs],
        "not_compared": preference.not_compared,
        "anova": anova and {"f": anova.f, "p": anova.p, "df": df},
    }


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _list(lines: Iterable[str]) -> str:
    return f"<ul>{''.join(f'<li>{html.escape(line)}</li>' for line in lines)}</ul>"


def _notes(found: StudyResult) -> str:
    return "".join(f'<p class="note">{html.escape(line)}</p>' for line in reservations(found))


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table; the head and first cells are escaped, other cells are HTML."""
    heads = "".join(f"<th>{html.escape(name)}</th>" for name in head)
    body = "".join(
        f"<tr><th>{html.escape(name)}</th>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>"
        for name, *cells in rows
    )
    return table(heads, body)


def _estimate(found: Estimate, digits: int, factor: float = 1.0) -> str:
    if math.isnan(found.value):
        return "–"
    value = f"{factor * found.value:.{digits}f}"
    if math.isnan(found.low):
        return value
    low, high = (f"{factor * bound:.{digits}f}" for bound in (found.low, found.high))
    return f"{value} <small>[{low}, {high}]</small>"


def _p(p: float) -> str:
    text = html.escape(p_text(p))
    return f'<span class="yes">{text}</span>' if is_significant(p) else text


def _preference_sections(preference: Preference, style: str) -> list[str]:
    systems = _table(
        ("System", "Ratings", "Mean rating", "Elo")
        if preference.rated
        else ("System", "Answers", "Merit score", "Elo"),
        (
            (s.name, str(s.n), _estimate(s.merit, 2), _estimate(s.elo, 0))
            for s in preference.systems
        ),
    )
    anova, lead = preference.anova, ""
    if anova:
        lead = f"F({anova.between}, {anova.within}) = {anova.f:.2f}, {html.escape(p_text(anova.p))}"
        lead = f"One-way ANOVA of merit scores: {lead}."
    rows = [
        [f"{p.a} : {p.b}", *map(str, p.counts), _estimate(p.win_rate, 0, 100.0), f"{p.mean:+.2f}"]
        + [_p(p.p_holm)] + [_p(p.p_tukey)] * bool(anova)
        for p in preference.pairs
    ]  # fmt: skip
    head = ["Pair", *_SCORES, "Win rate, %", "Mean difference", "p (Holm)"]
    head += ["p (Tukey)"] * bool(anova)
    if preference.rated:  # no preference of a rating is clear or slight
        head[1:6] = ["Higher", "Equal", "Lower"]
        for row in rows:
            row[1:6] = row[2:5]
    pairs = _table(head, rows)
    what = "Answers for the first and for the second system; the win rate is the first one's."
    titles = (f"{style}: systems", f"{style}: pairs") if style else ("Systems", "Pairs")
    return [section(titles[0], lead, systems), section(titles[1], what, pairs)]


def _alignment_section(alignment: Alignment) -> str:
    systems = _table(
        ("System", *_SCORES, "Alignment, %", "Win rate, %", "p"),
        (
            (s.name, *map(str, s.counts), _estimate(s.score, 1, 100.0))
            + (_estimate(s.win_rate, 0, 100.0), _p(s.p_holm))
            for s in alignment.systems
        ),
    )
    pairs = _table(
        ("Difference between", "p", "p (Holm)"),
        ((f"{a} : {b}", html.escape(p_text(p)), _p(q)) for a, b, p, q in alignment.differences),
    )
    lead = "Matched against mismatched motion of the same system; chance is 50 %."
    body = systems + (pairs if alignment.differences else "")
    return section("Alignment with speech", lead, body)


def _listing(title: str, head: tuple[str, str], rows: Mapping[str, object]) -> str:
    """Return the section of a table of two columns; "" without rows."""
    cells = [(name, html.escape(str(value))) for name, value in rows.items()]
    return section(title, "", _table(head, cells)) if cells else ""
