"""Recall trusts speech as far as it predicts the movement of recordings that were left out."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d

from gesturekit.multires.recall.wanted import WantedMovement, slow_part

FPS = 25.0
EFFORT, ACOUSTIC = (0,), [(0, 1, 2)]


def recordings(predictable: bool, seed: int = 0):
    """Speech (12, T): effort, two acoustic features, nine of an encoder that say nothing; and
    movement (T,) that follows effort and the second column, or nothing."""
    rng = np.random.default_rng(seed)
    speeches, movements = [], []
    for n_frames in (700, 500):
        speech = gaussian_filter1d(rng.standard_normal((12, n_frames)), 4.0, axis=1) * 4.0
        speech[0] = slow_part(8.0 * rng.standard_normal(n_frames), FPS)
        followed = speech[1] + 2.0 * speech[0]
        alone = gaussian_filter1d(rng.standard_normal(n_frames), 4.0) * 4.0
        speeches.append(speech.astype(np.float32))
        movements.append(followed + 0.3 * alone if predictable else alone)
    return speeches, movements


def test_an_uninformative_encoder_is_replaced_by_acoustic_features():
    speeches, movements = recordings(predictable=True)
    fitted = WantedMovement.fit(speeches, movements, FPS, EFFORT, ACOUSTIC)
    alone = WantedMovement.fit([speech[:3] for speech in speeches], movements, FPS, EFFORT)
    other = recordings(predictable=True, seed=1)[0][0]
    np.testing.assert_allclose(fitted(other), alone(other[:3]))
    everything = WantedMovement.fit(speeches, movements, FPS, EFFORT)
    assert fitted.fast.r > everything.fast.r


def test_few_features_are_used_where_they_predict_as_well_as_many():
    """Column 2 of a stranger may be anything: it is not used, as column 1 says all there is."""
    speeches, movements = recordings(predictable=True)
    fitted = WantedMovement.fit(speeches, movements, FPS, EFFORT, [(0, 1, 2), (1,)])
    other = recordings(predictable=True, seed=1)[0][0]
    strange = other.copy()
    strange[2:] += 3.0 * gaussian_filter1d(np.random.default_rng(2).standard_normal(700), 4.0)
    np.testing.assert_array_equal(fitted(other), fitted(strange))
    # A set that says nothing is not used, however small.
    useless = WantedMovement.fit(speeches, movements, FPS, EFFORT, [(0, 1, 2), (2,)])
    assert useless.fast.r > 0.5 and useless.basis.shape == (11, 2)


def test_an_informative_encoder_is_used():
    speeches, movements = recordings(predictable=True)
    for speech in speeches:
        speech[[1, 5]] = speech[[5, 1]]
    fitted = WantedMovement.fit(speeches, movements, FPS, EFFORT, ACOUSTIC)
    assert fitted.basis is None and fitted.fast.r > 0.5


def test_uninformative_speech_is_distinguished_from_informative_speech():
    # Chance predicts left-out parts a little, so one seed says nothing.
    unrelated = (recordings(False, seed) for seed in range(8))
    by_chance = [WantedMovement.fit(*pairs, FPS, EFFORT, ACOUSTIC) for pairs in unrelated]
    assert abs(np.mean([fit.fast.r for fit in by_chance])) < 0.15
    assert max(fit.fast.trust for fit in by_chance) < 1.0
    informed = WantedMovement.fit(*recordings(True), FPS, EFFORT, ACOUSTIC)
    assert informed.predicts and informed.fast.trust == 1.0
