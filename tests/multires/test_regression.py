"""Regression of movement from speech, against the textbook's formulas and by hand."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from gesturekit.multires.recall.ahead import AheadPrediction, FeatureWindow
from gesturekit.multires.recall.wanted import (
    Regression,
    WantedMovement,
    correlation,
    fast_inputs,
    folds_of,
    nearly_best,
    slow_inputs,
)

FPS = 12.5
PENALTIES = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0)


def noise(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(shape)


def ridge(x: np.ndarray, y: np.ndarray, penalty: float) -> tuple[np.ndarray, float]:
    """Weights and the prediction at 0, by the normal equations."""
    mean, own = x.mean(axis=0), x - x.mean(axis=0)
    square = own.T @ own
    size = penalty * np.trace(square) / len(square)
    weights = np.linalg.solve(square + size * np.eye(len(square)), own.T @ (y - y.mean()))
    return weights, y.mean() - mean @ weights


@pytest.mark.parametrize("noisy", [0.1, 3.0, 30.0])
def test_a_regression_is_that_of_the_best_penalty(noisy):
    """A noisy curve of few frames and many inputs needs a larger penalty."""
    x = noise(60, 12) * np.geomspace(0.3, 3, 12) + 5.0
    y = 2.0 + x @ noise(12, seed=1) + noisy * noise(60, seed=2)
    folds = folds_of([40, 20], ["a", "b"], gap=2)
    found = Regression.fit([x[:40], x[40:]], [y[:40], y[40:]], folds)
    left_out = np.zeros((len(PENALTIES), 60))
    for row, penalty in zip(left_out, PENALTIES, strict=True):
        for out, kept in folds:
            weights, at_0 = ridge(x[kept], y[kept], penalty)
            row[out] = x[out] @ weights + at_0
    r = [np.corrcoef(row, y)[0, 1] for row in left_out]
    best = int(np.argmax(r))
    assert found.r == pytest.approx(r[best])
    own, size = left_out[best], left_out[best].std()
    np.testing.assert_allclose(found.left_out, np.clip((own - own.mean()) / size, -2.5, 2.5))
    weights, at_0 = ridge(x, y, PENALTIES[best])
    np.testing.assert_allclose(found.weights, weights / size)
    for inputs, limit in ((noise(5, 12, seed=3) + 5, 2.5), (noise(5, 12) * 99, 2.5)):
        expected = (inputs @ weights + at_0 - own.mean()) / size
        np.testing.assert_allclose(found(inputs), np.clip(expected, -limit, limit))


def test_of_many_frames_every_third_is_fitted():
    """Frames 0, 3, 6 ... of 60001 are used. Between them the curve goes the other way."""
    x = noise(60_001, 1)
    y = np.where(np.arange(60_001) % 3 == 0, 1.0, -4.0) * x[:, 0]
    folds = folds_of([20_000, 20_001, 20_000], ["a", "b", "c"], gap=1)
    found = Regression.fit([x], [y], folds)
    assert found.weights[0] > 0
    assert found.r == pytest.approx(np.corrcoef(x[:, 0], y)[0, 1], abs=1e-3) and found.r < 0
    few = Regression.fit([x[:30_000]], [y[:30_000]], folds_of([30_000], ["a"], gap=1))
    assert few.weights[0] < 0, "of 30000, all"


def test_a_fold_that_leaves_a_single_frame_is_fitted_to_all():
    x, y = noise(3, 2), noise(3)
    every, one = np.ones(3, bool), np.array([True, False, False])
    found = Regression.fit([x], [y], [(every, one)])
    expected = Regression.fit([x], [y], [(every, every)])
    np.testing.assert_allclose(found.left_out, expected.left_out)
    two = Regression.fit([x], [y], [(every, np.array([True, True, False]))])
    assert np.abs(two.left_out - expected.left_out).max() > 1e-3


@pytest.mark.parametrize("gap", [5, 100])
def test_the_gap_beside_a_part_is_half_a_part_at_most(gap):
    """Quarters of 40 frames have 10."""
    found = folds_of([40], ["a"], gap)
    assert [np.flatnonzero(~kept).tolist() for _, kept in found] == [
        list(range(*part)) for part in ((0, 15), (5, 25), (15, 35), (25, 40))
    ]


def test_correlation_is_pearsons():
    a, b = noise(2, 50)
    assert correlation(a + 3, 2 * b + a) == pytest.approx(np.corrcoef(a, 2 * b + a)[0, 1])
    assert correlation(a, -a) == pytest.approx(-1.0)
    assert correlation(a, np.full(50, 7.0)) == correlation(np.ones(50), a) == 0.0
    assert correlation(1e-5 * a, 1e-5 * a) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("r", "used"),
    [((0.5, 0.48, 0.46), 1), ((0.5, 0.46, 0.48), 2), ((0.5, 0.46), 0), ((0.3, 0.5, 0.2), 1)],
)
def test_the_last_that_predicts_nearly_as_well_is_used(r, used):
    assert nearly_best([SimpleNamespace(r=own) for own in r]) == used


# Inputs.


def test_fast_inputs_are_means_of_five_bins_without_the_slow_part():
    """At 12.5 fps a bin of 0.16 s has two frames: the one before and the frame itself."""
    speech = noise(3, 40) + np.linspace(0, 9, 40)
    basis = np.eye(3)[:, [2, 0]]
    own = speech[[2, 0]]
    own = own - gaussian_filter1d(own, 2.0 * FPS, axis=1, mode="nearest")
    found = fast_inputs(speech, basis, FPS)
    assert found.shape == (40, 10)
    at = np.arange(40)
    means = (own[:, np.maximum(at - 1, 0)] + own[:, at]) / 2
    expected = [means[row, np.clip(at + 2 * k, 0, 39)] for k in range(-2, 3) for row in (0, 1)]
    np.testing.assert_allclose(found, np.transpose(expected))
    # Slower than three frames a second, a bin is a single frame.
    own = speech[[2, 0]]
    own = own - gaussian_filter1d(own, 2.0 * 3, axis=1, mode="nearest")
    expected = [own[row, np.clip(at + k, 0, 39)] for k in range(-2, 3) for row in (0, 1)]
    np.testing.assert_allclose(fast_inputs(speech, basis, 3.0), np.transpose(expected))


def test_slow_inputs_are_smoothed_over_two_seconds():
    speech = noise(3, 60)
    expected = gaussian_filter1d(speech[[1]], 2.0 * FPS, axis=1, mode="nearest")
    np.testing.assert_allclose(slow_inputs(speech, np.eye(3)[:, [1]], FPS), expected.T)


# Both parts.


def takes_of(between: float, n_takes: int = 6, n_columns: int = 3):
    """Speech whose effort, column 2, says how lively each moment is, and `between` of each take.

    Column 0 says when hands move. Returns speech, movement, the slow part and takes.
    """
    speeches, movements, slow = [], [], []
    for k in range(n_takes):
        level = 0.7 * noise(seed=k) if n_takes > 1 else 0.0
        mood = gaussian_filter1d(noise(600, seed=100 + k), 6 * FPS, mode="wrap")
        mood = (mood - mood.mean()) / mood.std()
        fast = noise(600, seed=200 + k)
        speech = 0.01 * noise(n_columns, 600, seed=300 + k)
        speech[0] += gaussian_filter1d(fast, 1.0)
        speech[2] += mood + level
        speeches.append(speech)
        slow.append(mood + between * level)
        movements.append(0.5 * gaussian_filter1d(fast, 1.0) + 0.0 * mood)
    return speeches, movements, slow, [f"take {k}" for k in range(n_takes)]


@pytest.mark.parametrize(
    ("between", "counts"),
    [
        (1.0, (5 * 1.0 + 4 * 0.3) / 9),
        (0.0, 4 * 0.3 / 9),
        (-0.3, 4 * 0.3 / 9),
        (3.0, (5 * 1.0 + 4 * 0.3) / 9),
    ],
)
def test_the_mean_of_an_utterance_counts_as_it_did_on_left_out_takes(between, counts):
    """Its slope relative to that within takes, from 0 to 1; six takes against four of 0.3."""
    speeches, movements, slow, takes = takes_of(1.0)
    slow = [own + (between - 1.0) * own.mean() for own in slow]
    wanted = WantedMovement.fit(speeches, movements, slow, FPS, (2,), takes=takes)
    tolerance = 0.04 if 0 <= between <= 1 else 1e-6
    assert wanted.mean_counts == pytest.approx(counts, abs=tolerance)
    assert wanted.across_takes and wanted.trust == 1.0 and wanted.predicts
    # The mean of a prediction is reduced by it, and everything else is not.
    speech = takes_of(1.0, 7)[0][6]
    raw = wanted.slow(slow_inputs(speech, wanted.slow_basis, FPS))
    whole = replace(wanted, voices=np.array([[-99.0], [0.0], [99.0]]))
    found = whole(speech)[1]
    np.testing.assert_allclose(found - found.mean(), raw - raw.mean(), atol=1e-9)
    assert found.mean() == pytest.approx(wanted.mean_counts * raw.mean())
    assert wanted.slow.left_out.std() == pytest.approx(1.0)


def test_a_mean_that_counts_in_part_is_found_by_least_squares():
    """Takes differ in length, so that the mean of their means is not that of all frames."""
    speeches, movements, slow, takes = takes_of(1.0)
    lengths = [150, 600, 300, 450, 600, 200]
    speeches = [own[:, :n] for own, n in zip(speeches, lengths, strict=True)]
    movements, slow = (
        [own[:n] for own, n in zip(rows, lengths, strict=True)] for rows in (movements, slow)
    )
    slow = [own - 0.6 * own.mean() + shift for own, shift in zip(slow, 0.2 * noise(6), strict=True)]
    wanted = WantedMovement.fit(speeches, movements, slow, FPS, (2,), takes=takes)
    x = [slow_inputs(speech, wanted.slow_basis, FPS) for speech in speeches]
    folds = folds_of(lengths, takes, 1)
    fitted = Regression.fit(x, slow, folds)
    predicted = np.split(fitted.left_out, np.cumsum(lengths)[:-1])
    means = np.polyfit([own.mean() for own in predicted], [own.mean() for own in slow], 1)[0]
    changes = [np.concatenate([own - own.mean() for own in rows]) for rows in (predicted, slow)]
    share = means / np.polyfit(*changes, 1)[0]
    assert 0.2 < share < 0.8
    assert wanted.mean_counts == pytest.approx((5 * share + 4 * 0.3) / 9)
    steady = np.concatenate([own - (1 - wanted.mean_counts) * own.mean() for own in predicted])
    np.testing.assert_allclose(wanted.slow.left_out, steady / steady.std())
    assert wanted.slow.r == pytest.approx(np.corrcoef(steady, np.concatenate(slow))[0, 1])
    np.testing.assert_allclose(wanted.slow.weights, fitted.weights / steady.std())
    assert wanted.slow.offset == pytest.approx(fitted.offset / steady.std())


@pytest.mark.parametrize(("n_takes", "trust"), [(1, 0.5), (2, 0.5), (3, 1.0)])
def test_parts_of_few_takes_are_trusted_half(n_takes, trust):
    speeches, movements, slow, takes = takes_of(0.0, n_takes)
    wanted = WantedMovement.fit(speeches, movements, slow, FPS, (2,), takes=takes)
    assert wanted.trust == trust and wanted.across_takes == (n_takes > 2)
    if n_takes < 3:
        assert wanted.mean_counts == pytest.approx(0.3)
    nothing = replace(wanted, slow=replace(wanted.slow, r=0.0))
    assert nothing.trust == 0.0 and nothing.predicts
    assert not replace(nothing, spread=0.0).predicts
    assert replace(wanted, spread=0.0).predicts
    words = wanted.summary()
    assert f"r = {wanted.fast.r:.2f} with 2 features" in words
    other = f"(taken as {0.5 * wanted.slow.r:.2f} on other takes); found on left-out parts"
    assert (other in words) == (n_takes < 3)
    assert words.endswith("takes" if n_takes > 2 else "parts of recordings")


def test_the_spread_is_that_of_the_conditional_mean_and_voices_are_those_of_training():
    speeches, movements, slow, takes = takes_of(1.0)
    wanted = WantedMovement.fit(speeches, movements, slow, FPS, (2,), takes=takes)
    fast = [own - gaussian_filter1d(own, 2.0 * FPS, mode="nearest") for own in movements]
    assert 0.9 < wanted.fast.r < 1.0
    assert wanted.spread == pytest.approx(wanted.fast.r * np.concatenate(fast).std())
    effort = np.sort(np.concatenate([own[2] for own in speeches]))
    n = len(effort)
    expected = [effort[round(0.02 * n)], effort.mean(), effort[round(0.98 * n)]]
    np.testing.assert_allclose(wanted.voices[:, 0], expected, atol=0.02)
    np.testing.assert_array_equal(wanted.fast_basis[2], 0.0)  # effort is slow
    found = wanted(speeches[0])[0]
    inputs = fast_inputs(speeches[0], wanted.fast_basis, FPS)
    np.testing.assert_allclose(found, wanted.spread * wanted.fast(inputs))
    against = [-own for own in movements]
    mirrored = WantedMovement.fit(speeches, against, slow, FPS, (2,), takes=takes)
    assert mirrored.spread == pytest.approx(wanted.spread)


def test_a_smaller_set_of_columns_is_used_where_it_predicts_as_well():
    """Column 0 says everything of fast movement, the last ones of nothing."""
    speeches, movements, slow, takes = takes_of(1.0, n_columns=6)

    def fitted(*smaller):
        return WantedMovement.fit(speeches, movements, slow, FPS, (2,), smaller, takes)

    def columns(basis: np.ndarray) -> list[int]:
        return np.flatnonzero(basis.any(axis=1)).tolist()

    assert columns(fitted().fast_basis) == [0, 1, 3, 4, 5]
    assert columns(fitted([0, 1, 2], [0]).fast_basis) == [0]
    assert columns(fitted([0, 1, 2], [3]).fast_basis) == [0, 1]
    assert columns(fitted([0, 1], []).fast_basis) == [0, 1], "no set is empty"
    assert columns(fitted([0, 1]).slow_basis) == [2], "vocal effort alone says how lively"
    plain = WantedMovement.fit(speeches, movements, slow, FPS, (), [[2]], takes)
    assert columns(plain.slow_basis) == [2]


def test_many_columns_are_reduced_to_their_64_largest_components():
    base = noise(64, 400)
    mixing = noise(70, 64, seed=1)
    speeches = [mixing @ base + 1e-6 * noise(70, 400, seed=2)]
    wanted = WantedMovement.fit(speeches, [base[0]], [base[1]], FPS, ())
    assert wanted.fast_basis.shape == (70, 64)
    # Orthonormal, and all of the speech lies in them.
    np.testing.assert_allclose(wanted.fast_basis.T @ wanted.fast_basis, np.eye(64), atol=1e-9)
    back = wanted.fast_basis @ (wanted.fast_basis.T @ speeches[0])
    np.testing.assert_allclose(back, speeches[0], atol=1e-3)
    few = WantedMovement.fit([own[:64] for own in speeches], [base[0]], [base[1]], FPS, ())
    np.testing.assert_array_equal(few.fast_basis, np.eye(64))


def test_predictions_ahead_of_a_calm_voice_are_those_of_the_usual_one():
    """Vocal effort far outside of the training's range is moved to its mean."""
    regression = Regression(np.zeros(2), np.array([1.0, 0.5]), 0.0, 0.6)
    fast = Regression(np.zeros(5), np.array([0.0, 0.0, 0.0, 0.0, 2.0]), 0.1, 0.3)
    one = AheadPrediction(0.2, np.array([0]), np.array([1]), fast, regression)
    voices = np.array([[-1.0], [0.5], [1.0]])
    wanted = SimpleNamespace(
        fps=FPS, effort=(1,), voices=voices, spread=0.4, fast=SimpleNamespace(r=0.6)
    )
    rows = np.zeros((8, 2))
    rows[-2:, 0] = 0.2, 0.4  # the last bin: 0.3 above the mean of 0
    usual = one(FeatureWindow(rows, np.array([[0.0, 0.4], [0.0, 0.8]])), wanted)
    assert usual == pytest.approx(((2 * 0.3 + 0.1) * 0.4 * 0.5, 0.4 + 0.4))
    # The mean of both averages is 11: ten too far; it is moved to 0.5.
    far = one(FeatureWindow(rows, np.array([[0.0, 10.8], [0.0, 11.2]])), wanted)
    assert far == pytest.approx((usual[0], 0.3 + 0.7 / 2))
    better = replace(one, fast=replace(fast, r=0.9))
    assert better(FeatureWindow(rows, np.zeros((2, 2))), wanted)[0] == pytest.approx(0.7 * 0.4)
    wrong = replace(one, fast=replace(fast, r=-0.2))
    assert wrong(FeatureWindow(rows, np.zeros((2, 2))), wanted)[0] == 0.0
