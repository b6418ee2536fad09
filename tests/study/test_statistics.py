"""Figures of the analysis, against statsmodels, scipy, and counting by hand."""

import itertools

import numpy as np
import pytest
import statsmodels.api as sm
from scipy import stats
from statsmodels.stats.proportion import proportion_confint

from gesturekit.errors import EvaluationError
from gesturekit.evaluation import Answer, Answers
from gesturekit.study import Votes, analyse_study, raters_needed
from gesturekit.study.analysis.alignment import analyse_alignment
from gesturekit.study.analysis.preference import (
    analyse_preference,
    elo,
    fit_strengths,
    weighted_wins,
)
from gesturekit.study.analysis.significance import Expected, power_of, rater_test, two_proportions


def expect(win_rate=0.6, ties=0.2, clear=0.4, agreement=0.05) -> Expected:
    return Expected(win_rate, ties, clear, agreement)


def test_bradley_terry_equals_a_logistic_regression_of_statsmodels(simulate):
    wins = weighted_wins(simulate([0.5, 0.1, -0.2, -0.4])).sum(axis=0)
    strengths = fit_strengths(wins)
    pairs = list(itertools.permutations(range(4), 2))
    design = np.zeros((len(pairs), 3))  # the last system is the reference
    for row, (i, j) in enumerate(pairs):
        for column, sign in ((i, 1.0), (j, -1.0)):
            if column < 3:
                design[row, column] = sign
    weights = np.array([wins[i, j] for i, j in pairs])
    fit = sm.GLM(
        np.ones(len(pairs)), design, family=sm.families.Binomial(), freq_weights=weights
    ).fit(tol=1e-12)
    assert strengths[:3] - strengths[3] == pytest.approx(fit.params, abs=1e-5)
    assert elo(strengths).mean() == pytest.approx(1000)
    ten_to_one = fit_strengths(np.array([[0.0, 10.0], [1.0, 0.0]]))
    assert np.diff(elo(ten_to_one))[0] == pytest.approx(-400, abs=0.01)


def test_anova_and_tukey_equal_those_of_scipy(simulate, answers_of):
    answers = answers_of(simulate([0.3, 0.0, -0.2]))
    found = analyse_preference(answers, rounds=10, seed=0)
    scores = {name: [] for name in "abc"}
    for answer in answers:
        scores[answer.left].append(max(answer.score, 0))
        scores[answer.right].append(max(-answer.score, 0))
    expected = stats.f_oneway(*scores.values())
    assert (found.anova.f, found.anova.p) == pytest.approx((expected.statistic, expected.pvalue))
    assert (found.anova.between, found.anova.within) == (2, 2 * len(answers) - 3)
    tukey = stats.tukey_hsd(*scores.values()).pvalue
    for (i, j), p in found.anova.tukey.items():
        assert p == pytest.approx(tukey[i, j], abs=1e-6)
    assert {(p.a, p.b): p.p_tukey for p in found.pairs}["a", "b"] == found.anova.tukey[0, 1]


def test_the_raters_test_by_hand_leaves_out_raters_without_answers():
    # Means 3/2, -1 and 2/4: t = (1/3) / sqrt(19/36) = 0.458831; with 2 degrees of freedom
    # p = 1 - t / sqrt(2 + t²).
    found = rater_test(np.array([3.0, 0.0, -1.0, 2.0]), np.array([2, 0, 1, 4]))
    assert found == pytest.approx(0.691394, abs=1e-6)
    # Two raters: t = 0.5 / 0.5 = 1, and with 1 degree of freedom p = 1 - 2 atan(1) / π.
    assert rater_test(np.array([1.0, 0.0]), np.array([1, 1])) == pytest.approx(0.5)
    assert np.isnan(rater_test(np.array([2.0, 0.0]), np.array([1, 0]))), "a single rater"
    # All agree: the sign test, or no preference at all.
    assert rater_test(np.array([-2.0, -4.0, -2.0]), np.array([1, 2, 1])) == 2 * 0.5**3
    assert rater_test(np.zeros(3), np.ones(3)) == 1


# Two raters: a draw of the raters is u alone, v alone, or both, a quarter of all draws or more, so
# that intervals reach from the figure of the one to that of the other.
TWO = [Answer("u", str(k), "a", "b", score) for k, score in enumerate((2, -1))]
TWO += [Answer("v", str(k), "b", "a", score) for k, score in enumerate((-1, 2, 2, 0, 0))]


def test_scores_of_two_raters_by_hand():
    found = analyse_preference(TWO, rounds=60, seed=0)
    best, other = found.systems
    assert (best.name, best.n, other.name, other.n) == ("b", 7, "a", 7)

    def figures(estimate) -> list[float]:
        return pytest.approx([estimate.value, estimate.low, estimate.high], abs=1e-4)

    # Merit of b: u 1 of 2, v 2 + 2 of 5; of a: u 2 of 2, v 1 of 5.
    assert figures(best.merit) == [5 / 7, 1 / 2, 4 / 5]
    assert figures(other.merit) == [3 / 7, 1 / 5, 2 / 2]
    # Weighted wins of b to a: u 2 : 4, v 4 + 4 + 2 : 2 + 2; odds of 10 are 400 points.
    points = 400 * np.log10([12 / 8, 2 / 4, 10 / 4]) / 2
    assert list(1000 + points) == figures(best.elo)
    assert list(1000 - points[[0, 2, 1]]) == figures(other.elo)
    (pair,) = found.pairs
    assert (pair.a, pair.b, pair.counts, pair.n, pair.raters) == ("b", "a", (2, 1, 2, 1, 1), 7, 2)
    assert [pair.win_rate.low, pair.win_rate.high] == pytest.approx(
        proportion_confint(3, 5, method="wilson")
    )
    # Means of b: u (1 - 2) / 2, v (2 + 2 - 1) / 5.
    assert pair.p == pair.p_holm == pytest.approx(stats.ttest_1samp([-1 / 2, 3 / 5], 0).pvalue)
    assert not found.not_compared and not found.separate and found.bounded


