"""Device of the networks, in training and in rendering."""

from __future__ import annotations

import logging
import os
from typing import Any

import torch

from gesturekit.errors import ConfigError

log = logging.getLogger(__name__)


def prepare_device(name: str, threads: int | None = None) -> torch.device:
    """Return the device of that name, set to deterministic algorithms and full float32.

    Args:
        name: auto (a GPU if there is one), cpu, cuda, cuda:1 ...
        threads: CPU threads; None leaves the choice to torch.

    Raises:
        ConfigError: no such device here.
    """
    if threads:
        torch.set_num_threads(threads)
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).partition("\n")[0]
        raise ConfigError(f"device: {name!r} cannot be used here ({reason})") from None
    if device.type == "cuda":
        # Same seed, same weights, on a GPU too; cuBLAS reads the variable at its first use.
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
        torch.use_deterministic_algorithms(True, warn_only=True)
        # It would fill every new tensor, for programs that read memory before they write it.
        torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]  # made at run time
        # By default a GPU rounds the inputs of float32 convolutions to TF32, 10 bits, but not those
        # of matrix products. bfloat16 is the setting for speed.
        torch.backends.cudnn.allow_tf32 = False
    return device


def memory_ran_out(error: torch.cuda.OutOfMemoryError) -> str:
    """Return the part of torch's message that says how much memory was missing."""
    asked = ". ".join(str(error).split(". ")[:2])  # advice on the allocator follows
    return f"the GPU's memory ran out ({asked})"


def warn_of_slow_bfloat16(device: torch.device) -> None:
    """Warn if the processor has no bfloat16 arithmetic, and single precision is faster."""
    known: dict[str, Any] = getattr(
        torch.cpu, "get_capabilities", dict
    )()  # newer torch alone has it
    has_bfloat16 = known.get("avx512_bf16") or known.get("amx_bf16")
    if device.type == "cpu" and known.get("avx2") and not has_bfloat16:
        log.warning(
            "bf16: this processor has no bfloat16 arithmetic; fp32 is faster here (2.6 times with "
            "AVX2)"
        )
