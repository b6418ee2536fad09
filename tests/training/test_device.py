"""Warnings about the device that networks compute on."""

from __future__ import annotations

import pytest
import torch

from gesturekit.training.run.device import warn_of_slow_bfloat16


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
