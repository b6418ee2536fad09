"""Regression of movement from speech, against the textbook's formulas and by hand."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from gesturekit.state.prediction import (
    AheadPrediction,
    FeatureWindow,
    Regression,
    WantedMovement,
    fast_inputs,
    folds_of,
    last_bins,
    slow_inputs,
    usual_voice,
)

FPS = 12.5


def noise(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(shape)


def test_a_regression_finds_what_inputs_say_and_is_the_more_careful_the_noisier_they_are():
    """Its predictions have a standard deviation of one on left-out takes, and have a limit."""
    x, true = noise(60, 12) * np.geomspace(0.3, 3, 12) + 5.0, noise(12, seed=1)
    folds, sizes = folds_of([40, 20], ["a", "b"], gap=2), []
    for noisy, low, high in ((0.1, 0.98, 1.0), (1.0, 0.6, 0.98), (300.0, -1.0, 0.5)):
        y = 2.0 + x @ true + noisy * noise(60, seed=2)
        found = Regression.fit([x[:40], x[40:]], [y[:40], y[40:]], folds)
        assert low < found.r < high
        assert found.left_out.mean() == pytest.approx(0, abs=0.1)
        assert found.left_out.std() == pytest.approx(1, abs=0.15)
        other = noise(200, 12, seed=3) * np.geomspace(0.3, 3, 12) + 5.0
        sizes.append(np.corrcoef(found(other), other @ true)[0, 1])
        assert np.abs(found(noise(50, 12) * 99)).max() < 4, "however far inputs are"
    assert sizes[0] > 0.98 and sizes[0] > sizes[1] > 0.7


def test_takes_are_left_out_as_a_whole_or_in_quarters_with_a_gap():
    """Recordings of 3, 2, 4 and 1 frames, of which the first and the last are of one take; then 12
    frames of two takes in quarters of 3, and 40 in quarters of 10."""
    found = folds_of([3, 2, 4, 1], ["x", "y", "z", "x"], gap=1)
    whole = [[0, 1, 2, 9], [3, 4], [5, 6, 7, 8]]
    assert [np.flatnonzero(out).tolist() for out, _ in found] == whole
    assert all((kept == ~out).all() for out, kept in found)
    many = folds_of([1] * 40, [f"{k}" for k in range(40)], gap=1)
    assert len(many) == 8 and sum(out for out, _ in many).tolist() == [1] * 40
    quarters = [((0, 2), (0, 3)), ((2, 5), (1, 6)), ((5, 8), (4, 8)), ((8, 12), (8, 12))]
    for (out, kept), (left_out, near) in zip(folds_of([8, 4], "ab", gap=1), quarters, strict=True):
        assert np.flatnonzero(out).tolist() == list(range(*left_out))
        assert np.flatnonzero(~kept).tolist() == list(range(*near))
    far = [np.flatnonzero(~kept).tolist() for _, kept in folds_of([40], ["a"], gap=100)]
    assert far == [list(range(*part)) for part in ((0, 15), (5, 25), (15, 35), (25, 40))]


def test_fast_inputs_are_means_of_five_bins_without_the_slow_part():
    """At 12.5 fps a bin of 0.16 s has two frames: the one before and the frame itself."""
    speech = noise(3, 40) + np.linspace(0, 9, 40)
    own = speech[[2, 0]]
    own = own - gaussian_filter1d(own, 2.0 * FPS, axis=1, mode="nearest")
    at = np.arange(40)
    means = (own[:, np.maximum(at - 1, 0)] + own[:, at]) / 2
    expected = [means[row, np.clip(at + 2 * k, 0, 39)] for k in range(-2, 3) for row in (0, 1)]
    found = fast_inputs(speech, np.eye(3)[:, [2, 0]], FPS)
    np.testing.assert_allclose(found, np.transpose(expected))
    expected = gaussian_filter1d(speech[[1]], 2.0 * FPS, axis=1, mode="nearest")
    np.testing.assert_allclose(slow_inputs(speech, np.eye(3)[:, [1]], FPS), expected.T)


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
        movements.append(0.5 * gaussian_filter1d(fast, 1.0))
    return speeches, movements, slow, [f"take {k}" for k in range(n_takes)]


def fitted(pairs, effort=(2,), smaller=()) -> WantedMovement:
    return WantedMovement.fit(*pairs[:3], FPS, effort, smaller, takes=pairs[3])


@pytest.mark.parametrize(("between", "share"), [(1.0, 1.0), (0.0, 0.0), (-0.3, 0.0), (3.0, 1.0)])
def test_the_mean_of_an_utterance_counts_as_it_did_on_left_out_takes(between, share):
    pairs = takes_of(between)
    wanted = fitted(takes_of(1.0)[:2] + pairs[2:])
    assert (0.5 < wanted.mean_counts < 1) if share else (0 <= wanted.mean_counts < 0.3)
    # The mean of a prediction is reduced by it, and everything else is not.
    speech = takes_of(1.0, 7)[0][6]
    raw = wanted.slow(slow_inputs(speech, wanted.slow_basis, FPS))
    found = replace(wanted, voices=np.array([[-99.0], [0.0], [99.0]]))(speech)[1]
    np.testing.assert_allclose(found - found.mean(), raw - raw.mean(), atol=1e-9)
    assert found.mean() == pytest.approx(wanted.mean_counts * raw.mean())


@pytest.mark.parametrize(("n_takes", "trust"), [(1, 0.5), (2, 0.5), (3, 1.0)])
def test_parts_of_few_takes_are_trusted_half(n_takes, trust):
    """A correlation within takes is no promise: mood, day and voice do not change in it."""
    wanted = fitted(takes_of(0.0, n_takes))
    assert wanted.trust == trust and wanted.across_takes == (n_takes > 2)
    wrong = replace(wanted, slow=replace(wanted.slow, r=-0.4))
    assert wrong.trust == 0.0 and wrong.predicts and not replace(wrong, spread=0.0).predicts
    assert replace(wanted, spread=0.0).predicts
    words = wanted.summary()
    assert f"{wanted.fast.r:.2f}" in words and f"{wanted.slow.r:.2f}" in words
    assert (f"{0.5 * wanted.slow.r:.2f}" in words) == (n_takes < 3)


def test_the_spread_is_that_of_the_conditional_mean_and_voices_are_those_of_training():
    speeches, movements, slow, takes = takes_of(1.0)
    wanted = fitted((speeches, movements, slow, takes))
    fast = [own - gaussian_filter1d(own, 2.0 * FPS, mode="nearest") for own in movements]
    assert 0.9 < wanted.fast.r < 1.0
    assert wanted.spread == pytest.approx(wanted.fast.r * np.concatenate(fast).std())
    effort = np.sort(np.concatenate([own[2] for own in speeches]))
    low, middle, high = wanted.voices[:, 0]
    assert middle == pytest.approx(effort.mean(), abs=0.02)
    assert (np.quantile(effort, [0.001, 0.9]) < [low, high]).all()
    assert (np.quantile(effort, [0.1, 0.999]) > [low, high]).all()
    np.testing.assert_array_equal(wanted.fast_basis[2], 0.0)  # effort is slow
    inputs = fast_inputs(speeches[0], wanted.fast_basis, FPS)
    np.testing.assert_allclose(wanted(speeches[0])[0], wanted.spread * wanted.fast(inputs))
    # A level or a slow change of it says nothing of when hands move.
    np.testing.assert_allclose(wanted(speeches[0] + 3)[0], wanted(speeches[0])[0], atol=1e-9)


def test_uninformative_speech_predicts_hardly_anything():
    """Nor does speech whose meaning on other takes is the opposite."""
    speeches, movements, slow, takes = takes_of(1.0)
    shuffled = fitted((speeches[1:] + speeches[:1], movements, slow, takes))
    assert abs(shuffled.fast.r) < 0.2 and shuffled.spread < 0.1
    signs = (1, 1, 1, -1, -1, -1)
    turned = [[sign * own for sign, own in zip(signs, rows)] for rows in (movements, slow)]
    wrong = fitted((speeches, *turned, takes))
    assert wrong.fast.r < 0
    np.testing.assert_array_equal(wrong(speeches[0])[0], 0.0)
    still = [np.zeros_like(own) for own in movements]
    nothing = fitted(([0 * own for own in speeches], still, still, takes))
    np.testing.assert_array_equal(nothing(speeches[0]), 0.0)


def test_a_smaller_set_of_columns_is_used_where_it_predicts_as_well():
    """Column 0 says everything of fast movement, the last ones of nothing."""
    pairs = takes_of(1.0, n_columns=6)

    def columns(basis: np.ndarray) -> list[int]:
        return np.flatnonzero(basis.any(axis=1)).tolist()

    for smaller, used in (
        ((), [0, 1, 3, 4, 5]),
        (([0, 1, 2], [0]), [0]),
        (([0, 1, 2], [3]), [0, 1]),
        (([0, 1], []), [0, 1]),
    ):
        found = fitted(pairs, smaller=smaller)
        assert columns(found.fast_basis) == used
    assert columns(found.slow_basis) == [2], "vocal effort alone says how lively"
    assert columns(fitted(pairs, (), [[2]]).slow_basis) == [2]


def test_many_columns_are_reduced_to_their_largest_components():
    base = noise(40, 400)  # of which 70 columns are mixed
    speeches = [noise(70, 40, seed=1) @ base + 1e-6 * noise(70, 400, seed=2)]
    wanted = WantedMovement.fit(speeches, [base[0]], [base[1]], FPS, ())
    # Orthonormal, and all of the speech lies in them.
    assert (count := wanted.fast_basis.shape[1]) < 70
    np.testing.assert_allclose(wanted.fast_basis.T @ wanted.fast_basis, np.eye(count), atol=1e-9)
    back = wanted.fast_basis @ (wanted.fast_basis.T @ speeches[0])
    np.testing.assert_allclose(back, speeches[0], atol=1e-3)
    few = WantedMovement.fit([own[:count] for own in speeches], [base[0]], [base[1]], FPS, ())
    np.testing.assert_array_equal(few.fast_basis, np.eye(count))


def test_an_unusual_voice_is_centred_and_a_usual_one_unchanged():
    """Half way at 1.5 half ranges outside of those of training, -1 to 1 about 0."""
    voices = np.array([[-1.0], [0.0], [1.0]])
    for level, expected in ((-1.9, -1.9), (0.7, 0.7), (2.5, 1.25), (-8.0, 0.0), (3.0, 0.0)):
        own = 0.1 * noise(50)
        speech = np.stack([noise(50, seed=1), level + own - own.mean()])
        kept = usual_voice(speech, (1,), voices)
        np.testing.assert_array_equal(kept[0], speech[0])
        np.testing.assert_allclose(kept[1] - kept[1].mean(), speech[1] - level, atol=1e-9)
        assert kept[1].mean() == pytest.approx(expected, abs=1e-9)


# Predictions for live speech.


def test_inputs_of_predictions_are_means_of_bins_that_end_now():
    """At 12.5 fps a bin of 0.16 s has two rows: four bins, relative to the running mean."""
    rows = np.arange(20.0).reshape(10, 2)  # rows [0, 1], [2, 3], ... [18, 19]
    speech = FeatureWindow(rows, np.array([[1.0, 2.0], [50.0, 60.0]]))
    expected = [[1, 2], [5 - 1, 6 - 2], [9 - 1, 10 - 2], [13 - 1, 14 - 2], [17 - 1, 18 - 2]]
    np.testing.assert_allclose(last_bins(speech, 12.5), expected)
    # Half a row of a slow model rounds to one.
    one = [[1, 2], [12 - 1, 13 - 2], [14 - 1, 15 - 2], [16 - 1, 17 - 2], [18 - 1, 19 - 2]]
    np.testing.assert_allclose(last_bins(speech, 3.0), one)


def test_predictions_ahead_of_a_calm_voice_are_those_of_the_usual_one():
    """Vocal effort far outside of the training's range is moved to its mean."""
    regression = Regression(np.zeros(2), np.array([1.0, 0.5]), 0.0, 0.6)
    fast = Regression(np.zeros(5), np.array([0.0, 0.0, 0.0, 0.0, 2.0]), 0.1, 0.3)
    one = AheadPrediction(0.2, np.array([0]), np.array([1]), fast, regression)
    voices, whole = np.array([[-1.0], [0.5], [1.0]]), SimpleNamespace(r=0.6)
    wanted = SimpleNamespace(fps=FPS, effort=(1,), voices=voices, spread=0.4, fast=whole)
    rows = np.zeros((8, 2))
    rows[-2:, 0] = 0.2, 0.4  # the last bin: 0.3 above the mean of 0
    usual = one(FeatureWindow(rows, np.array([[0.0, 0.4], [0.0, 0.8]])), wanted)
    assert usual == pytest.approx(((2 * 0.3 + 0.1) * 0.4 * 0.5, 0.4 + 0.4))
    # The mean of both averages is 11: ten too far; it is moved to 0.5.
    far = one(FeatureWindow(rows, np.array([[0.0, 10.8], [0.0, 11.2]])), wanted)
    assert far == pytest.approx((usual[0], 0.3 + 0.7 / 2))
    for r, expected in ((0.9, 0.7 * 0.4), (-0.2, 0.0)):
        other = replace(one, fast=replace(fast, r=r))
        assert other(FeatureWindow(rows, np.zeros((2, 2))), wanted)[0] == pytest.approx(expected)


