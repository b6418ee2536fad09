"""Figures of the analysis, against statsmodels, scipy, and counting by hand."""

import itertools

import numpy as np
import pytest
import statsmodels.api as sm
from scipy import stats
from statsmodels.stats.multicomp import pairwise_tukeyhsd
from statsmodels.stats.oneway import anova_oneway
from statsmodels.stats.proportion import proportion_confint
from statsmodels.stats.sandwich_covariance import cov_cluster_2groups

from gesturekit.errors import EvaluationError
from gesturekit.evaluation import Answer, Answers, read_answers
from gesturekit.evaluation.statistics.scores import mean_estimate, mean_test, share
from gesturekit.study import Votes, analyse_study, raters_needed
from gesturekit.study.analysis import (
    ELO,
    analyse_alignment,
    analyse_preference,
    elo,
    fit_strengths,
)
from gesturekit.study.power import Expected, power_of


def test_bradley_terry_equals_a_logistic_regression_of_statsmodels(simulate):
    votes = Votes.of(simulate([0.5, 0.1, -0.2, -0.4]))
    (wins,) = votes.gains(votes.counts, ELO)
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


def test_anova_and_tukey_equal_those_of_statsmodels(simulate):
    answers = simulate([0.3, 0.0, -0.2])
    found = analyse_preference(answers, rounds=10, seed=0)
    scores = [(name, max(sign * answer.score, 0)) for answer in answers
              for name, sign in ((answer.left, 1), (answer.right, -1))]  # fmt: skip
    groups, values = map(np.array, zip(*scores, strict=True))
    f, p = anova_oneway([values[groups == name] for name in "abc"], use_var="equal")[:2]
    assert (found.anova["f"], found.anova["p"]) == pytest.approx((f, p))
    assert found.anova["df"] == [2, 2 * len(answers) - 3]
    tukey = pairwise_tukeyhsd(values, groups).pvalues
    p_tukey = {tuple(sorted((p.a, p.b))): p.p_tukey for p in found.pairs}
    assert [p_tukey[pair] for pair in (("a", "b"), ("a", "c"), ("b", "c"))] == pytest.approx(
        tukey, abs=1e-6
    )


def answered(raters: str, clips: str, scores: list[int]) -> tuple[np.ndarray, ...]:
    """Return scores, raters and clips as the tests take them."""
    units = (np.unique(list(names), return_inverse=True)[1] for names in (raters, clips))
    return np.array(scores), *units


def test_means_are_tested_over_raters_and_clips_as_in_statsmodels():
    rng = np.random.default_rng(0)
    rater, clip = np.repeat(np.arange(14), 9), np.tile(np.arange(9), 14)
    for shift, group in ((0.4, None), (0.0, (rater < 7) & (clip < 5))):
        noise = rng.standard_normal(14)[rater] + rng.standard_normal(9)[clip]
        scores = np.rint(shift + noise + rng.standard_normal(126))
        design = np.ones((126, 1)) if group is None else np.c_[np.ones(126), group]
        fit = sm.OLS(scores, design).fit()
        both, *single = (c[-1, -1] for c in cov_cluster_2groups(fit, rater, clip))
        assert both > max(single), "raters and clips both matter here"
        p = mean_test(scores, rater, clip, group)
        t = abs(fit.params[-1]) / both**0.5
        # Between Student's t with fewer degrees of freedom than clips, and the normal law.
        assert 2 * stats.norm.sf(t) < p < 2 * stats.t.sf(t, 7)


def test_the_interval_of_a_mean_holds_what_its_test_does_not_refuse():
    rng = np.random.default_rng(1)
    rater, clip = np.repeat(np.arange(12), 8), np.tile(np.arange(8), 12)
    values = 50 + 9 * rng.standard_normal(12)[rater] + 9 * rng.standard_normal(8)[clip]
    values += 9 * rng.standard_normal(96)
    found = mean_estimate(values, rater, clip)
    assert found.value == pytest.approx(values.mean())
    for bound in (found.low, found.high):
        assert mean_test(values - bound, rater, clip) == pytest.approx(0.05)
    assert np.isnan(mean_estimate(values[:8], rater[:8], clip[:8]).low), "a single rater"


