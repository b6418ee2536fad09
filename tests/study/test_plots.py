"""Plots of a study's report: marks at the places of their values."""

import numpy as np
import pytest
from figures import kept_figures, points

from gesturekit.evaluation import Answer, Answers
from gesturekit.study import analyse_study
from gesturekit.study import report as plots


@pytest.fixture
def drawn(monkeypatch):
    """drawn(answers): the axes of each plot, and the result of the study."""
    figures = kept_figures(monkeypatch)

    def draw(answers: list[Answer]):
        figures.clear()
        found = analyse_study(Answers(tuple(answers)), rounds=50)
        assert all("<svg" in svg for svg in plots.all_plots(found).values())
        return [figure.axes[0] for figure in figures], found

    return draw


def check_points(axes, estimates, factor: float = 1.0) -> None:
    """Each row has the line of its interval and the dot of its value."""
    shown = points(axes)[: 2 * len(estimates)]
    for row, found in enumerate(estimates):
        (line, at), (dot, _) = shown[2 * row : 2 * row + 2]
        assert line == pytest.approx([factor * found.low, factor * found.high])
        assert dot == pytest.approx([factor * found.value]) and at == [row, row]


def shares(axes, rows: int) -> list[list[float]]:
    bars = np.array([[b.get_x(), b.get_width()] for b in axes.patches]).reshape(rows, 5, 2)
    assert bars[:, 1:, 0] == pytest.approx(np.cumsum(bars[:, :, 1], axis=1)[:, :-1])
    return bars[..., 1].tolist()


def test_preferences_are_shown_as_ratings_merits_and_answers(drawn):
    long = "b" * 50
    answers = [Answer(f"r{r}", "1", "a", long, s) for r, s in enumerate((2, 2, 1, 0, -1, 1, 1, -2))]
    answers += [Answer(f"r{r}", "2", long, "c", 1 - r % 2) for r in range(4)]
    answers += [Answer("r1", "2", "c", long, 1), Answer("r2", "2", "a", "c", 1)]
    (elo, merit, bars), found = drawn(answers)
    systems = found.preference.systems
    check_points(elo, [system.elo for system in systems])
    check_points(merit, [system.merit for system in systems])
    first, second, third = (text.get_text() for text in elo.get_yticklabels())
    assert (first, third) == ("a", "c") and second.startswith("bbb") and len(second) < 50
    # 2 of 8 clearly, 3 slightly, 1 equal, 1 slightly the other, 1 clearly the other.
    assert shares(bars, 3) == [[25, 37.5, 12.5, 12.5, 12.5], [0, 100, 0, 0, 0], [0, 40, 40, 20, 0]]
    apart = [Answer(f"r{r}", "c", *pair, 1) for r in range(3) for pair in ("ab", "xy")]
    assert len(drawn(apart)[0]) == 2, "no rating of systems that were never compared"
