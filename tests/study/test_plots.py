"""Plots of a study's report: marks at the places of their values."""

from __future__ import annotations

import numpy as np
import pytest
from figures import kept_figures

from gesturekit.evaluation.statistics.answers import Answer, Answers
from gesturekit.study import analyse_study
from gesturekit.study.analysis import plots


@pytest.fixture
def drawn(monkeypatch):
    """drawn(answers): {title: axes}, and the result of the study."""
    figures = kept_figures(monkeypatch, plots)

    def draw(answers: list[Answer]):
        figures.clear()
        found = analyse_study(Answers(tuple(answers)), rounds=50)
        made = plots.all_plots(found)
        assert all("<svg" in svg for svg in made.values()) and len(made) == len(figures)
        return {title: figure.axes[0] for title, figure in zip(made, figures)}, found

    return draw


def names(axes) -> list[str]:
    return [text.get_text() for text in axes.get_yticklabels()]


def check_points(axes, estimates, middle: float | None, factor: float = 1.0) -> None:
    """Each row has the line of its interval and the dot of its value; `middle` is dashed."""
    lines = axes.lines[: 2 * len(estimates)]
    for row, (found, line, dot) in enumerate(zip(estimates, lines[::2], lines[1::2], strict=True)):
        assert line.get_xdata() == pytest.approx([factor * found.low, factor * found.high])
        assert dot.get_xdata() == pytest.approx([factor * found.value])
        assert list(line.get_ydata()) == [row, row] and list(dot.get_ydata()) == [row]
        assert dot.get_marker() == "o"
        assert 3 < dot.get_markersize() / line.get_linewidth() < 5, "the value stands out"
    (*_, last) = axes.lines
    assert len(axes.lines) == 2 * len(estimates) + (middle is not None)
    if middle is not None:
        assert list(last.get_xdata()) == [middle, middle] and last.get_linestyle() == "--"
        assert last.get_linewidth() <= lines[0].get_linewidth() / 2
    assert [line.get_visible() for line in axes.get_xgridlines()[:1]] == [True]
    assert not any(line.get_visible() for line in axes.get_ygridlines())
    assert axes.get_ylim() == (len(estimates) - 0.5, -0.5)


def check_bars(axes, rows: list[list[float]]) -> None:
    """Each row has the shares of the five answers side by side, percent."""
    bars = np.array([[b.get_x(), b.get_y(), b.get_width(), b.get_height()] for b in axes.patches])
    bars = bars.reshape(len(rows), 5, 4)
    for row, (shares, found) in enumerate(zip(rows, bars)):
        assert found[:, 2] == pytest.approx(shares)
        assert found[:, 0] == pytest.approx(np.cumsum([0, *shares[:-1]]))
        assert found[:, 1] + found[:, 3] / 2 == pytest.approx(row)
        assert (found[:, 3] > 0.5).all() and (found[:, 3] < 1).all(), "rows do not touch"
    assert len({b.get_facecolor() for b in axes.patches[:5]}) == 5
    assert axes.get_xlim() == (0, 100) and list(axes.lines[0].get_xdata()) == [50, 50]
    assert axes.lines[0].get_linestyle() == "--" and "%" in axes.get_xlabel()


def test_preferences_are_shown_as_ratings_merits_and_answers(drawn):
    long = "b" * 50
    answers = [Answer(f"r{r}", "1", "a", long, s) for r, s in enumerate((2, 2, 1, 0, -1, 1, 1, -2))]
    answers += [Answer(f"r{r}", "2", long, "c", 1 - r % 2) for r in range(4)]
    answers += [Answer("r1", "2", "c", long, 1), Answer("r2", "2", "a", "c", 1)]
    axes, found = drawn(answers)
    elo, merit, bars = axes.values()
    assert list(axes) == [
        "Elo ratings with 95 % intervals",
        "Merit scores with 95 % intervals",
        "Answers to each pair, from the first clearly better to the second",
    ]
    systems = found.preference.systems
    assert [system.name for system in systems] == ["a", long, "c"]
    check_points(elo, [system.elo for system in systems], 1000)
    check_points(merit, [system.merit for system in systems], None)
    assert names(elo) == names(merit) == ["a", "b" * 43 + "…", "c"]
    assert elo.get_xlabel() == "Elo rating" and merit.get_xlabel() == "merit score"
    assert names(bars)[0] == f"a : {'b' * 39}…"
    # 2 of 8 clearly, 3 slightly, 1 equal, 1 slightly the other, 1 clearly the other.
    check_bars(bars, [[25, 37.5, 12.5, 12.5, 12.5], [0, 100, 0, 0, 0], [0, 40, 40, 20, 0]])


def test_systems_that_were_never_compared_have_no_rating(drawn):
    answers = [Answer(f"r{r}", "c", *pair, 1) for r in range(3) for pair in ("ab", "xy")]
    axes, _ = drawn(answers)
    assert [title.split()[0] for title in axes] == ["Merit", "Answers"]


@pytest.mark.parametrize(("length", "kept"), [(44, 44), (45, 43)])
def test_names_of_up_to_44_letters_are_whole(drawn, length, kept):
    name = "n" * length
    axes, _ = drawn([Answer(f"r{r}", "c", name, "x", 1 - r) for r in range(3)])
    shown = names(axes["Merit scores with 95 % intervals"])[0]
    assert shown == name[:kept] + ("…" if kept < length else "")


def test_alignment_is_shown_in_percent_beside_chance(drawn):
    scores = [2, 1, 0, -1] * 3
    answers = [
        Answer(f"r{k}", f"c{k}", name, f"{name}_Mismatched", sign * score)
        for name, sign in (("a", 1), ("b", -1))
        for k, score in enumerate(scores)
    ]
    axes, found = drawn(answers)
    points, bars = axes.values()
    assert list(axes) == [
        "Alignment with 95 % intervals; the line is chance",
        "Answers, from matched motion clearly better to mismatched",
    ]
    systems = found.alignment.systems
    check_points(points, [system.score for system in systems], 50, factor=100.0)
    # (2 + 1 + 0.5) of (2 + 1 + 1 + 1)
    assert points.lines[1].get_xdata() == pytest.approx([70.0])
    assert points.get_xlabel() == "alignment, %" and names(points) == ["a", "b"]
    check_bars(bars, [[25, 25, 25, 25, 0], [0, 25, 25, 25, 25]])


def test_figures_grow_with_their_rows(drawn):
    def heights(n: int) -> list[float]:
        pairs = [("a", "bcdefg"[k]) for k in range(n)]
        answers = [Answer(f"r{r}", "c", *pair, 1 - r) for pair in pairs for r in range(3)]
        return [axes.figure.get_size_inches()[1] for axes in drawn(answers)[0].values()]

    one, three = heights(1), heights(3)
    # A row for each system, or for each pair.
    for few, many in zip(one, three):
        assert 0.25 < (many - few) / 2 < 0.6
    assert 0.5 < one[0] - 2 * (three[0] - one[0]) / 2 < 1.5
    assert 0.5 < one[2] - (three[2] - one[2]) / 2 < 1.5
