"""The denoiser: its size, its padding, its two ways to be called."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch.utils._python_dispatch import TorchDispatchMode

from gesturekit.diffusion import Denoiser, NetworkConfig
from gesturekit.diffusion.network import DilatedConv
from gesturekit.training.seeds import rng_for

DIFFWAVE = NetworkConfig(
    blocks=4, channels=16, embedding=24, dilations=(1, 2, 4, 8), architecture="diffwave"
)


def inputs(n_frames: int, batch: int = 2) -> tuple[torch.Tensor, torch.Tensor]:
    rng = rng_for("inputs", n_frames)
    noisy = torch.randn(batch, n_frames, 7, generator=rng)
    return noisy, torch.randn(batch, n_frames, 5, generator=rng)


@pytest.mark.parametrize(
    ("blocks", "layers", "n_motion", "n_condition", "millions"),
    [(10, 4, 70, 35, 64.45), (20, 2, 61, 11, 71.12)],
)
def test_parameter_counts_are_the_published_ones(blocks, layers, n_motion, n_condition, millions):
    config = NetworkConfig(blocks=blocks, layers=layers)
    with torch.device("meta"):
        network = Denoiser(n_motion, n_condition, config)
    count = sum(p.numel() for p in network.parameters())
    assert count / 1e6 == pytest.approx(millions, abs=0.006)


@pytest.mark.parametrize(("n_in", "n_out"), [(6, 10), (10, 6)])
def test_dilated_convolution_is_a_convolution(n_in, n_out):
    """Response to a single number at the fourth of seven frames: the kernel."""
    layer = DilatedConv(n_in, n_out, dilation=3, bias=True)
    pulses = torch.zeros(n_in, 7, n_in)
    pulses[:, 3] = torch.eye(n_in)
    kernel = (layer(pulses) - layer.bias)[:, [6, 3, 0]].permute(2, 0, 1)
    assert (kernel != 0).all()
    for n_frames in (1, 2, 3, 20):
        x = torch.randn(2, n_frames, n_in, generator=rng_for("conv", n_frames))
        exact = F.conv1d(x.transpose(1, 2), kernel, layer.bias, padding=3, dilation=3)
        torch.testing.assert_close(layer(x), exact.transpose(1, 2))


@pytest.mark.parametrize("config", ["conformer", "diffwave"])
@pytest.mark.parametrize("n_frames", [30, 420])
def test_prediction_for_a_condition_is_the_forward_pass(shaken, config, n_frames):
    network = shaken(DIFFWAVE) if config == "diffwave" else shaken()
    noisy, condition = inputs(n_frames)
    predict = network.for_condition(condition, steps=range(20))
    for step in (0, 13):
        exact = network(noisy, condition, torch.tensor([step, step])).detach()
        assert exact.std() > 0.1
        before = noisy.clone()
        torch.testing.assert_close(predict(noisy, step), exact, atol=2e-5, rtol=1e-4)
        assert torch.equal(noisy, before), "the caller's motion was changed"


def test_frames_far_away_change_nothing_and_near_ones_do(shaken):
    """What the blocks of attention rest on: a network sees so far and no farther."""
    size = {"channels": 32, "heads": 4, "feedforward": 48, "embedding": 24}
    network = shaken(NetworkConfig(blocks=1, layers=1, **size))
    noisy, condition = inputs(500, batch=1)
    moved = noisy.clone()
    moved[:, 250] += 5
    predict = network.for_condition(condition, [10])
    changed = (predict(moved, 10) - predict(noisy, 10)).abs().amax((0, 2))
    assert changed[250] > 0.1
    assert changed[:150].max() < 1e-6
    assert changed[350:].max() < 1e-6


class Largest(TorchDispatchMode):
    """The largest tensor that any operation makes."""

    numbers = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        for value in out if isinstance(out, (list, tuple)) else [out]:
            if isinstance(value, torch.Tensor):
                self.numbers = max(self.numbers, value.numel())
        return out


@pytest.mark.parametrize("gradients", [False, True])
def test_memory_does_not_grow_with_the_square_of_the_length(shaken, gradients):
    network = shaken()
    noisy, condition = inputs(1000, batch=1)
    with Largest() as largest:
        if gradients:
            network(noisy, condition, torch.tensor([3])).sum().backward()
        else:
            network.for_condition(condition, [3])(noisy, 3)
    assert largest.numbers < 1000 * 1000


@pytest.mark.parametrize("mixed", [False, True])
def test_training_reaches_every_parameter_in_single_precision(shaken, mixed):
    network = shaken().train()
    noisy, condition = inputs(400)
    with torch.autocast("cpu", torch.bfloat16, enabled=mixed):
        out = network(noisy, condition, torch.tensor([3.0, 40.5]))
    assert out.dtype == torch.float32
    out.square().mean().backward()
    for name, value in network.named_parameters():
        assert value.grad is not None and value.grad.abs().max() > 0, name
        assert value.grad.dtype == torch.float32 and value.grad.isfinite().all(), name


def test_a_new_network_predicts_zero():
    network = Denoiser(50, 5, NetworkConfig(blocks=1, layers=1, channels=64, dilations=(1,)))
    noisy, condition = torch.randn(1, 9, 50), torch.randn(1, 9, 5)
    assert not network(noisy, condition, torch.tensor([3])).any()
    # Kaiming's normal distribution has the variance 2 / n.
    assert float(network.enter.weight.detach().std()) == pytest.approx((2 / 50) ** 0.5, rel=0.05)


def test_dropout_is_of_training_alone(shaken):
    config = NetworkConfig(blocks=1, layers=1, channels=16, heads=2, feedforward=16, dropout=0.5)
    network, (noisy, condition) = shaken(config), inputs(30)
    asked = noisy, condition, torch.tensor([3, 3])
    assert torch.equal(network(*asked), network(*asked))
    network.train()
    assert not torch.equal(network(*asked), network(*asked))


def test_a_denoiser_without_attention_is_the_published_arithmetic():
    """Two DiffWave blocks in numpy, as the released code has them, on weights drawn at random."""
    config = NetworkConfig(
        architecture="diffwave", blocks=2, channels=3, heads=1, embedding=5, dilations=(1, 2)
    )
    torch.manual_seed(0)
    network = Denoiser(2, 1, config).eval()
    rng = np.random.default_rng(0)
    for value in network.parameters():
        value.data = torch.from_numpy(rng.normal(0, 0.5, value.shape).astype(np.float32))
    w = {name: value.numpy().astype(np.float64) for name, value in network.state_dict().items()}
    noisy, condition = rng.normal(size=(7, 2)), rng.normal(size=(7, 1))

    def linear(name, x):
        return x @ w[f"{name}.weight"].T + w[f"{name}.bias"]

    def sigmoid(x):
        return 1 / (1 + np.exp(-x))

    # 64 frequencies from 1 to 1e4 radians a step, then two layers with SiLU.
    angles = 13 * 10.0 ** (4 * np.arange(64) / 63)
    step = np.concatenate([np.sin(angles), np.cos(angles)])
    for layer in ("embed_step.0", "embed_step.2"):
        step = linear(layer, step)
        step = step * sigmoid(step)
    steps = linear("project_step", step).reshape(2, 3)
    conditions = linear("project_condition", condition).reshape(7, 2, 3)
    x, total = np.maximum(linear("enter", noisy), 0), 0
    for i, dilation in enumerate((1, 2)):
        y = x + steps[i] + conditions[:, i]
        padded = np.pad(y, ((dilation, dilation), (0, 0)))
        taps = [padded[k * dilation : k * dilation + 7] for k in range(3)]
        y = np.concatenate(taps, axis=1) @ w[f"stacks.{i}.weight"].T + w[f"stacks.{i}.bias"]
        y = linear(f"split.{i}", sigmoid(y[:, :3]) * np.tanh(y[:, 3:]))
        x, total = (x + y[:, :3]) / np.sqrt(2), total + y[:, 3:]
    expected = linear("leave", np.maximum(linear("gather", total / np.sqrt(2)), 0))
    given = (torch.from_numpy(x).float()[None] for x in (noisy, condition))
    made = network(*given, torch.tensor([13]))
    np.testing.assert_allclose(made[0].detach().numpy(), expected, rtol=1e-3, atol=1e-4)
