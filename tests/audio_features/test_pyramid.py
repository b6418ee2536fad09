from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import audio_features as af


def test_level_lengths_of_the_paper():
    # 250, 187.5, 140.6, 105.5, 79.1, 59.3, 44.5, 33.4, 25.0, 18.8
    assert af.level_lengths(250, 10) == [19, 25, 33, 44, 59, 79, 105, 141, 188, 250]
    assert af.level_lengths(3, 8)[0] == 1


@given(n=st.integers(1, 5_000), levels=st.integers(1, 14))
def test_level_lengths_never_fall_and_end_at_the_full_rate(n, levels):
    lengths = af.level_lengths(n, levels)
    assert len(lengths) == levels and lengths[-1] == n and lengths[0] >= 1
    assert lengths == sorted(lengths)


@given(n_in=st.integers(1, 300), n_out=st.integers(1, 300))
def test_interpolation_is_torchs_linear_without_aligned_corners(n_in, n_out):
    values = np.random.default_rng(n_in).standard_normal((n_in, 3))
    given, how = torch.from_numpy(values.T.copy())[None], {"mode": "linear", "align_corners": False}
    expected = torch.nn.functional.interpolate(given, size=n_out, **how)[0].numpy()
    np.testing.assert_allclose(af.resample_frames(values, n_out), expected.T, atol=1e-10)


@given(n=st.integers(1, 400), levels=st.integers(1, 10), seed=st.integers(0, 100))
def test_the_residual_pyramid_is_inverted_exactly(n, levels, seed):
    values = np.random.default_rng(seed).standard_normal((n, 4)).astype(np.float32)
    lengths = af.level_lengths(n, levels)
    pyramid = af.residual_pyramid(values, lengths)
    assert [len(level) for level in pyramid] == lengths
    rebuilt = af.from_residual_pyramid(pyramid)
    assert rebuilt.dtype == np.float32
    np.testing.assert_allclose(rebuilt, values, atol=1e-6)


def test_the_sign_of_residuals_is_the_papers():
    """s_2 is the upsampled coarse level, 2 4 8 10, less the fine one."""
    coarse, residual = af.residual_pyramid(np.array([[0.0], [4.0], [8.0], [12.0]]), [2, 4])
    np.testing.assert_allclose(coarse[:, 0], [2, 10])
    np.testing.assert_allclose(residual[:, 0], [2, 0, 0, -2], atol=1e-12)


def test_wrong_lengths_are_refused():
    with pytest.raises(af.FeatureError, match="40 frames"):
        af.residual_pyramid(np.zeros((40, 2)), [10, 30])
    with pytest.raises(af.FeatureError, match="n_frames=0"):
        af.level_lengths(0, 3)
    with pytest.raises(af.FeatureError, match="factor"):
        af.level_lengths(10, 3, factor=1.0)
    with pytest.raises(af.FeatureError, match="empty"):
        af.from_residual_pyramid([])
