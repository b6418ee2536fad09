"""The slow state that is drawn: its fit to takes of a known process, and what is drawn from it."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy import stats
from scipy.ndimage import gaussian_filter1d

from gesturekit.multires.recall.slow_state import SlowState
from gesturekit.state import normal_scores, recorded_quantiles, recorded_values

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


def test_scores_of_recorded_values_are_those_values_again():
    """Skewed values come back from their scores, within a quantile of 1/200."""
    values = np.random.default_rng(0).gamma([[0.5], [3.0]], size=(2, 4000))
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


# A process of known parameters.


def simple(*, between=0.0, width=3.0, take=60.0, mixing=1.0, explained=0.0, trust=1.0) -> SlowState:
    """A process, of one channel by default."""
    mixing = np.atleast_2d(mixing).astype(float)
    every = [np.full(len(mixing), value, float) for value in (explained, between, width)]
    return SlowState(every[0], trust, mixing, every[1], every[2], take)


def names(count: int) -> list[str]:
    return [f"take {k}" for k in range(count)]


@pytest.mark.parametrize("seconds", [2.0, 6.0])
@pytest.mark.parametrize("between", [0.0, 0.5])
def test_width_and_share_between_takes_are_those_of_the_recordings(seconds, between):
    """40 takes of two minutes of noise smoothed by a Gaussian, each with a level of its own."""
    own, scores = np.random.default_rng(0), []
    for _ in range(40):
        smooth = gaussian_filter1d(own.standard_normal(800), seconds * FPS)[100:-100]
        smooth *= np.sqrt((1 - between) * 2 * np.sqrt(np.pi) * seconds * FPS)
        scores.append((smooth + np.sqrt(between) * own.standard_normal())[None])
    fit = SlowState.fit(scores, None, names(40), FPS)
    assert fit.between[0] == pytest.approx(between, abs=0.15)
    assert fit.width[0] == pytest.approx(seconds, rel=0.3)


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
    assert unheard.between[0] == pytest.approx(0.36, abs=0.15)
    halved = SlowState.fit(scores, SimpleNamespace(trust=0.5, slow=slow), names(count), FPS)
    assert unheard.between[0] + 0.1 < halved.between[0] < fit.between[0] - 0.1


@pytest.mark.parametrize("n_frames", [1, 20])
def test_short_and_still_recordings_give_a_process_too(n_frames):
    for scores in ([np.zeros((2, n_frames))] * 2, [np.random.default_rng(0).normal(size=(2, 1))]):
        fit = SlowState.fit(scores, None, names(len(scores)), FPS)
        drawn = fit.draw(rng(), 30, FPS, None)
        assert drawn.shape == (2, 30) and np.isfinite(drawn).all()
        assert (fit.between >= 0).all() and (fit.between <= 1).all() and fit.take > 0


# What is drawn.


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


@pytest.mark.parametrize("n_frames", [1, 7, 100])
def test_a_longer_motion_begins_like_a_shorter_one(n_frames):
    state = simple(between=0.4, width=3.0, take=30.0)
    long = state.draw(rng(3), 1000, FPS, None)
    np.testing.assert_allclose(state.draw(rng(3), n_frames, FPS, None), long[:, :n_frames])


def test_time_is_in_seconds_at_any_frame_rate():
    state = simple(between=0.4, width=3.0, take=30.0)
    slow, fast = (state.draw(rng(3), round(60 * fps), fps, None)[0] for fps in (5.0, 15.0))
    np.testing.assert_allclose(fast[1::3], slow, atol=1e-9)


def noise_of(state: SlowState, seed: int, times: np.ndarray, of: str) -> np.ndarray:
    """Return the noise (C, T) of a motion as a whole, or of a stream."""
    if of == "draw":
        whole = state.draw(rng(seed), round(times[-1] * FPS) + 1, FPS, None)
        return whole[:, np.round(times * FPS).astype(int)]
    return np.concatenate([state.at(seed, t, None) for t in times], axis=1)


@pytest.mark.parametrize("of", ["draw", "at"])
def test_draws_have_the_correlations_of_the_process(of):
    """Standard normal; exp(-t^2 / (4 width^2)) within takes, and as long as a take between them."""
    state = SlowState(
        np.zeros(2),
        1.0,
        np.linalg.cholesky([[1, 0.6], [0.6, 1]]),
        np.array([0.0, 0.5]),
        np.array([1.5, 6.0]),
        20.0,
    )
    lags = np.array([0, 1, 3, 8, 20])
    drawn = np.stack([noise_of(state, seed, 30 + lags, of) for seed in range(400)])
    np.testing.assert_allclose(drawn.std(axis=0), 1.0, atol=0.12)
    np.testing.assert_allclose(drawn.mean(axis=0), 0.0, atol=0.15)
    for k, lag in enumerate(lags):
        within = np.exp(-((lag / state.width) ** 2) / 4)
        take = np.exp(-((lag / 20.0) ** 2) / 4)
        expected = state.between * take + (1 - state.between) * within
        found = [np.corrcoef(drawn[:, c, 0], drawn[:, c, k])[0, 1] for c in (0, 1)]
        np.testing.assert_allclose(found, expected, atol=0.12)
    # Of the noise within takes; that between them is the second's. Smoothed by different Gaussians.
    shared = 0.6 * np.sqrt(0.5) * np.sqrt(2 * 1.5 * 6 / (1.5**2 + 6**2))
    assert np.corrcoef(drawn[:, 0, 0], drawn[:, 1, 0])[0, 1] == pytest.approx(shared, abs=0.1)
    single, again, other = (noise_of(state, seed, 30.0 + lags, of) for seed in (1, 1, 2))
    np.testing.assert_array_equal(single, again)
    assert np.abs(single - other).max() > 0.1


@pytest.mark.parametrize("between", [0.0, 1.0])
def test_noise_without_end_has_no_seam_between_its_blocks(between):
    """It is drawn in blocks of 64 s within takes, and of 256 eighths of a take between them."""
    state = simple(between=between, width=2.0, take=16.0)
    border = 64.0 if between == 0 else 512.0
    times = border + np.arange(-20, 20, 0.05)
    found = np.array([state.at(7, t, None)[0, 0] for t in times])
    steps = np.abs(np.diff(found))
    assert steps.max() < 4 * np.median(steps) + 0.02 and np.ptp(found) > 0.1