def test_alignment_of_two_raters_by_hand():
    turn = {"a": "x", "b": "x_Mismatched"}
    answers = [Answer(a.user, a.clip, turn[a.left], turn[a.right], a.score) for a in TWO]
    (found,) = analyse_alignment(answers, rounds=60, seed=0).systems
    assert found.counts == (1, 1, 2, 1, 2) and found.raters == 2
    # u 2 of 3, v 1 + 2 halves of 1 + 2 + 2 + 2 ties.
    score = (found.score.value, found.score.low, found.score.high)
    assert score == pytest.approx((4 / 10, 2 / 7, 2 / 3))
    assert found.win_rate.value == 2 / 5
    assert found.p == found.p_holm == pytest.approx(stats.ttest_1samp([1 / 2, -3 / 5], 0).pvalue)


def test_columns_taken_for_raters_and_systems_are_refused():
    answers = [Answer(f"r{r}", "c", f"a{r}", f"b{r}", 1) for r in range(200)]
    with pytest.raises(EvaluationError, match="200 raters and 400 systems"):
        Votes.of(answers)


def test_barnard_equals_the_largest_probability_over_the_common_rate():
    a, b = (9, 3), (4, 8)
    n, m = sum(a), sum(b)
    x, y = np.meshgrid(np.arange(n + 1), np.arange(m + 1), indexing="ij")
    pooled = (x + y) / (n + m)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = np.nan_to_num((x / n - y / m) / np.sqrt(pooled * (1 - pooled) * (1 / n + 1 / m)))
    extreme = np.abs(z) >= np.abs(z[a[0], b[0]]) - 1e-9
    rates = np.linspace(0.001, 0.999, 2001)[:, None, None]
    p = stats.binom.pmf(x, n, rates) * stats.binom.pmf(y, m, rates)
    assert two_proportions(a, b) == pytest.approx((p * extreme).sum(axis=(1, 2)).max(), rel=1e-3)
    assert np.isnan(two_proportions((0, 0), (3, 4)))
    assert two_proportions((1, 0), (0, 1)) == pytest.approx(0.5), "one answer each"


def test_forty_raters_find_the_known_order(simulate, answers_of):
    votes = simulate([0.6, 0.0, -0.6])
    found = analyse_preference(answers_of(votes), rounds=100, seed=0)
    assert [system.name for system in found.systems] == ["a", "b", "c"]
    assert {(p.a, p.b) for p in found.pairs} == {("a", "b"), ("a", "c"), ("b", "c")}
    assert all(p.p_holm < 0.01 and p.p_tukey < 0.01 for p in found.pairs)
    elo = [system.elo for system in found.systems]
    assert elo[0].low > elo[1].high and elo[1].low > elo[2].high


def test_no_pair_is_dropped_in_silence():
    answers = [Answer(f"r{r}", "c", "a", "b", 1) for r in range(3)]
    answers += [Answer(f"r{r}", "c", "x", "y", r - 1) for r in range(3)]
    found = analyse_study(Answers(tuple(answers)), rounds=20)
    assert found.preference.separate == (("a", "b"), ("x", "y"))
    assert set(found.preference.not_compared) == {("a", "x"), ("a", "y"), ("b", "x"), ("b", "y")}
    assert all(np.isnan(system.elo.value) for system in found.preference.systems)
    assert len(found.preference.pairs) == 2


def test_a_system_that_always_wins_has_finite_figures_and_is_marked():
    answers = [Answer(f"r{r}", "c", "a", "b", 2) for r in range(5)]
    found = analyse_preference(answers, rounds=50, seed=0)
    assert not found.bounded
    assert all(np.isfinite(system.elo.value) for system in found.systems)
    assert found.pairs[0].p == pytest.approx(2 * 0.5**5)  # the sign test, as all means are equal


def test_the_power_is_that_of_simulated_studies():
    expected = expect(win_rate=0.65, ties=0.2, clear=0.4, agreement=0.0)
    raters = raters_needed(expected, answers=3)
    assert power_of(expected, raters, 3) >= 0.8 > power_of(expected, raters - 1, 3)
    shares = np.array([0.65 * 0.4, 0.65 * 0.6, 0.35 * 0.6, 0.35 * 0.4]) * 0.8
    rng = np.random.default_rng(0)
    scores = rng.choice([2, 1, -1, -2, 0], p=[*shares, 0.2], size=(2000, raters, 3)).mean(axis=2)
    p = stats.ttest_1samp(scores, 0, axis=1).pvalue
    assert (p < 0.05).mean() == pytest.approx(0.8, abs=0.04)
