"""Patch metrics against their definitions, written out over all windows and all segmentations."""

import os
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gesturekit.errors import EvaluationError
from gesturekit.evaluation import (
    coverage,
    global_diversity,
    inter_diversity,
    intra_diversity,
    local_diversity,
    patch_features,
    patch_scores,
)
from gesturekit.motion.parts.body_size import body_scale


def window_distances(looked_up, among, window, variant):
    """Nearest distance of every window of `looked_up` to any of `among`."""
    last = len(looked_up) - window + (variant == "paper")  # published: the last is left out
    nearest = []
    for i in range(last):
        apart = []
        for j in range(len(among) - window + 1):
            difference = looked_up[i : i + window] - among[j : j + window]
            if variant == "paper":
                apart.append(np.sqrt((difference**2).sum()))
            else:
                apart.append(np.sqrt((difference**2).sum(axis=1)).mean())
        nearest.append(min(apart))
    return np.array(nearest)


def least_segmentation(generated, reference, shortest, variant):
    """Mean cost of the best segmentation, by trying them all; None where there is none."""

    @cache
    def piece(start, stop):
        costs = []
        for j in range(len(reference) - (stop - start) + 1):
            squares = ((generated[start:stop] - reference[j : j + stop - start]) ** 2).sum(axis=1)
            costs.append(squares.sum() if variant == "paper" else np.sqrt(squares).sum())
        return min(costs, default=np.inf)

    @cache
    def best(stop):
        if stop == 0:
            return 0.0
        starts = range(stop - shortest + 1)
        return min((best(start) + piece(start, stop) for start in starts), default=np.inf)

    total = best(len(generated))
    return total / len(generated) if np.isfinite(total) else None


@st.composite
def motions(draw):
    """Two arrays: unrelated, equal, pasted from each other, frozen, slow walks; far off or not."""
    n, m = draw(st.integers(1, 34)), draw(st.integers(1, 26))
    width = draw(st.integers(1, 5))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    kind = draw(st.sampled_from(["random", "equal", "pasted", "frozen", "walk"]))
    reference = rng.normal(size=(m, width))
    if kind == "walk":
        reference = np.cumsum(0.01 * reference, axis=0)
    if kind == "random" or kind == "walk":
        generated = rng.normal(size=(n, width)) * 10.0 ** draw(st.integers(-6, 1))
        generated = generated + reference[0]
    elif kind == "equal":
        generated = reference.copy()
    elif kind == "frozen":
        generated = np.tile(reference[0], (n, 1))
    else:
        cuts = [rng.integers(0, m, 2) for _ in range(6)]
        generated = np.concatenate([reference[min(c) : max(c) + 1] for c in cuts])[:n]
    offset = draw(st.sampled_from([0.0, 1.0, 1e3]))
    return generated + offset, reference + offset


def same(value):
    return pytest.approx(value, rel=1e-6, abs=1e-12)


@settings(max_examples=int(os.environ.get("GESTUREKIT_FUZZ", "30")), deadline=None)
@given(
    motions(), st.integers(1, 14), st.sampled_from(["ganimator", "paper"]), st.floats(0.05, 0.95)
)
def test_each_equals_its_definition(pair, window, variant, share):
    generated, reference = pair
    need = window + (variant == "ganimator")
    if len(generated) >= need and len(reference) >= window:
        expected = window_distances(generated, reference, window, variant).mean()
        assert local_diversity(generated, reference, window, variant=variant) == same(expected)
    if len(reference) >= need and len(generated) >= window:
        nearest = window_distances(reference, generated, window, variant)
        threshold = np.quantile(nearest, share) + 1e-3
        if np.abs(nearest - threshold).min() > 1e-9:  # else rounding decides
            expected = (nearest < threshold).mean()
            assert coverage(
                generated, reference, window, threshold, variant=variant
            ) == pytest.approx(expected)
    expected = least_segmentation(generated, reference, window, variant)
    if expected is None:
        with pytest.raises(EvaluationError, match="min_segment"):
            global_diversity(generated, reference, window, variant=variant)
    else:
        assert global_diversity(generated, reference, window, variant=variant) == same(expected)


def test_the_published_defaults():
    rng = np.random.default_rng(0)
    reference = np.cumsum(0.3 * rng.normal(size=(95, 8)), axis=0)
    generated = np.concatenate([reference[40:75], reference[5:70]])
    generated = generated + 0.4 * rng.normal(size=generated.shape)
    nearest = window_distances(reference, generated, 30, "ganimator")
    assert 0 < (nearest < 2.0).mean() < 1
    assert coverage(generated, reference) == pytest.approx((nearest < 2.0).mean())
    expected = window_distances(generated, reference, 15, "ganimator").mean()
    assert local_diversity(generated, reference) == same(expected)
    expected = least_segmentation(generated, reference, 30, "ganimator")
    assert global_diversity(generated, reference) == same(expected)
    scores = patch_scores(generated, reference)
    assert scores.coverage == coverage(generated, reference)
    assert scores.global_diversity == global_diversity(generated, reference)
    assert scores.local_diversity == local_diversity(generated, reference)