def test_means_of_few_answers_by_hand():
    # One clip: mean 1/2 of u (2, 1) and v (-1, 0); sums of deviations are 2 and -2, so that the
    # variance is 2 · (2² + 2²) / 4² = 1, t = 1/2, and with 1 degree of freedom 1 - 2 atan(t) / π.
    one_clip = mean_test(*answered("uuvv", "cccc", [2, 1, -1, 0]))
    assert one_clip == pytest.approx(1 - 2 * np.arctan(0.5) / np.pi)
    assert np.isnan(mean_test(*answered("uu", "cd", [1, 2]))), "a single rater"
    # All agree: the sign test over raters or clips, whichever are fewer, or no preference at all.
    assert mean_test(*answered("uvwxuvwx", "ccccdddd", [2] * 8)) == 2 * 0.5**2
    assert mean_test(*answered("uvw", "cde", [-1] * 3)) == 2 * 0.5**3
    assert mean_test(*answered("uvw", "cde", [0] * 3)) == 1


def test_equal_systems_rarely_differ_and_intervals_hold_the_truth():
    """Clips and raters that differ: tests that take answers as independent fail here."""
    rng = np.random.default_rng(0)
    rater, clip = np.repeat(np.arange(30), 12), np.tile(np.arange(12), 30)
    found, held, naive = [], [], []
    for _ in range(400):
        noise = 0.4 * rng.standard_normal(30)[rater] + 0.4 * rng.standard_normal(12)[clip]
        scores = np.clip(np.rint(noise + rng.standard_normal(360)), -2, 2)
        found.append(mean_test(scores, rater, clip) < 0.05)
        interval = share(scores, rater, clip)
        held.append(interval.low <= 0.5 <= interval.high)
        naive.append(stats.ttest_1samp(scores, 0).pvalue < 0.05)
    assert 0.02 < np.mean(found) < 0.09 and 0.91 < np.mean(held) < 0.98 and np.mean(naive) > 0.2


def test_shares_are_wilsons_with_the_independent_answers():
    every = np.arange(20)
    scores = np.where(every < 13, 1, -2)
    wins = share(scores, every, every)  # rater and clip of its own: all answers are independent
    # p (1 - p) n / (n - 1) is the variance, and t replaces the normal quantile.
    n = 19 * (stats.norm.ppf(0.975) / stats.t.ppf(0.975, 19)) ** 2
    assert (wins.low, wins.high) == pytest.approx(proportion_confint(0.65 * n, n, method="wilson"))
    assert wins.value == 0.65 and share(np.r_[scores, 0], *[np.r_[every, 20]] * 2).value == 0.65
    always = share(*answered("uvwuvw", "cccddd", [1] * 6))  # two clips alone are independent
    assert (always.low, always.high) == pytest.approx(proportion_confint(2, 2, method="wilson"))
    one_clip = share(*answered("uvw", "ccc", [1] * 3))
    assert one_clip.low == pytest.approx(proportion_confint(3, 3, method="wilson")[0])


# Two raters on one clip: a draw of the raters is u alone, v alone, or both, a quarter of all draws
# or more, so that intervals reach from the figure of the one to that of the other.
TWO = [Answer("u", "c", "a", "b", score) for score in (2, -1)]
TWO += [Answer("v", "c", "b", "a", score) for score in (-1, 2, 2, 0, 0)]


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
    assert (pair.a, pair.b, pair.counts, pair.raters) == ("b", "a", (2, 1, 2, 1, 1), 2)
    assert pair.win_rate.value == 3 / 5 and pair.mean == pytest.approx(2 / 7)
    # Sums of deviations from the mean are -1 - 4/7 and 3 - 10/7: 11/7 each, over 7 answers.
    t = (2 / 7) / (2 * 11 / 49)
    assert pair.p == pair.p_holm == pytest.approx(1 - 2 * np.arctan(t) / np.pi)
    assert not found.not_compared and not found.separate and found.bounded


def test_alignment_of_two_raters_by_hand():
    turn = {"a": "x", "b": "x_Mismatched"}
    answers = [Answer(a.user, a.clip, turn[a.left], turn[a.right], a.score) for a in TWO]
    (((found, alignment),), _) = analyse_alignment(answers, rounds=60, seed=0)
    assert found.counts == (1, 1, 2, 1, 2) and found.raters == 2
    # u 2 of 3, v 1 + 2 halves of 1 + 2 + 2 + 2 ties.
    score = (alignment.value, alignment.low, alignment.high)
    assert score == pytest.approx((4 / 10, 2 / 7, 2 / 3))
    assert found.win_rate.value == 2 / 5
    assert found.p == found.p_holm == pytest.approx(1 - 2 * np.arctan(7 / 11) / np.pi)


def test_columns_taken_for_raters_and_systems_are_refused():
    answers = [Answer(f"r{r}", "c", f"a{r}", f"b{r}", 1) for r in range(200)]
    with pytest.raises(EvaluationError, match="200 raters and 400 systems"):
        Votes.of(answers)


