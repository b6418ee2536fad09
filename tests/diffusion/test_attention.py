"""Attention in blocks against attention as the formula says it."""

import math

import pytest
import torch

from gesturekit.diffusion import NetworkConfig
from gesturekit.diffusion.network import PositionBias, attend, bands
from gesturekit.training.seeds import rng_for


def bent_bias(config: NetworkConfig) -> PositionBias:
    bias = PositionBias(config)
    rng = rng_for("bias")
    with torch.no_grad():
        bias.amplitudes.copy_(torch.randn(bias.amplitudes.shape, generator=rng) * 3)
        bias.offsets.copy_(torch.randn(bias.offsets.shape, generator=rng) * 15)
        bias.widths.copy_(1 + 5 * torch.rand(bias.widths.shape, generator=rng))
        bias.floors.copy_(2 * torch.rand(bias.floors.shape, generator=rng) - 1)
    return bias


def explicit(bias: PositionBias, config: NetworkConfig, n_frames: int) -> torch.Tensor:
    """(H, T, T), the sum over kernels written out for every pair of frames, in float64."""
    t = torch.arange(n_frames, dtype=torch.float64)
    d = (t[:, None] - t)[None, None]
    shapes = (bias.amplitudes, bias.offsets, bias.widths)
    a, o, s = (p.detach().double()[:, :, None, None] for p in shapes)
    kernels = a.abs() * torch.sigmoid(a.sign() * (d - o) / s)
    score = torch.log(kernels.sum(1) + bias.floors.detach().abs()[:, None, None] + 1e-8)
    ends = (math.log10(view) for view in (config.nearest_view, config.farthest_view))
    views = torch.logspace(*ends, config.heads)
    slopes = 2 * 18.420680744 / views.double()
    return score - slopes[:, None, None] * d[0].abs()


def test_slopes_are_those_of_the_published_sizes():
    slopes = PositionBias(NetworkConfig()).slopes
    published = [7.37, 5.00, 3.40, 2.31, 1.57, 1.06, 0.72, 0.49]
    assert slopes.tolist() == pytest.approx(published, abs=0.006)
    # Views of 5, 7.4, 10.8, 16.0, 23.5, 34.6, 50.9 and 75 frames.
    assert PositionBias(NetworkConfig()).reaches == [5, 8, 11, 16, 24, 35, 51, 75]
    assert PositionBias(NetworkConfig(heads=1, channels=8)).reaches == [5]
    assert not slopes.requires_grad


def test_the_bias_starts_as_in_the_released_code():
    """Amplitudes are drawn from N(0, 0.01), offsets from N(0, 15); widths are 5 and floors 1."""
    torch.manual_seed(0)
    bias = PositionBias(NetworkConfig(channels=512, heads=64, kernels=200))
    for values, spread in ((bias.amplitudes.detach(), 0.01), (bias.offsets.detach(), 15.0)):
        assert float(values.std()) == pytest.approx(spread, rel=0.05)
        assert abs(float(values.mean())) < 0.05 * spread
    assert (bias.widths == 5).all() and (bias.floors == 1).all()


@pytest.mark.parametrize("fused", [False, True])
def test_blocks_equal_the_full_computation(fused):
    config, n_frames = NetworkConfig(kernels=4), 300
    bias = bent_bias(config)
    rng = rng_for("qkv")
    q, k, v = torch.randn(3, 1, 8, n_frames, 32, generator=rng) * 2
    scores = q.double() @ k.double().transpose(-1, -2) / math.sqrt(32)
    exact = torch.softmax(scores + explicit(bias, config, n_frames), -1) @ v.double()
    with torch.no_grad():
        made = bands(bias, n_frames)
        assert len(made) > 1 and all(len(blocks) > 1 for _, blocks in made)
        ours = attend(q, k, v, made, 0.0, fused=fused)
    torch.testing.assert_close(ours.double(), exact, atol=1e-5, rtol=1e-5)
