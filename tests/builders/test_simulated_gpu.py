"""The simulated GPU keeps devices apart like a real one."""

import copy

import pytest
import torch


def test_training_stays_on_the_device(gpu):
    layer = torch.nn.Linear(4, 3).to("cuda")
    optimiser = torch.optim.Adam(layer.parameters(), fused=True)
    made = layer(torch.randn(2, 4, device="cuda"))
    made.sum().backward()
    optimiser.step()
    state = optimiser.state[layer.weight]["exp_avg"]
    for tensor in (made, layer.weight, layer.weight.grad, state, made[0], made.new_zeros(1)):
        assert tensor.device == torch.device("cuda:0") and tensor.is_cuda
    other = copy.deepcopy(layer)
    assert other.weight.is_cuda and not other.cpu().weight.is_cuda and layer.weight.is_cuda
    assert not made.detach().cpu().is_cuda and (made.detach().cpu() == made.detach().cpu()).all()
    # Numbers, and indices from the CPU.
    assert (made * torch.tensor(2.0)).is_cuda and made[torch.tensor([0])].is_cuda


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda x: x + torch.zeros(3), "device"),
        (lambda x: torch.stack([x[0, 0], torch.tensor(0.0)]), "device"),
        (lambda x: torch.nn.Linear(3, 3)(x), "device"),
        (lambda x: torch.zeros(3).index_select(0, torch.tensor([0], device="cuda")), "device"),
        (lambda x: torch.zeros(3)[torch.tensor([0], device="cuda")], "indices"),
        (lambda x: torch.randn(2, generator=torch.Generator(), device="cuda"), "generator"),
    ],
)
def test_the_simulated_gpu_refuses_mixed_devices(gpu, wrong, message):
    with pytest.raises(RuntimeError, match=message):
        wrong(torch.ones(2, 3, device="cuda"))


def test_numpy_cannot_read_a_gpu(gpu):
    for read in (torch.Tensor.numpy, torch.Tensor.__array__):
        with pytest.raises(TypeError, match="to numpy"):
            read(torch.ones(2, device="cuda"))
