"""Recall trusts speech as far as it predicts the movement of recordings that were left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter1d

from gesturekit.multires.recall.parts import slow_part
from gesturekit.multires.recall.slow_state import SlowState
from gesturekit.multires.recall.wanted import _MEAN_COUNTS, _WITHIN_TAKE, WantedMovement

FPS = 25.0
EFFORT, ACOUSTIC = (0,), [(0, 1, 2)]


# Which features are used.


def recordings(predictable: bool, seed: int = 0):
    """Speech (12, T): effort, two acoustic features, nine of an encoder that say nothing; and
    movement (T,) that follows effort and the second column, or nothing, with its slow part."""
    rng = np.random.default_rng(seed)
    speeches, movements = [], []
    for n_frames in (700, 500):
        speech = gaussian_filter1d(rng.standard_normal((12, n_frames)), 4.0, axis=1) * 4.0
        speech[0] = slow_part(8.0 * rng.standard_normal(n_frames), FPS)
        followed = speech[1] + 2.0 * speech[0]
        alone = gaussian_filter1d(rng.standard_normal(n_frames), 4.0) * 4.0
        speeches.append(speech.astype(np.float32))
        movements.append(followed + 0.3 * alone if predictable else alone)
    return speeches, movements, [slow_part(movement, FPS) for movement in movements]


def test_an_uninformative_encoder_is_replaced_by_acoustic_features():
    speeches, *moved = recordings(predictable=True)
    fitted = WantedMovement.fit(speeches, *moved, FPS, EFFORT, ACOUSTIC)
    alone = WantedMovement.fit([speech[:3] for speech in speeches], *moved, FPS, EFFORT)
    other = recordings(predictable=True, seed=1)[0][0]
    np.testing.assert_allclose(fitted(other), alone(other[:3]))
    everything = WantedMovement.fit(speeches, *moved, FPS, EFFORT)
    assert fitted.fast.r > everything.fast.r


def test_few_features_are_used_where_they_predict_as_well_as_many():
    """Column 2 of a stranger may be anything: it is not used, as column 1 says all there is."""
    speeches, *moved = recordings(predictable=True)
    fitted = WantedMovement.fit(speeches, *moved, FPS, EFFORT, [(0, 1, 2), (1,)])
    other = recordings(predictable=True, seed=1)[0][0]
    strange = other.copy()
    strange[2:] += 3.0 * gaussian_filter1d(np.random.default_rng(2).standard_normal(700), 4.0)
    np.testing.assert_array_equal(fitted(other)[0], fitted(strange)[0])
    # A set that says nothing is not used, however small.
    useless = WantedMovement.fit(speeches, *moved, FPS, EFFORT, [(0, 1, 2), (2,)])
    assert useless.fast.r > 0.5 and useless.fast_basis.shape == (12, 2)


def test_slow_movement_is_predicted_from_effort_alone_where_it_says_all():
    """The fast part follows another feature, which a change of microphone may spoil."""
    speeches, movements, _ = recordings(predictable=True)
    slow = [speech[0].astype(float) for speech in speeches]
    fitted = WantedMovement.fit(speeches, movements, slow, FPS, EFFORT, ACOUSTIC)
    other = recordings(predictable=True, seed=1)[0][0]
    strange = other.copy()
    strange[1:] += 3.0
    np.testing.assert_array_equal(fitted(other)[1], fitted(strange)[1])
    assert np.corrcoef(fitted(other)[1], slow_part(other[0], FPS))[0, 1] > 0.9


def test_an_informative_encoder_is_used():
    speeches, *moved = recordings(predictable=True)
    for speech in speeches:
        speech[[1, 5]] = speech[[5, 1]]
    fitted = WantedMovement.fit(speeches, *moved, FPS, EFFORT, ACOUSTIC)
    assert fitted.fast_basis.shape == (12, 11) and fitted.fast.r > 0.5


def test_uninformative_speech_is_distinguished_from_informative_speech():
    # Chance predicts left-out parts a little, so one seed says nothing.
    unrelated = (recordings(False, seed) for seed in range(8))
    by_chance = [WantedMovement.fit(*pairs, FPS, EFFORT, ACOUSTIC) for pairs in unrelated]
    assert abs(np.mean([fit.fast.r for fit in by_chance])) < 0.15
    informed = WantedMovement.fit(*recordings(True), FPS, EFFORT, ACOUSTIC)
    shares = [fit.spread / np.std(recordings(False)[1][0]) for fit in by_chance]
    assert np.mean(shares) < 0.15 and informed.predicts
    assert informed.spread > 0.8 * np.std(recordings(True)[0][0][1])


# How far it is trusted: takes that were left out, and takes that nobody has heard.


def takes(
    count: int,
    seed: int,
    *,
    r_fast: float = 0.6,
    r_slow: float = 0.6,
    meaning: float = 1.0,
    seconds: float = 60.0,
):
    """Return speeches (3, T), movements (T,) and slow parts (T,) of takes, in log m/s and sd.

    Fast movement has the correlation `r_fast` with column 1. Slow movement has `r_slow` with vocal
    effort, column 0, in a take. Takes have offsets of effort too: movement follows them as it does
    within a take times `meaning`.
    """
    rng = np.random.default_rng(seed)
    n = round(seconds * FPS)

    def curve(width: float) -> np.ndarray:
        smooth = gaussian_filter1d(rng.standard_normal(n), width * FPS, mode="wrap")
        return smooth / np.sqrt(1 / (2 * width * FPS * np.sqrt(np.pi)))

    def fast() -> np.ndarray:
        own = curve(0.15)
        return own - slow_part(own, FPS)

    def mixed(r: float, own: np.ndarray, other: np.ndarray) -> np.ndarray:
        return r * own + np.sqrt(1 - r**2) * other

    speeches, movements, slows = [], [], []
    for _ in range(count):
        energy, effort, offset = fast(), curve(3.0), rng.standard_normal()
        slow = mixed(r_slow, effort, curve(3.0)) + meaning * r_slow * offset
        noise = 0.1 * rng.standard_normal((3, n))
        speeches.append(np.stack([effort + offset, energy, noise[2]]) + noise)
        movements.append(-1.0 + 0.4 * slow + 0.3 * mixed(r_fast, energy, fast()))
        slows.append(slow / np.hypot(1, meaning * r_slow))
    return speeches, movements, slows


def names(count: int) -> list[str]:
    return [f"take {k}" for k in range(count)]


def fit(count: int, seed: int = 0, *, of=None, **truth) -> WantedMovement:
    """Fit to takes; `of` are the take of each recording, by default takes of their own."""
    pairs = takes(count, seed, **truth)
    return WantedMovement.fit(*pairs, FPS, EFFORT, takes=names(count) if of is None else of)


def slope(x, y) -> float:
    """Return the slope of the least-squares line through all curves together."""
    return float(np.polyfit(np.concatenate(x), np.concatenate(y), 1)[0])


@pytest.mark.parametrize("r", [0.25, 0.6, 0.95])
def test_predictions_of_fast_movement_are_conditional_means_on_unseen_takes(r):
    """Recorded movement is on average as large as its prediction, however weak that is."""
    wanted = fit(12, r_fast=r)
    assert wanted.fast.r == pytest.approx(r, abs=0.06)
    speeches, movements, _ = takes(12, 1, r_fast=r)
    fast = [movement - slow_part(movement, FPS) for movement in movements]
    predicted = [wanted(speech)[0] for speech in speeches]
    assert slope(predicted, fast) == pytest.approx(1.0, abs=0.12)
    # The recorded fast movement has a standard deviation of some 0.29: a mean varies less.
    recorded = np.concatenate(fast).std()
    assert np.concatenate(predicted).std() == pytest.approx(r * recorded, rel=0.15)


@pytest.mark.parametrize(("r", "meaning"), [(0.3, 1.0), (0.7, 1.0), (0.7, 0.0)])
def test_predictions_of_slow_movement_are_conditional_means_on_unseen_takes(r, meaning):
    slopes, truth = [], {"r_slow": r, "meaning": meaning}
    for seed in range(3):
        pairs = takes(24, seed, **truth)
        wanted = WantedMovement.fit(*pairs, FPS, EFFORT, takes=names(24))
        scores = [slow[None] for slow in pairs[2]]
        share = wanted.trust * SlowState.fit(scores, wanted, names(24), FPS).explained[0]
        speeches, _, slows = takes(24, 100 + seed, **truth)
        slopes.append(slope([share * wanted(speech)[1] for speech in speeches], slows))
    assert np.mean(slopes) == pytest.approx(1.0, abs=0.2)


def test_three_takes_are_trusted_and_two_are_trusted_less():
    """A correlation within takes is no promise: mood, day and voice do not change in it."""
    three, two, one = fit(3), fit(2), fit(6, of=["one"] * 6)
    assert three.across_takes and not two.across_takes and not one.across_takes
    assert (three.trust, two.trust, one.trust) == (1.0, _WITHIN_TAKE, _WITHIN_TAKE)
    assert 0 < _WITHIN_TAKE < 1
    pairs = takes(6, 0)
    scores = [slow[None] for slow in pairs[2]]
    for of, factor in ((names(6), 1.0), (["one"] * 6, _WITHIN_TAKE)):
        wanted = WantedMovement.fit(*pairs, FPS, EFFORT, takes=of)
        state = SlowState.fit(scores, wanted, of, FPS)
        size = np.concatenate(pairs[2]).std()
        assert state.explained[0] == pytest.approx(wanted.slow.r * size, rel=0.05)
        assert state.trust == factor


@pytest.mark.parametrize(("meaning", "counted"), [(0.0, (0.0, 0.3)), (1.0, (0.75, 1.0))])
def test_an_offset_of_all_speech_counts_as_it_did_on_left_out_takes(meaning, counted):
    """Another microphone shifts the effort of a whole utterance, which may say nothing."""
    wanted = fit(30, 4, meaning=meaning)
    speech = takes(1, 5, meaning=meaning)[0][0]
    speech[0] -= speech[0].mean()
    other = speech.copy()
    other[0] += 0.7

    def moved(wanted: WantedMovement) -> np.ndarray:
        return wanted(other)[1] - wanted(speech)[1]

    whole = moved(replace(wanted, mean_counts=1.0)).mean()
    lowest, highest = counted
    assert whole > 0.3 and lowest < moved(wanted).mean() / whole < highest
    # All frames are shifted alike: calm and lively stretches stay what they are.
    assert moved(wanted).std() < 0.1 * whole
    change, every = (of(speech)[1] for of in (wanted, replace(wanted, mean_counts=1.0)))
    np.testing.assert_allclose(change - change.mean(), every - every.mean(), atol=1e-9)


def test_fast_movement_does_not_depend_on_the_level_of_speech():
    """Another level of the features, or a slow change of it, says nothing of when hands move."""
    wanted, speech = fit(8), takes(1, 5, seconds=240.0)[0][0]
    drift = 3.0 + np.sin(np.arange(speech.shape[1]) / speech.shape[1])
    np.testing.assert_allclose(wanted(speech + 3.0)[0], wanted(speech)[0], atol=1e-9)
    np.testing.assert_allclose(wanted(speech + drift)[0], wanted(speech)[0], atol=0.01)


@pytest.mark.parametrize("count", [1, 2])
def test_an_offset_counts_a_stated_share_where_no_take_was_left_out(count):
    for meaning in (0.0, 1.0):
        wanted = fit(count, 4, meaning=meaning)
        speech = takes(1, 5)[0][0]
        speech[0] -= speech[0].mean()
        both = [wanted(speech + shift * np.eye(3)[:, :1])[1].mean() for shift in (0.0, 0.3)]
        whole = replace(wanted, mean_counts=1.0)
        every = [whole(speech + shift * np.eye(3)[:, :1])[1].mean() for shift in (0.0, 0.3)]
        assert (both[1] - both[0]) / (every[1] - every[0]) == pytest.approx(_MEAN_COUNTS, abs=0.01)


def contradicting():
    """Four takes; in each, movement follows speech as it does not in most others."""
    speeches, movements, slows = takes(4, 6, r_fast=1.0, r_slow=1.0, meaning=0.0)
    sides = (1, 1, -1, -1)
    movements = [side * movement for side, movement in zip(sides, movements, strict=True)]
    return speeches, movements, [side * slow for side, slow in zip(sides, slows, strict=True)]


def test_what_was_wrong_on_left_out_takes_enters_nothing():
    pairs = contradicting()
    wanted = WantedMovement.fit(*pairs, FPS, EFFORT, takes=names(4))
    assert wanted.fast.r < -0.5 and wanted.slow.r < 0
    assert wanted.trust == 0.0 and not wanted.predicts
    state = SlowState.fit([slow[None] for slow in pairs[2]], wanted, names(4), FPS)
    drawn, blind = (
        state.draw(torch.Generator().manual_seed(0), 100, FPS, predicted)
        for predicted in (np.linspace(-2.5, 2.5, 100), None)
    )
    np.testing.assert_array_equal(drawn, blind)
    for speech in takes(3, 7)[0]:
        np.testing.assert_array_equal(wanted(speech)[0], 0.0)


def test_one_part_may_be_predicted_without_the_other():
    calm = fit(8, r_fast=0.0)
    restless = fit(8, 1, r_slow=0.0)
    assert abs(calm.fast.r) < 0.1 < 0.4 < calm.slow.r and calm.predicts
    assert restless.slow.r < 0.3 and restless.fast.r > 0.5 and restless.predicts


def test_the_summary_says_how_the_correlations_were_found():
    left_out, within = fit(5), fit(2)
    fast, slow = (f"r = {part.r:.2f}" for part in (left_out.fast, left_out.slow))
    said = left_out.summary()
    assert said.startswith("when the hands move, " + fast) and "calm or lively, " + slow in said
    assert said.endswith("found on left-out takes") and "taken as" not in said
    said = within.summary()
    assert said.endswith("found on left-out parts of recordings")
    assert f"r = {within.slow.r:.2f}" in said
    assert f"(taken as {_WITHIN_TAKE * within.slow.r:.2f} on other takes)" in said


def test_the_summary_states_no_negative_zero():
    within = fit(2)
    assert "(taken as 0.00 on" in replace(within, slow=replace(within.slow, r=-0.4)).summary()
