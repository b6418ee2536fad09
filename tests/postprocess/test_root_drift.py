"""Root drift of made-up foot paths, worked out by hand."""

import numpy as np
import pytest

from gesturekit.postprocess.foot_lock import horizontal_drift

FPS = 50.0
N = 501
TIMES = np.arange(N) / FPS


def slides(x: float, z: float, rise: float = 0.0) -> np.ndarray:
    """(T, 3) positions of a foot that slides steadily, m/s, from somewhere."""
    return [0.1, 0.05, -0.2] + TIMES[:, None] * [x, rise, z]


def stand(left: bool = True, right: bool = True) -> np.ndarray:
    return np.tile([left, right], (N, 1))


@pytest.mark.parametrize(
    ("left", "right", "common"),
    [
        ((0.1, 0.05), (0.1, 0.05), (0.1, 0.05)),
        ((0.04, 0.03), (0.12, 0.09), (0.04, 0.03)),  # along one line, the slower
        ((0.1, 0.0), (-0.1, 0.0), (0.0, 0.0)),
        ((0.1, 0.0), (-0.04, 0.0), (0.0, 0.0)),
        ((0.1, 0.0), (0.0, 0.1), (0.05, 0.05)),  # along the mean, the projection of either
        ((0.2, 0.0), (0.0, 0.1), (0.04, 0.02)),  # 0.1 / sqrt(5) along (2, 1) / sqrt(5)
    ],
)
def test_standing_feet_share_the_slide_that_both_make(left, right, common):
    found = horizontal_drift(slides(*left), slides(*right), stand(), FPS)
    expected = TIMES[:, None] * [common[0], 0, common[1]]
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert not found[0].any()


@pytest.mark.parametrize(("hertz", "least", "most"), [(0.1, 0.6, 1.0), (0.5, 0.0, 0.05)])
def test_slow_drift_is_kept_and_sway_is_not(hertz, least, most):
    times = np.arange(2001) / FPS
    foot = np.zeros((2001, 3))
    foot[:, 2] = 0.05 * np.sin(2 * np.pi * hertz * times)
    drift = horizontal_drift(foot, foot, np.ones((2001, 2), dtype=bool), FPS)[:, 2]
    inner = np.s_[500:1500]
    assert least < np.ptp(drift[inner]) / 0.1 < most
    assert np.corrcoef(drift[inner], foot[inner, 2])[0, 1] > 0.99 or hertz > 0.1, "without delay"