@pytest.mark.parametrize("variant", ["ganimator", "paper"])
def test_a_motion_covers_itself_and_adds_nothing(gesture, variant):
    features = patch_features(gesture(3.0), variant)
    assert coverage(features, features, threshold=1e-9, variant=variant) == 1.0
    assert global_diversity(features, features, variant=variant) == 0.0
    assert local_diversity(features, features, variant=variant) == 0.0
    assert inter_diversity([features, features]) == 0.0
    assert inter_diversity([features, features], variant="aligned") == 0.0
    assert intra_diversity(np.tile(features[:1], (40, 1))) == 0.0


def test_pasted_pieces_have_no_distance_but_shorter_ones_do():
    reference = np.random.default_rng(1).normal(size=(60, 4))
    pasted = np.concatenate([reference[20:50], reference[3:40]])  # 30 and 37 frames
    assert global_diversity(pasted, reference, 30) == 0.0
    assert global_diversity(pasted, reference, 31) > 0.05


def test_a_motion_shorter_than_two_segments_is_one():
    rng = np.random.default_rng(2)
    generated, reference = rng.normal(size=(59, 3)), rng.normal(size=(80, 3))
    whole = window_distances(np.concatenate([generated, generated[:1]]), reference, 59, "ganimator")
    assert global_diversity(generated, reference, 30) == same(whole[0])


def test_samples_are_compared_with_each_other():
    rng = np.random.default_rng(3)
    samples = [rng.normal(size=(25, 4)) for _ in range(3)]
    pairs = [(samples[0], samples[2]), (samples[1], samples[0]), (samples[2], samples[1])]
    expected = np.mean([window_distances(a, b, 15, "ganimator").mean() for a, b in pairs])
    assert inter_diversity(samples) == same(expected)
    expected = np.mean([np.linalg.norm(a - b) / 25 for a, b in pairs])
    assert inter_diversity(samples, variant="aligned") == same(expected)
    starts = range(10)
    expected = [
        np.linalg.norm(s[i : i + 15] - s[j : j + 15]) / 15
        for s in samples
        for i in starts
        for j in starts
    ]
    assert intra_diversity(samples) == same(np.mean(expected))


NAN = np.zeros((40, 3))
NAN[7, 1] = np.nan
OK = np.random.default_rng(5).normal(size=(40, 3))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: coverage(OK[:, :2], OK), "(?=.*generated)(?=.*reference)(?=.* 2).* 3"),
        (lambda: coverage(OK[0], OK), r"(?=.*generated).*\(3,\)"),
        (lambda: coverage(OK, NAN), "(?=.*reference)(?=.*NaN).*frame 7"),
        (lambda: coverage(OK, OK[:30]), r"(?=.*\b30\b).*\b29\b"),
        (lambda: coverage(OK, OK, variant="paper"), "threshold"),
        (lambda: coverage(OK, OK, variant="papre"), "(?=.*papre).*ganimator"),
        (lambda: local_diversity(OK, OK, 2.5), r"(?=.*window).*2\.5"),
        (lambda: local_diversity(OK[:15], OK), r"(?=.*\b15\b).*\b14\b"),
        (lambda: global_diversity(OK[:20], OK), r"(?=.*\b30\b).*\b20\b"),
        (lambda: coverage(np.ones((10**5, 1)), np.ones((10**5, 1))), r"\b80(\.0)? GB"),
        (lambda: inter_diversity([OK]), r"(?=.*1 sample).*\b2\b"),
        (lambda: intra_diversity([]), r"0 samples.*\b1\b"),
        (lambda: inter_diversity([OK, OK[:9]], variant="aligned"), r"(?=.*\b9\b).*\b40\b"),
    ],
)
def test_bad_input_gets_one_clear_error(call, message):
    with pytest.raises(EvaluationError, match=message):
        call()


def test_features_are_rotations_and_contacts(gesture, skeleton):
    motion = gesture(1.0)
    names = ["LeftArm", "Head"]
    matrices = np.stack(
        [Rotation.from_quat(motion.rotations[:, skeleton.index(n)]).as_matrix() for n in names], 1
    )
    assert patch_features(motion, "paper", joints=names) == pytest.approx(
        matrices.reshape(30, -1), abs=1e-9
    )
    # The 6D form: two columns of the matrix, one after the other or row by row.
    features = patch_features(motion, joints=names)[:, :12].reshape(30, 2, 6)
    by_columns = matrices[..., :2].swapaxes(-1, -2).reshape(30, 2, 6)
    by_rows = matrices[..., :2].reshape(30, 2, 6)
    assert np.allclose(features, by_columns) or np.allclose(features, by_rows)
    every = patch_features(motion, "paper", joints="all")
    assert every.shape == (30, 9 * skeleton.n_joints)
    # Where the body stands is left out; GANimator's frame 0 has no contact.
    moved = replace(motion, translation=motion.translation + 1.0)
    assert patch_features(moved) == pytest.approx(patch_features(motion))
    assert not patch_features(motion, joints=names)[0, 12:].any()
    # In contact below 0.54 m/s on the reference body.
    scale = body_scale(skeleton)
    still = replace(motion, rotations=np.repeat(motion.rotations[:1], 30, axis=0))
    for speed, label in ((0.45, 1.0), (0.65, 0.0)):
        glide = still.translation + np.outer(still.times, [speed * scale, 0, 0])
        found = patch_features(replace(still, translation=glide), joints=names)
        contacts = found[:, 12:].reshape(30, -1, 6)[1:, :, 0]
        assert (contacts == label).all(), speed
