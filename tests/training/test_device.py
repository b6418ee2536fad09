"""The device that networks compute on: its settings, and what is said about it."""

from __future__ import annotations

import pytest
import torch

from gesturekit.errors import ConfigError
from gesturekit.training.run.device import prepare_device, warn_of_slow_bfloat16


def test_a_run_has_the_threads_that_it_asks_for():
    before = torch.get_num_threads()
    try:
        assert prepare_device("cpu", before + 1).type == "cpu"
        assert torch.get_num_threads() == before + 1
        prepare_device("auto")
        assert torch.get_num_threads() == before + 1
    finally:
        torch.set_num_threads(before)


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
    with pytest.raises(ConfigError, match=r"device: 'cuda' cannot .* \(no kernel .* available\)$"):
        prepare_device(name)


@pytest.mark.parametrize(
    ("capabilities", "warns"),
    [
        ({"avx2": True, "avx512_bf16": False, "amx_bf16": False}, True),
        ({"avx2": True, "avx512_bf16": True}, False),
        ({}, False),  # an older torch, or another kind of processor
    ],
)
def test_a_processor_without_bfloat16_is_warned_about(monkeypatch, caplog, capabilities, warns):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: capabilities, raising=False)
    warn_of_slow_bfloat16(torch.device("cpu"))
    assert ("fp32 is faster" in caplog.text) == warns
