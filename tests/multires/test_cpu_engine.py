"""The CPU engine: the same numbers as dense convolutions and autograd."""

import copy

import numpy as np
import pytest
import torch

from gesturekit.motion import Motion
from gesturekit.multires import (
    LevelDiscriminator,
    LossConfig,
    MultiresRepresentation,
    NetworkConfig,
)
from gesturekit.multires.networks import (
    SkeletonConv1d,
    TorchBackend,
    block_neighbours,
    convolve_dense,
)

engine = pytest.importorskip("gesturekit.multires.cpu.engine", reason="the CPU engine is absent")

NUMBA, TORCH = engine.NumbaBackend("test"), TorchBackend("test")


def convolve(conv, x):
    return NUMBA.convolve([conv], x, 1.0, 1.0)


@pytest.fixture
def representation(skeleton):
    rng = np.random.default_rng(0)
    turns = rng.normal(0, 0.1, (4, skeleton.n_joints, 4)) + [0.0, 0.0, 0.0, 1.0]
    return MultiresRepresentation.fit([Motion(skeleton, turns, np.zeros((4, 3)), 25)], "all")


def close(one, other, relative):
    return float((one - other).detach().norm()) <= relative * float(other.detach().norm()) + 1e-12


@pytest.mark.parametrize("n_frames", [3, 31])
@pytest.mark.parametrize("kernel", [1, 3, 5])
def test_layer_and_gradients_agree_with_dense_convolution(representation, n_frames, kernel):
    torch.manual_seed(0)
    near = block_neighbours(representation, 2)
    near[0, 5:9] = True  # not symmetric
    conv = SkeletonConv1d(near, representation.block_sizes, (3,) * len(near), kernel)
    x = torch.randn(2, conv.shape[1], n_frames, requires_grad=True)
    wanted = torch.randn(2, conv.shape[0], n_frames)
    made, dense = convolve(conv, x), conv(x)
    assert close(made, dense, 1e-5)
    inputs = (x, conv.weight, conv.bias)
    gradients = (torch.autograd.grad(out, inputs, wanted) for out in (made, dense))
    for ours, theirs in zip(*gradients, strict=True):
        assert close(ours, theirs, 1e-5)
    with torch.no_grad():
        conv.weight.mul_(2)
    assert close(convolve(conv, x), conv(x), 1e-5)


@pytest.mark.parametrize(
    ("wanted", "last_slope"),
    [((0,), 1.0), ((0, 1, 2, 3, 4, 5, 6), 0.4), ((1, 6), 1.0), ((2, 3), 0.4), ((4,), 1.0)],
)
def test_gradients_of_a_chain_are_those_of_dense_convolutions(representation, last_slope, wanted):
    """First and second derivatives by the input (0), weights (1, 3, 5) and biases (2, 4, 6)."""
    torch.manual_seed(0)
    near = block_neighbours(representation, 2)
    sizes = [representation.block_sizes, *((n,) * len(near) for n in (3, 2, 4))]
    layers = [SkeletonConv1d(near, *sizes[i : i + 2], kernel=3) for i in range(3)]
    x = torch.randn(2, layers[0].shape[1], 12)
    every = [x, *(part for layer in layers for part in (layer.weight, layer.bias))]
    for number, part in enumerate(every):
        part.requires_grad_(number in wanted)
    inputs = [every[number] for number in wanted]
    found = []
    for convolve in (NUMBA.convolve, convolve_dense):
        made = convolve(layers, x, 0.2, last_slope)
        plain = torch.autograd.grad(made.square().sum(), inputs, retain_graph=True)
        graph = torch.autograd.grad(made.square().sum(), inputs, create_graph=True)
        bent = sum(part.square().sum() for part in graph)
        found.append([made, *plain, *graph, *torch.autograd.grad(bent, inputs)])
    for ours, theirs in zip(*found, strict=True):
        assert close(ours, theirs, 1e-4)
        assert float(theirs.detach().norm()) > 0


def test_results_do_not_depend_on_the_batch_nor_on_threads(representation):
    torch.manual_seed(0)
    near = block_neighbours(representation, 2)
    conv = SkeletonConv1d(near, (3,) * len(near), (4,) * len(near), 5)
    windows = torch.randn(3, conv.shape[1], 4000)
    gradient = torch.randn(3, conv.shape[0], 4000)

    def made(x, wanted):
        x = x.clone().requires_grad_(True)
        out = convolve(conv, x)
        return out, *torch.autograd.grad(out, (x, conv.weight), wanted)

    whole, by_input, by_weight = made(windows, gradient)
    own, own_by_input, _ = made(windows[1:2], gradient[1:2])
    assert torch.equal(own, whole[1:2]) and torch.equal(own_by_input, by_input[1:2])
    assert torch.equal(convolve(conv, windows[..., 20:70])[..., 2:-2], whole[..., 22:68])
    before = torch.get_num_threads()
    try:
        for count in (1, 2, 5):
            torch.set_num_threads(count)
            again = made(windows, gradient)
            for one, other in zip(again, (whole, by_input, by_weight), strict=True):
                assert torch.equal(one, other)
            with engine.threads_for_kernels():
                assert torch.get_num_threads() == 1
                assert torch.equal(made(windows, gradient)[0], whole)
            assert torch.get_num_threads() == count
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("penalty_on", ["window", "frame", "printed"])
@pytest.mark.parametrize("n_frames", [4, 21])
@pytest.mark.parametrize("style", [None, [[0.0, 1.0, 0.0], [0.0, 0.0, 0.0]]], ids=["", "style"])
def test_discriminator_gradients_are_autograds(representation, penalty_on, n_frames, style):
    torch.manual_seed(0)
    config = NetworkConfig(channels=(3, 4))
    discriminator = LevelDiscriminator(representation, config, 3 if style else 0)
    batch = 2 if style else 6
    style = None if style is None else torch.tensor(style)
    losses = LossConfig(discriminator_scale=0.5, gradient_penalty=2.0, penalty_on=penalty_on)
    real, fake = torch.randn(2, batch, representation.n_features, n_frames)
    mix = torch.rand(batch, 1, 1)
    exact = copy.deepcopy(discriminator).double()
    gap = NUMBA.discriminator_gradients([discriminator], [real], [fake], [mix], losses, [style])
    doubled = ([part.double()] for part in (real, fake, mix))
    exact_style = None if style is None else style.double()
    expected = TORCH.discriminator_gradients([exact], *doubled, losses, [exact_style])
    assert float(gap) == pytest.approx(float(expected), abs=1e-5)
    for ours, theirs in zip(discriminator.parameters(), exact.parameters(), strict=True):
        assert close(ours.grad.double(), theirs.grad, 2e-3)
    assert sum(float(p.grad.norm()) for p in exact.parameters()) > 0
