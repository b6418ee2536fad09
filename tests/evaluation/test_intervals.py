"""Confidence intervals over takes: numbers worked out by hand, and simulated corpora."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from gesturekit.evaluation import (
    Takes,
    interval_of,
    interval_of_statistic,
    interval_over_samples,
    p_of_difference,
    pseudo_values,
    scaled_like,
    standard_error,
)

SPEEDS, SHARES, CORRELATIONS = (0.0, np.inf), (0.0, 100.0), (-1.0, 1.0)
SIX = ["a", "b", "c", "d", "e", "f"]


@pytest.fixture(scope="module")
def simulation():
    path = Path(__file__).parents[2] / "benchmarks" / "interval_coverage.py"
    spec = importlib.util.spec_from_file_location("interval_coverage", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


def test_an_interval_without_bounds_is_students():
    values = np.random.default_rng(0).normal(3.0, 1.0, 12)
    found = interval_of(values, Takes.nested([f"t{i}" for i in range(12)]))
    exact = stats.t.interval(0.95, 11, values.mean(), stats.sem(values))
    assert (found.low, found.high) == pytest.approx(exact)


def test_a_take_that_does_not_move_does_not_open_the_interval():
    """Its logarithm, -34.5, is taken as that of a tenth of the mean: ln .1 - ln .0083 = 2.485."""
    speeds = [0.1] * 5 + [1e-15]
    found = interval_of(speeds, Takes.nested(SIX), SPEEDS)
    half = stats.t.ppf(0.975, 5) * np.std([0.0] * 5 + [2.485], ddof=1) / np.sqrt(6)
    ends = np.mean(speeds) * np.exp([-half, half])
    assert (found.low, found.high) == pytest.approx(tuple(ends), rel=1e-2)


def test_samples_are_averaged_in_clips_and_clips_in_takes():
    # Take a: clip 1 with the samples 1 and 3, clip 2 with 8: (2 + 8) / 2 = 5. Take b: 7.
    takes = Takes.nested(["a", "a", "b", "a"], clips=["1", "1", "1", "2"])
    assert takes.means([1.0, 3.0, 7.0, 8.0]) == pytest.approx([5.0, 7.0])
    found = interval_of([1.0, 3.0, 7.0, 8.0], takes)
    assert (found.value, found.units, found.n) == (6.0, 2, 4)


def test_takes_of_one_name_belong_to_their_own_speakers():
    takes = Takes.nested(["1", "2", "1", "2"], ["ann", "ann", "ben", "ben"])
    assert takes.count == 4 and takes.speakers.tolist() == [0, 0, 1, 1]


def test_many_clips_and_samples_of_four_takes_give_no_interval():
    takes = Takes.nested(["a", "b", "c", "d"] * 50)
    found = interval_of(np.arange(200.0), takes)
    assert (found.low, found.high, found.units) == (None, None, 4) and takes.needed == 5


def test_takes_are_counted_beyond_one_of_each_speaker():
    five = Takes.nested(SIX[:5], ["x", "x", "y", "y", "z"])
    assert interval_of(np.arange(5.0), five).low is None and five.needed == 6
    six = Takes.nested(SIX, ["x", "x", "y", "y", "z", "z"])
    assert interval_of(np.arange(6.0), six).low is not None


def test_differences_between_speakers_do_not_widen_an_interval():
    # Residuals ±1 within each speaker: variance 6 / (6 - 3) = 2, error sqrt(2 / 6).
    speakers = np.array([0, 0, 1, 1, 2, 2])
    for offset in (0.0, 100.0):
        values = np.array([-1.0, 1.0] * 3) + offset * speakers
        assert standard_error(values, speakers) == pytest.approx((np.sqrt(1 / 3), 3))


def test_five_speakers_with_one_take_each_are_the_units():
    values = np.array([1.0, 2.0, 3.0, 4.0, 5.0])
    found = interval_of(values, Takes.nested(SIX[:5], SIX[:5]))
    exact = stats.t.interval(0.95, 4, 3.0, stats.sem(values))
    assert (found.low, found.high) == pytest.approx(exact)
    assert (found.units, found.speakers) == (5, 5)


def test_intervals_of_speeds_are_ratios_and_those_of_correlations_are_fishers():
    speeds = np.array([0.8, 0.9, 1.0, 1.0, 1.1, 1.2])
    found = interval_of(speeds, Takes.nested(SIX), SPEEDS)
    assert found.low * found.high == pytest.approx(found.value**2)
    logs = np.log(speeds)
    width = np.subtract(*stats.t.interval(0.95, 5, 0.0, stats.sem(logs))[::-1])
    assert np.log(found.high / found.low) == pytest.approx(width, rel=0.05)
    r = np.array([0.3, 0.4, 0.5, 0.5, 0.6, 0.7])
    found = interval_of(r, Takes.nested(SIX), CORRELATIONS)
    low, middle, high = np.arctanh([found.low, found.value, found.high])
    assert high - middle == pytest.approx(middle - low)
    width = np.subtract(*stats.t.interval(0.95, 5, 0.0, stats.sem(np.arctanh(r)))[::-1])
    assert high - low == pytest.approx(width, rel=0.1)


@pytest.mark.parametrize(
    ("values", "within"),
    [
        ([0.0, 0.0, 0.0, 0.0, 2.0, 9.0], SPEEDS),
        ([0.0, 0.0, 0.0, 0.0, 0.1, 60.0], SHARES),
        ([100.0, 100.0, 100.0, 100.0, 99.0, 20.0], SHARES),
        ([0.95, 0.99, 0.9, 0.97, -0.9, 0.99], CORRELATIONS),
    ],
)
def test_no_interval_leaves_the_range_of_its_metric(values, within):
    for speakers in (None, ["x"] * 3 + ["y"] * 3):
        found = interval_of(values, Takes.nested(SIX, speakers), within)
        assert within[0] <= found.low < found.value < found.high <= within[1]


def test_a_value_at_its_bound_has_no_interval():
    found = interval_of([0.0] * 6, Takes.nested(SIX), SHARES)
    assert (found.value, found.low, found.high) == (0.0, None, None)


def test_pseudo_values_of_a_mean_are_its_values_and_of_a_ratio_give_the_known_error():
    x, y = np.random.default_rng(1).uniform(1.0, 2.0, (2, 40))
    assert pseudo_values(lambda w: w @ x, 40) == pytest.approx(x)
    error = pseudo_values(lambda w: (w @ x) / (w @ y), 40).std(ddof=1) / np.sqrt(40)
    ratio = x.mean() / y.mean()
    known = np.std(x - ratio * y, ddof=1) / y.mean() / np.sqrt(40)  # of a ratio estimator
    assert error == pytest.approx(known, rel=0.02)


def test_a_statistic_of_a_set_leaves_out_take_by_take():
    values = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0])
    takes = Takes.nested(["a", "a", "b", "b", *SIX[2:]])
    found = interval_of_statistic(lambda chosen: float(values[chosen].mean()), takes)
    kept = [np.delete(values, at).mean() for at in ([0, 1], [2, 3], [4], [5], [6], [7])]
    error = np.sqrt(5 / 6 * ((kept - np.mean(kept)) ** 2).sum())  # jackknife
    assert found.value == 4.5 and found.units == 6
    assert found.high - 4.5 == pytest.approx(stats.t.ppf(0.975, 5) * error)


def test_an_interval_moves_to_another_value_on_the_scale_of_the_metric():
    found = interval_of([0.8, 0.9, 1.0, 1.0, 1.1, 1.2], Takes.nested(SIX), SPEEDS)
    moved = scaled_like(found, 0.1, SPEEDS)
    assert (moved.low, moved.high) == pytest.approx((0.1 * found.low, 0.1 * found.high))
    assert scaled_like(found, 0.0, SPEEDS).low is None


def test_the_paired_test_is_the_one_of_scipy():
    one, other = np.random.default_rng(2).normal(size=(2, 9))
    zero = np.zeros(9, int)
    assert p_of_difference(one, other, zero) == pytest.approx(stats.ttest_rel(one, other).pvalue)
    for a, b in ((one, other), (other, one)):
        above = stats.ttest_rel(a, b, alternative="greater").pvalue
        assert p_of_difference(a, b, zero, above=True) == pytest.approx(above)
    assert p_of_difference(one[:4], other[:4], zero[:4]) is None
    assert p_of_difference(one, one, zero) == 1.0, "equal takes"


@pytest.mark.stress
@pytest.mark.parametrize(("takes", "speakers"), [(6, 2), (6, 3), (12, 1)])
def test_simulated_corpora_are_covered_and_equal_models_do_not_differ(simulation, takes, speakers):
    for truth in simulation.TRUTHS:
        found = simulation.rates(truth, takes, speakers, 300)
        assert 0.88 <= found["covered"] <= 0.99, (truth.key, found)
        assert 0.01 <= found["differs"] <= 0.10, (truth.key, found)
        assert found["outside"] == found["none"] == 0.0


def test_samples_of_one_recording_have_students_interval():
    values = [1.0, 2.0, 4.0, 5.0, 8.0]
    found = interval_over_samples(values)
    exact = stats.t.interval(0.95, 4, 4.0, stats.sem(values))
    assert (found.value, found.n, found.units, found.over) == (4.0, 5, 5, "samples")
    assert (found.low, found.high) == pytest.approx(exact)
    assert interval_over_samples(values[:4]).low is None
