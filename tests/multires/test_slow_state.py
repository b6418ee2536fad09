"""The slow state that is drawn: its fit to takes of a known process, and what is drawn from it."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy import stats
from scipy.ndimage import gaussian_filter1d

from gesturekit.multires.recall.slow_state import (
    _BETWEEN_TAKES,
    _PRIOR_TAKES,
    SlowState,
    normal_scores,
    recorded_quantiles,
    recorded_values,
)

FPS = 5.0


def rng(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


# Normal scores and recorded values.


def test_scores_are_the_quantiles_of_ranks_among_the_same_group():
    """Ranks of 4 values lie at 1/8, 3/8, 5/8 and 7/8; equal values share their mean rank."""
    ann = [np.array([[1.0, 100.0]]), np.array([[2.0, 7.0]])]
    bo = [np.array([[-5.0, -5.0, 3.0]])]
    one, two, three = normal_scores([ann[0], bo[0], ann[1]], ["Ann", "Bo", "Ann"])
    np.testing.assert_allclose(one, [stats.norm.ppf([1 / 8, 7 / 8])])
    np.testing.assert_allclose(three, [stats.norm.ppf([3 / 8, 5 / 8])])
    np.testing.assert_allclose(two, [stats.norm.ppf([1 / 3, 1 / 3, 5 / 6])])
    (together,) = normal_scores([np.concatenate([ann[0], ann[1], bo[0]], axis=1)], [None])
    assert np.argsort(together[0])[-1] == 1 and together[0, 1] == stats.norm.ppf(13 / 14)


def test_a_calm_speaker_has_the_same_scores_as_a_lively_one():
    """Scores are ranks within a speaker and style: calm frames of one may be lively for another."""
    calm = np.random.default_rng(0).gamma(1.0, size=(2, 300))
    lively = 50 + 3 * calm
    one, two = normal_scores([calm, lively], "ab")
    np.testing.assert_array_equal(one, two)
    one, two = normal_scores([calm, lively], "aa")
    assert one.max() < two.min()


@pytest.mark.parametrize("seed", range(3))
def test_scores_of_recorded_values_are_those_values_again(seed):
    """Skewed values come back from their scores, within a quantile of 1/200."""
    values = np.random.default_rng(seed).gamma([[0.5], [3.0]], size=(2, 4000))
    parts = np.split(values, [1000, 1200], axis=1)
    scores = normal_scores(parts, ["a"] * 3)
    for own, score in zip(parts, scores, strict=True):
        again = recorded_values(score, recorded_quantiles(parts))
        for row, found, every in zip(own, again, values, strict=True):
            ranks = [stats.percentileofscore(every, some) for some in (row, found)]
            assert np.abs(np.subtract(*ranks)).max() < 0.51
            assert stats.spearmanr(row, found).statistic > 0.9999
    extreme = recorded_values(np.array([[-9.0, 9.0]] * 2), recorded_quantiles(parts))
    assert (values.min(axis=1) <= extreme[:, 0]).all()
    assert (extreme[:, 1] <= values.max(axis=1)).all()


def test_drawn_values_have_the_recorded_skewed_distribution():
    """Rests make the movement of a speaker skewed: a mean and a deviation would not say so."""
    recorded = [np.random.default_rng(k).exponential(size=(1, 500)) for k in range(4)]
    state = simple(width=1.5)
    scores = np.concatenate([state.draw(rng(k), 600, FPS, None) for k in range(60)], axis=1)
    drawn = recorded_values(scores, recorded_quantiles(recorded))[0]
    shares = np.array([0.1, 0.25, 0.5, 0.75, 0.9])
    exact = -np.log(1 - shares)
    np.testing.assert_allclose(np.quantile(drawn, shares), exact, rtol=0.1, atol=0.03)


# A process of known parameters.


def simple(*, between=0.0, width=3.0, take=60.0, mixing=1.0, explained=0.0, trust=1.0) -> SlowState:
    """A process, of one channel by default."""
    mixing = np.atleast_2d(mixing).astype(float)
    every = [np.full(len(mixing), value, float) for value in (explained, between, width)]
    return SlowState(every[0], trust, mixing, every[1], every[2], take)


def simulated(count, *, between, width, r=0.0, seconds=120.0, seed=0) -> list[np.ndarray]:
    """Return scores (2, T) of takes whose channels have these properties, by another simulation.

    A take adds the same to all its frames, with the variance `between`. Within, white noise is
    smoothed by a Gaussian. Channels have the correlation r in both.
    """
    own = np.random.default_rng(seed)
    n = round(seconds * FPS)

    def both(*shape: int) -> np.ndarray:
        one, other = own.standard_normal((2, *shape))
        return np.stack([one, r * one + np.sqrt(1 - r**2) * other])

    takes = []
    for _ in range(count):
        within = gaussian_filter1d(both(n + 400), width * FPS, axis=1)[:, 200:-200]
        within /= np.sqrt(1 / (2 * np.sqrt(np.pi) * width * FPS))
        takes.append(np.sqrt(between) * both(1) + np.sqrt(1 - between) * within)
    return takes


def names(count: int) -> list[str]:
    return [f"take {k}" for k in range(count)]


@pytest.mark.parametrize("between", [0.0, 0.3, 0.7])
@pytest.mark.parametrize("width", [2.0, 6.0])
def test_many_takes_show_the_process(between, width):
    scores = simulated(60, between=between, width=width, r=0.5)
    fit = SlowState.fit(scores, None, names(60), FPS)
    # 59 degrees of freedom count against those of the prior.
    expected = (59 * between + _PRIOR_TAKES * _BETWEEN_TAKES) / (59 + _PRIOR_TAKES)
    np.testing.assert_allclose(fit.between, expected, atol=0.11)
    np.testing.assert_allclose(fit.width, width, rtol=0.25)
    correlation = fit.mixing @ fit.mixing.T
    np.testing.assert_allclose(np.diag(correlation), 1.0)
    assert correlation[0, 1] == pytest.approx(0.5, abs=0.12)
    np.testing.assert_array_equal(fit.explained, 0.0)
    assert fit.take == pytest.approx(120.0)


@pytest.mark.parametrize("between", [0.0, 0.9])
def test_a_single_take_tells_nothing_of_other_takes(between):
    """The prior share of the variance is expected, however many parts the take is in."""
    for count in (1, 5):
        scores = simulated(count, between=between, width=3.0, seed=1)
        fit = SlowState.fit(scores, None, ["one"] * count, FPS)
        np.testing.assert_allclose(fit.between, _BETWEEN_TAKES)


def test_three_takes_lie_between_what_they_show_and_what_is_expected():
    """Two degrees of freedom against those of the prior."""
    of_prior = _PRIOR_TAKES / (_PRIOR_TAKES + 2)

    def found(between: float) -> float:
        takes = [simulated(3, between=between, width=2.0, seed=seed) for seed in range(12)]
        fits = [SlowState.fit(scores, None, names(3), FPS) for scores in takes]
        return float(np.mean([fit.between for fit in fits]))

    assert found(0.0) == pytest.approx(of_prior * _BETWEEN_TAKES, abs=0.03)
    # Three takes show some two thirds of what differs between takes.
    assert _BETWEEN_TAKES + 0.05 < found(0.8) < of_prior * _BETWEEN_TAKES + (1 - of_prior) * 0.8


def test_recordings_of_one_take_share_what_is_between_takes():
    """Clips cut from few sessions are no more sessions."""
    whole = simulated(6, between=0.6, width=2.0, seed=3)
    clips = [part for own in whole for part in np.split(own, 4, axis=1)]
    as_clips = SlowState.fit(clips, None, [name for name in names(6) for _ in range(4)], FPS)
    assert as_clips.take == pytest.approx(120.0)
    as_takes = SlowState.fit(whole, None, names(6), FPS)
    np.testing.assert_allclose(as_clips.between, as_takes.between, atol=0.12)


def variogram_fit(curves: list[np.ndarray], lags: list[int], fps: float) -> tuple[float, float]:
    """Return the share of the variance within takes, and its width in seconds, of one channel.

    The share (from 0 to 1) and the width of least squared error, weighted by the pairs of frames.
    """
    pairs = [[(own[lag:], own[:-lag]) for own in curves if len(own) > lag] for lag in lags]
    counts = np.array([sum(len(a) for a, _ in own) for own in pairs])
    halves = np.array([np.concatenate([a - b for a, b in own]).var() for own in pairs])
    halves += np.array([np.concatenate([a - b for a, b in own]).mean() ** 2 for own in pairs])
    best = (np.inf, 0.0, 0.0)
    for width in 1.5 * 16 ** (np.arange(13) / 12):
        shape = 1 - np.exp(-((np.array(lags) / fps / width) ** 2) / 4)
        weights = np.sqrt(counts)
        share = np.linalg.lstsq((weights * shape)[:, None], weights * halves / 2, rcond=None)[0][0]
        share = min(max(share, 0.0), 1.0)
        error = (counts * (halves / 2 - share * shape) ** 2).sum()
        best = min(best, (error, share, width))
    return best[1:]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    ("lengths", "fps", "lags"),
    [
        # 24 lags from half a second to half of the longest recording, rounded down.
        ((50, 23, 31), 5.0, [*range(2, 14), 15, 16, 18, 20, 22, 25]),
        ((8, 3, 5), 5.0, [2, 3, 4]),
        ((3, 2, 3), 1.0, [1, 2]),
    ],
)
def test_smoothness_is_fitted_to_differences_at_all_lags(seed, lengths, fps, lags):
    own = np.random.default_rng(seed)
    scores = [
        gaussian_filter1d(own.standard_normal((3, n)), width, axis=1) + own.normal(size=(3, 1))
        for n, width in zip(lengths, (0.5, 4.0, 9.0), strict=True)
    ]
    fit = SlowState.fit(scores, None, names(3), fps)
    sizes = np.concatenate(scores, axis=1).std(axis=1)
    for channel in range(3):
        curves = [part[channel] / sizes[channel] for part in scores]
        within, width = variogram_fit(curves, lags, fps)
        expected = (2 * (1 - within) + _PRIOR_TAKES * _BETWEEN_TAKES) / (2 + _PRIOR_TAKES)
        assert fit.between[channel] == pytest.approx(expected)
        assert within == 0 or fit.width[channel] == pytest.approx(width)


def test_recordings_too_short_for_a_lag_have_half_of_the_variance_within():
    fit = SlowState.fit([np.random.default_rng(0).normal(size=(2, 2))] * 2, None, names(2), FPS)
    expected = (0.5 + _PRIOR_TAKES * _BETWEEN_TAKES) / (1 + _PRIOR_TAKES)
    np.testing.assert_allclose(fit.between, expected)
    np.testing.assert_array_equal(fit.width, 1.5)


def test_what_speech_explains_is_no_part_of_the_noise():
    """Within takes, scores follow the prediction with r = 0.8; all else is constant in a take."""
    own, n, count = np.random.default_rng(0), 600, 40
    predicted = gaussian_filter1d(own.standard_normal((count, n + 100)), 10)[:, 50:-50]
    predicted -= predicted.mean(axis=1, keepdims=True)
    predicted /= predicted.std()
    moods = np.repeat([1.0, -1.0], count // 2)[:, None]
    scores = [row[None] for row in 0.8 * predicted + 0.6 * moods]
    slow = SimpleNamespace(left_out=predicted.ravel())
    fit = SlowState.fit(scores, SimpleNamespace(trust=1.0, slow=slow), names(count), FPS)
    assert fit.explained[0] == pytest.approx(0.8, abs=0.03)
    assert fit.between[0] > 0.9
    # Not trusted, all of the prediction is left in the noise: 0.64 of 1.
    unheard = SlowState.fit(scores, SimpleNamespace(trust=0.0, slow=slow), names(count), FPS)
    expected = (39 * 0.36 + _PRIOR_TAKES * _BETWEEN_TAKES) / (39 + _PRIOR_TAKES)
    assert unheard.between[0] == pytest.approx(expected, abs=0.12)
    halved = SlowState.fit(scores, SimpleNamespace(trust=0.5, slow=slow), names(count), FPS)
    assert unheard.between[0] + 0.1 < halved.between[0] < fit.between[0] - 0.1


@pytest.mark.parametrize("n_frames", [1, 2, 3, 20])
def test_short_and_still_recordings_give_a_process_too(n_frames):
    for scores in ([np.zeros((2, n_frames))] * 2, [np.random.default_rng(0).normal(size=(2, 1))]):
        fit = SlowState.fit(scores, None, names(len(scores)), FPS)
        drawn = fit.draw(rng(), 30, FPS, None)
        assert drawn.shape == (2, 30) and np.isfinite(drawn).all()
        assert (fit.between >= 0).all() and (fit.between <= 1).all() and fit.take > 0


def test_channels_that_always_go_together_are_drawn_together():
    """A correlation matrix without an inverse: the second channel is the first."""
    scores = [np.concatenate([own[:1]] * 2) for own in simulated(5, between=0.3, width=3.0)]
    fit = SlowState.fit(scores, None, names(5), FPS)
    drawn = fit.draw(rng(), 2000, FPS, None)
    np.testing.assert_allclose(drawn[0], drawn[1], atol=0.02)


# What is drawn.


@pytest.mark.parametrize("between", [0.0, 0.4, 1.0])
def test_draws_have_the_standard_deviation_1_and_their_share_between_takes(between):
    """A take of 40 s: its component changes little in 5 s, the one within takes (0.5 s) does."""
    state = simple(between=between, width=0.5, take=40.0)
    drawn = np.stack([state.draw(rng(k), 25, FPS, None)[0] for k in range(800)])
    assert drawn.std() == pytest.approx(1.0, abs=0.05)
    assert drawn.mean() == pytest.approx(0.0, abs=0.08)
    # The mean over 5 s of noise with correlation exp(-t^2 / (4 0.5^2)): its variance by hand is
    # 2/25 * integral of (5 - t) exp(-t^2) = 2/25 * (5 sqrt(pi)/2 - 1/2) = 0.3145.
    variance = between + (1 - between) * 0.3145
    assert drawn.mean(axis=1).var() == pytest.approx(variance, rel=0.15)
    within = drawn - drawn.mean(axis=1, keepdims=True)
    assert within.var() == pytest.approx((1 - between) * (1 - 0.3145), abs=0.04)


def test_a_long_motion_changes_its_take_component_too():
    """Correlation at a lag t is exp(-t^2 / (4 take^2)): e^-1 after two takes."""
    state = simple(between=1.0, take=20.0)
    drawn = np.stack([state.draw(rng(k), 401, FPS, None)[0] for k in range(600)])
    for seconds in (10, 40, 80):
        at = round(seconds * FPS)
        pairs = np.corrcoef(drawn[:, 0], drawn[:, at])[0, 1]
        assert pairs == pytest.approx(np.exp(-((seconds / 40) ** 2)), abs=0.1)


def test_smoothness_within_a_take_is_that_of_each_channel():
    state = SlowState(np.zeros(2), 1.0, np.eye(2), np.zeros(2), np.array([1.5, 6.0]), 60.0)
    drawn = np.stack([state.draw(rng(k), 100, FPS, None) for k in range(600)])
    for channel, width in enumerate((1.5, 6.0)):
        for seconds in (1, 3, 8):
            pairs = np.corrcoef(drawn[:, channel, 0], drawn[:, channel, round(seconds * FPS)])
            expected = np.exp(-((seconds / width) ** 2) / 4)
            assert pairs[0, 1] == pytest.approx(expected, abs=0.1)


@pytest.mark.parametrize("r", [-0.7, 0.0, 0.6])
def test_channels_are_drawn_with_their_correlation(r):
    state = simple(mixing=np.linalg.cholesky([[1, r], [r, 1]]), between=0.5, width=1.5, take=5.0)
    drawn = np.concatenate([state.draw(rng(k), 200, FPS, None) for k in range(100)], axis=1)
    assert np.corrcoef(drawn)[0, 1] == pytest.approx(r, abs=0.06)
    np.testing.assert_allclose(drawn.std(axis=1), 1.0, atol=0.05)


@pytest.mark.parametrize("explained", [-0.5, 0.0, 0.4, 1.0])
def test_draws_follow_the_prediction_as_far_as_it_explains_them(explained):
    state = simple(explained=explained, between=0.3, width=1.5, take=10.0)
    predicted = gaussian_filter1d(np.random.default_rng(0).standard_normal(4000), 8)
    predicted = (predicted - predicted.mean()) / predicted.std()
    drawn = np.stack([state.draw(rng(k), 4000, FPS, predicted)[0] for k in range(12)])
    r = np.mean([np.corrcoef(own, predicted)[0, 1] for own in drawn])
    assert r == pytest.approx(explained, abs=0.06)
    assert drawn.std() == pytest.approx(1.0, abs=0.06)
    # Over many seeds, the mean is what speech says and no more.
    slope = np.polyfit(predicted, drawn.mean(axis=0), 1)[0]
    assert slope == pytest.approx(explained, abs=0.08)


@pytest.mark.parametrize("trust", [0.0, 0.5, 1.0])
def test_pauses_are_trusted_in_full_and_all_else_as_far_as_stated(trust):
    """Two sd below the mean, people rest whatever the take; above one sd below it, r counts as
    much as it is trusted; between them, the factor is linear. Nothing is trusted without r."""
    state = simple(explained=0.8, trust=trust, width=1.5, take=10.0)
    for level, share in ((2.0, 0.0), (0.5, 0.0), (-0.9, 0.0), (-1.5, 0.5), (-2.5, 1.0)):
        predicted = np.full(300, level)
        drawn = np.stack([state.draw(rng(k), 300, FPS, predicted)[0] for k in range(60)])
        r = 0.8 * (trust + (1 - trust) * share if trust else 0.0)
        assert drawn.mean() == pytest.approx(r * level, abs=0.1)
        assert drawn.std() == pytest.approx(np.sqrt(1 - r**2), abs=0.05)


def test_fit_and_draw_agree_on_a_process():
    """Parameters of takes that were drawn are found again by the fit."""
    truth = simple(
        between=0.4, width=4.0, take=1e4, mixing=np.linalg.cholesky([[1, 0.6], [0.6, 1]])
    )
    takes = [truth.draw(rng(k), 600, FPS, None) for k in range(60)]
    fit = SlowState.fit(takes, None, names(60), FPS)
    np.testing.assert_allclose(fit.between, 0.4, atol=0.11)
    np.testing.assert_allclose(fit.width, 4.0, rtol=0.25)
    assert (fit.mixing @ fit.mixing.T)[0, 1] == pytest.approx(0.6, abs=0.12)


@pytest.mark.parametrize("n_frames", [1, 7, 100])
def test_a_longer_motion_begins_like_a_shorter_one(n_frames):
    state = simple(between=0.4, width=3.0, take=30.0)
    long = state.draw(rng(3), 1000, FPS, None)
    np.testing.assert_allclose(state.draw(rng(3), n_frames, FPS, None), long[:, :n_frames])


def test_time_is_in_seconds_at_any_frame_rate():
    state = simple(between=0.4, width=3.0, take=30.0)
    slow, fast = (state.draw(rng(3), round(60 * fps), fps, None)[0] for fps in (5.0, 15.0))
    np.testing.assert_allclose(fast[1::3], slow, atol=1e-9)


def test_the_generator_decides_what_is_drawn():
    state = simple(between=0.4)
    first, again, other = (state.draw(rng(k), 50, FPS, None) for k in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.1
    # Components of a motion are drawn apart: neither is a copy of the other.
    parts = [replace(state, between=np.full(1, b), take=3.0) for b in (0.0, 1.0)]
    within, take = (part.draw(rng(1), 2000, FPS, None)[0] for part in parts)
    assert abs(np.corrcoef(within, take)[0, 1]) < 0.2


def bell(times: np.ndarray, middle: float, width: float, step: float) -> np.ndarray:
    """Return what one number of white noise at a point in time adds to smooth noise.

    A Gaussian at points `step` seconds apart, whose squares sum to 1, with lines between them.
    """
    grid = step * np.arange(-20, 2000)
    values = np.exp(-0.5 * ((grid - middle) / width) ** 2)
    values[np.abs(grid - middle) > 4 * width + step / 2] = 0
    return np.interp(times, grid, values / np.linalg.norm(values))


@pytest.mark.parametrize("n_frames", [100, 83])
def test_drawn_noise_is_white_noise_smoothed_by_a_gaussian(monkeypatch, n_frames):
    """One number of the first channel's noise is 1, in the middle, and all others are 0.

    There is one every quarter of a second, and of the noise between takes eight in a take.
    """
    state = SlowState(
        explained=np.zeros(2),
        trust=1.0,
        mixing=np.array([[1.0, 0.0], [0.6, 0.8]]),
        between=np.array([0.2, 0.5]),
        width=np.array([1.5, 2.4]),
        take=6.0,
    )
    counts = []

    def impulse(shape):
        white = np.zeros(shape)
        white[shape[0] // 2, 0] = 1.0
        counts.append(shape[0])
        return white

    drawn = rng(3)
    monkeypatch.setattr(
        np.random, "default_rng", lambda seed: SimpleNamespace(standard_normal=impulse)
    )
    found = state.draw(drawn, n_frames, FPS, None)
    times, seconds = (np.arange(n_frames) + 0.5) / FPS, n_frames / FPS
    middles = [step * ((np.ceil(seconds / step) + 1) // 2) for step in (0.75, 0.25)]
    for row, own, between, width in zip(found, (1, 0.6), (0.2, 0.5), (1.5, 2.4), strict=True):
        expected = np.sqrt(between) * bell(times, middles[0], 6.0, 0.75)
        expected += np.sqrt(1 - between) * bell(times, middles[1], width, 0.25)
        np.testing.assert_allclose(row, own * expected, atol=1e-9)


@pytest.mark.parametrize(("seed", "width", "step"), [(12345, 1.5, 0.25), (12344, 6.0, 0.75)])
def test_noise_without_end_is_white_noise_smoothed_by_a_gaussian(monkeypatch, seed, width, step):
    """A single number is 1, near the end of the first 256: that of a seed, or of the next one."""

    def blocks(key):
        def impulse(shape):
            white = np.zeros(shape)
            white[-3, 0] = key == (12345, 0)
            return white

        return SimpleNamespace(standard_normal=impulse)

    state = simple(between=0.36, width=1.5, take=6.0)
    monkeypatch.setattr(np.random, "default_rng", blocks)
    times = step / 5 * np.arange(5 * 260)
    found = np.array([state.at(seed, t, None)[0, 0] for t in times])
    middle = step * round(times[found.argmax()] / step)
    share = 0.6 if width == 6.0 else 0.8
    np.testing.assert_allclose(found, share * bell(times, middle, width, step), atol=1e-9)
    # The number is the 254th, and noise at 0 s has so many before it that no frame lacks any.
    assert 0 < middle < 254 * step - 4 * width
    again = state.at(seed, float(middle), 2.0)
    np.testing.assert_allclose(again, found.max())


def test_an_hour_is_drawn_in_a_moment():
    state = simple(between=0.4, mixing=np.eye(9), width=24.0, take=5.0)
    assert state.draw(rng(), 16_000, 4.4, None).shape == (9, 16_000)