def test_predictions_ahead_find_what_speech_says():
    """Movement is twice the last bin of column 1; a calm voice is column 0's mean over 8 s."""
    wanted = replace(fitted(takes_of(1.0)), effort=())

    def recording(seed: int):
        own = np.random.default_rng(seed)
        speeches, fast, slow = [], [], []
        for _ in range(150):
            rows, averages = own.standard_normal((10, 3)), own.standard_normal((2, 3))
            speeches.append(FeatureWindow(rows, averages))
            fast.append(2 * rows[-2:, 1].mean() + 0.1 * own.standard_normal())
            slow.append(averages[1, 0] + 0.1 * own.standard_normal())
        return speeches, np.array(fast), np.array(slow)

    speeches, fast, slow = zip(*(recording(seed) for seed in range(3)), strict=True)
    found = AheadPrediction.fit(0.2, speeches, fast, slow, "abc", wanted, [(0, 1, 2), (1,)], 5.0)
    assert found.fast_columns.tolist() == [1], "fewer columns that predict as well"
    assert found.slow_columns.tolist() == [0, 1, 2], "one that does not know it is not used"
    assert found.fast.r > 0.95 and found.slow.r > 0.95
    unseen, true_fast, true_slow = recording(9)
    made = np.array([found(one, wanted) for one in unseen])
    assert np.corrcoef(made[:, 0], true_fast)[0, 1] > 0.9
    assert np.corrcoef(made[:, 1], true_slow)[0, 1] > 0.9
