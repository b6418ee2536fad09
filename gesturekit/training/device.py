"""Where networks compute, in training and in rendering."""

from __future__ import annotations

import os

import torch

from gesturekit.errors import ConfigError


def prepare_device(name: str, threads: int | None = None) -> torch.device:
    """The device of that name, told to compute the same thing every time.

    Args:
        name: auto (a GPU if there is one), cpu, cuda, cuda:1 ...
        threads: CPU threads; None leaves the choice to torch.

    Raises:
        ConfigError: no such device here.
    """
    if threads:
        torch.set_num_threads(threads)
    if name == "auto":
        device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    else:
        try:
            device = torch.device(name)
            torch.zeros(1, device=device)
        except (RuntimeError, AssertionError) as error:
            reason = str(error).partition("\n")[0]
            raise ConfigError(f"device: {name!r} cannot be used here ({reason})") from None
    if device.type == "cuda":
        # Same seed, same weights, on a GPU too; cuBLAS wants to be told before its first use.
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
        torch.use_deterministic_algorithms(True, warn_only=True)
    return device