def test_forty_raters_find_the_known_order(simulate):
    found = analyse_preference(simulate([0.6, 0.0, -0.6]), rounds=100, seed=0)
    assert [system.name for system in found.systems] == ["a", "b", "c"]
    assert {(p.a, p.b) for p in found.pairs} == {("a", "b"), ("a", "c"), ("b", "c")}
    assert all(p.p_holm < 0.01 and p.p_tukey < 0.01 for p in found.pairs)
    elo = [system.elo for system in found.systems]
    assert elo[0].low > elo[1].high and elo[1].low > elo[2].high


def test_a_system_with_a_single_answer_leaves_out_tukeys_test():
    found = analyse_preference([*TWO, Answer("u", "d", "a", "c", 1)], rounds=10, seed=0)
    assert found.anova is not None and all(np.isnan(pair.p_tukey) for pair in found.pairs)


def test_each_question_has_the_mean_ratings_of_its_own_answers(tmp_path):
    rows = ["rater,system,clip,question,value"]
    for k, (one, other) in enumerate([(70, 20), (80, 10)]):
        rows += [f"r{k},ours,c,human-likeness,{one}", f"r{k},theirs,c,human-likeness,{other}"]
        rows += [f"r{k},ours,c,appropriateness,{other}", f"r{k},theirs,c,appropriateness,{one}"]
    (tmp_path / "ratings.csv").write_text("\n".join(rows))
    found = analyse_study(read_answers([tmp_path / "ratings.csv"]), rounds=10)
    merits = {
        question: {system.name: system.merit.value for system in one.systems}
        for question, one in found.by_style.items()
    }
    assert merits == {
        "human-likeness": {"ours": 75.0, "theirs": 15.0},
        "appropriateness": {"ours": 15.0, "theirs": 75.0},
    }
    assert found.preference is None, "two questions have no common mean"


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
    expected = Expected(0.65, ties=0.2, clear=0.4, rater_share=0.05, clip_share=0.1)
    design = {"answers": 6, "clips": 24}
    raters = raters_needed(expected, **design)
    assert power_of(expected, raters, **design) >= 0.8 > power_of(expected, raters - 1, **design)
    rng = np.random.default_rng(0)
    preference, slight, clear = expected.thresholds()
    drawn = preference + rng.standard_normal(400_000)
    scores = np.sign(drawn) * np.digitize(abs(drawn), (slight, clear))
    shares = [np.mean(scores > 0), np.mean(scores < 0), np.mean(abs(scores) == 2)]
    assert shares == pytest.approx([0.8 * 0.65, 0.8 * 0.35, 0.8 * 0.4], abs=0.004)
    mean, variance = expected.moments()
    assert (mean, variance) == pytest.approx((scores.mean(), scores.var()), abs=0.01)
    assert Expected(0.65, 0.2, 0.0, 0.05, 0.1).moments()[0] == pytest.approx(0.8 * 0.3)
    assert Expected(0.65, 0.2, 1.0, 0.05, 0.1).moments()[0] == pytest.approx(0.8 * 0.6)
    found = []
    for _ in range(600):
        rater = np.repeat(np.arange(raters), 6)
        clip = np.concatenate([rng.permutation(24)[:6] for _ in range(raters)])
        noise = np.sqrt(0.05) * rng.standard_normal(raters)[rater]
        noise += np.sqrt(0.1) * rng.standard_normal(24)[clip]
        noise += np.sqrt(0.85) * rng.standard_normal(len(rater))
        found.append(mean_test(mean + variance**0.5 * noise, rater, clip) < 0.05)
    assert np.mean(found) == pytest.approx(0.8, abs=0.08)
    assert raters_needed(expected, answers=1, clips=3) is None, "three clips say too little"


def test_merit_intervals_are_95_percent_wide():
    """80 raters with an answer each to one clip: 1.96 standard errors either way."""
    scores = np.random.default_rng(0).choice([2, 1, 0, -1, -2], 80)
    answers = [Answer(f"r{k}", "c", "a", "b", int(score)) for k, score in enumerate(scores)]
    found = analyse_preference(answers, rounds=4000, seed=0)
    merits = {system.name: system.merit for system in found.systems}
    for name, gained in (("a", np.maximum(scores, 0)), ("b", np.maximum(-scores, 0))):
        half = 1.96 * gained.std() / np.sqrt(80)
        merit = merits[name]
        ends = [merit.value - merit.low, merit.high - merit.value]
        assert merit.value == pytest.approx(gained.mean()) and ends == pytest.approx(
            [half] * 2, rel=0.15
        )
