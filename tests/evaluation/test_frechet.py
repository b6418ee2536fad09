"""Fréchet distances against closed forms and the formula with a matrix root."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import sqrtm

from gesturekit.errors import EvaluationError
from gesturekit.evaluation import fid_k, frechet_distance, frechet_result, raw_fgd


def test_small_cases_by_hand():
    # Means 0 and 2, variances 2 and 8 (divided by n - 1): 2² + 2 + 8 - 2 √(2 · 8) = 6.
    assert frechet_distance([[-1.0], [1.0]], [[0.0], [4.0]]) == pytest.approx(6.0)
    # Each varies along an axis of its own: nothing overlaps, 2 + 8 remain, and |(0, 0) - (1, 0)|².
    ours, theirs = [[-1.0, 0.0], [1.0, 0.0]], [[1.0, -2.0], [1.0, 2.0]]
    assert frechet_distance(ours, theirs) == pytest.approx(11.0)


def test_the_textbook_formula_where_it_can_be_computed():
    rng = np.random.default_rng(0)
    ours = rng.normal(size=(90, 12)) @ rng.normal(size=(12, 12))
    theirs = rng.normal(size=(70, 12)) @ rng.normal(size=(12, 12)) + rng.normal(size=12)
    covariances = np.cov(ours, rowvar=False), np.cov(theirs, rowvar=False)
    root = sqrtm(covariances[0] @ covariances[1]).real
    apart = ours.mean(axis=0) - theirs.mean(axis=0)
    expected = apart @ apart + np.trace(covariances[0] + covariances[1] - 2 * root)
    assert frechet_distance(ours, theirs) == pytest.approx(expected, rel=1e-9)


def test_fewer_samples_than_dimensions():
    rng = np.random.default_rng(1)
    few, others = rng.normal(size=(5, 3)), rng.normal(size=(9, 3))
    # Turned into 200 dimensions, which changes no distance.
    turn = np.linalg.qr(rng.normal(size=(200, 3)))[0].T
    expected = frechet_distance(few, others)
    assert frechet_distance(few @ turn, others @ turn) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("shape", [(400, 32), (20, 300), (2, 1)])
def test_equal_samples_have_distance_zero(shape):
    features = 1e3 + 50 * np.random.default_rng(2).normal(size=shape)
    assert 0 <= frechet_distance(features, features[::-1]) < 1e-12 * features.var(axis=0).sum()


def motions_of(rng, n_motions, each, shift=0.0):
    """Features of motions that differ from each other more than their own windows do."""
    return [shift + rng.normal(size=4) + 0.5 * rng.normal(size=(each, 4)) for _ in range(n_motions)]


def test_the_confidence_interval_narrows_with_more_clips():
    rng = np.random.default_rng(3)
    reference = motions_of(rng, 60, 5)
    many = frechet_result(motions_of(rng, 60, 5, 1.0), reference)
    few = frechet_result(motions_of(rng, 12, 5, 1.0), reference[:12])
    assert many.low < many.value < many.high and few.low < few.value < few.high
    assert many.high - many.low < few.high - few.low
    # Most of further pairs of sets lie in it (they vary as much as these do).
    again = [
        frechet_result(motions_of(rng, 60, 5, 1.0), motions_of(rng, 60, 5), resamples=0).value
        for _ in range(30)
    ]
    assert np.mean([many.low < value < many.high for value in again]) > 0.6
    assert (many.n_generated, many.n_reference, many.dimensions) == (300, 300, 4)
    assert frechet_result(reference, reference[::-1], seed=5) == frechet_result(
        reference, reference[::-1], seed=5
    )


def test_small_samples_are_reported():
    rng = np.random.default_rng(4)
    enough = frechet_result(motions_of(rng, 20, 5), motions_of(rng, 20, 5))
    assert enough.note == "" and "[" in str(enough)
    few = frechet_result(motions_of(rng, 3, 9), motions_of(rng, 30, 9), resamples=20)
    assert "fewer than 40 samples" in few.note and "fewer than 10 motions" in few.note
    assert "fewer than 40 samples" in str(few) and np.isnan(few.low)
    plain = frechet_result(motions_of(rng, 3, 9), motions_of(rng, 30, 9), resamples=0)
    assert np.isnan(plain.low) and "motions" not in plain.note and "[" not in str(plain)


def test_many_dimensions_have_an_interval_too():
    rng = np.random.default_rng(5)
    sets = [[rng.normal(size=(4, 400)) for _ in range(10)] for _ in range(2)]
    result = frechet_result(*sets, resamples=5)
    assert 0 < result.low < result.value < result.high


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: frechet_distance([[1.0, 2.0]], np.ones((3, 2))), "generated: 1 sample"),
        (lambda: frechet_distance(np.ones((3, 2)), np.ones((3, 3))), "2 numbers a feature"),
        (lambda: frechet_distance(np.ones(3), np.ones((3, 3))), r"shape \(3,\)"),
        (lambda: frechet_distance(np.full((3, 2), np.nan), np.ones((3, 2))), "NaN .* sample 0"),
        (lambda: frechet_result([], [np.ones((3, 2))]), "one is empty"),
        (lambda: frechet_result([np.ones((3, 2)), np.ones((3, 1))], []), "one is empty"),
        (
            lambda: frechet_result([np.ones((3, 2)), np.ones((3, 1))], [np.ones((3, 2))]),
            "do not fit",
        ),
    ],
)
def test_bad_input_gets_one_clear_error(call, message):
    with pytest.raises(EvaluationError, match=message):
        call()


def test_sets_of_motions_that_cannot_be_compared(gesture):
    motion = gesture(5.0)
    with pytest.raises(EvaluationError, match="none of 1 motions is as long as a clip of 10 s"):
        fid_k([motion], [motion])
    with pytest.raises(EvaluationError, match="set of motions is empty"):
        fid_k([], [motion])
    with pytest.raises(EvaluationError, match="none of 1 motions is as long as a window of 2 s"):
        raw_fgd([motion.slice(0, 59)], [motion])
    with pytest.raises(EvaluationError, match="no motion to learn poses from"):
        raw_fgd([motion], [])


def test_wide_windows_are_bounded_from_below_and_close(gesture):
    from gesturekit.evaluation import PoseWindows

    reference = [gesture(40.0, 30.0, seed=i) for i in range(12)]
    generated = [gesture(40.0, 30.0, seed=20 + i) for i in range(12)]
    windows = PoseWindows.fit(reference)
    assert windows.n_frames * windows.n_features > 1500
    found = raw_fgd(generated, reference, windows)
    exact = frechet_distance(
        *(
            np.concatenate([clip.reshape(len(clip), -1) for clip in windows.cut(motions)])
            for motions in (generated, reference)
        )
    )
    assert 0.9 * exact < found.value <= exact * (1 + 1e-9)
    assert "lower bound" in found.note and found.dimensions > 1500
    assert raw_fgd(reference, reference, windows).value == pytest.approx(0.0, abs=1e-9 * exact)
