import numpy as np
import pytest

import audio_features as af


def test_level_lengths_of_the_paper():
    # 250, 187.5, 140.6, 105.5, 79.1, 59.3, 44.5, 33.4, 25.0, 18.8
    assert af.level_lengths(250, 10) == [19, 25, 33, 44, 59, 79, 105, 141, 188, 250]
    assert af.level_lengths(3, 8)[0] == 1


SIZES = [(1, 1), (1, 6), (2, 3), (9, 4), (150, 6), (397, 10)]


@pytest.mark.parametrize(("n", "levels"), SIZES)
def test_the_residual_pyramid_is_inverted_exactly(n, levels):
    values = np.random.default_rng(n).standard_normal((n, 4)).astype(np.float32)
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


@pytest.mark.parametrize(("n", "levels"), SIZES)
def test_a_part_of_a_level_is_that_of_the_whole(n, levels):
    values = np.random.default_rng(n).standard_normal((n, 2))
    lengths = af.level_lengths(n, levels)
    for level, whole in enumerate(af.residual_pyramid(values, lengths)):
        plain = af.resample_frames(values, lengths[level])
        for part in ((0, 1), (0, lengths[level]), (lengths[level] // 3, lengths[level] // 2 + 1)):
            found = af.residual_level(values, lengths, level, *part)
            np.testing.assert_allclose(found, whole[slice(*part)], atol=1e-9)
            same = af.resample_frames(values, lengths[level], *part)
            np.testing.assert_array_equal(same, plain[slice(*part)])


def test_levels_of_other_factors_and_no_frames():
    # 81 / 3, 81 / 9; 10 / 999 rounds to 0, which is one frame.
    assert af.level_lengths(81, 3, factor=3) == [9, 27, 81]
    assert af.level_lengths(10, 2, factor=999) == [1, 10]
    assert af.level_lengths(1, 1) == [1]
    for arguments, says in (
        ((10, 0), "levels=0"),
        ((10, 2, 1000), "factor=1000"),
        ((10, 2, 0.5), "factor=0.5"),
    ):
        with pytest.raises(af.FeatureError, match=says):
            af.level_lengths(*arguments)
    with pytest.raises(af.FeatureError, match="40 frames"):
        af.residual_pyramid(np.zeros((40, 2)), [10, 30])
    same = np.arange(3.0)
    assert af.resample_frames(same, 3) is not same
