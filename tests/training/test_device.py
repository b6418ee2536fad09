"""The device that networks compute on: its settings, and what is said about it."""

import pytest
import torch

from gesturekit.errors import ConfigError
from gesturekit.training.session import prepare_device


def test_a_gpu_computes_deterministically_and_in_full_precision(gpu):
    assert prepare_device("cuda").type == "cuda"
    assert torch.are_deterministic_algorithms_enabled()
    assert not torch.backends.cudnn.allow_tf32 and not torch.backends.cuda.matmul.allow_tf32


@pytest.mark.parametrize("name", ["auto", "cuda"])
def test_a_gpu_that_cannot_be_used_is_reported(monkeypatch, name):
    def fail(*size, device):
        raise RuntimeError("no kernel image is available\nCompile with ...")

    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch, "zeros", fail)
    with pytest.raises(ConfigError, match="(?=.*cuda)(?=.*no kernel image)"):
        prepare_device(name)
