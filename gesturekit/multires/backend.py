"""Choice of the implementation that computes convolutions and discriminator gradients."""

from __future__ import annotations

import os
from typing import get_args

from torch import nn

from gesturekit.errors import ConfigError, ModelError
from gesturekit.multires.config import BackendName
from gesturekit.multires.networks import TorchBackend

VARIABLE = "GESTUREKIT_BACKEND"
"""Environment variable that overrides the configured backend."""


def requested_backend(configured: BackendName = "auto") -> BackendName:
    """Return the requested backend: GESTUREKIT_BACKEND if it is set, else `configured`.

    Raises:
        ConfigError: the variable names no backend.
    """
    name = os.environ.get(VARIABLE) or configured
    for known in get_args(BackendName):
        if name == known:
            return known
    names = ", ".join(get_args(BackendName))
    raise ConfigError(f"{VARIABLE}: {name!r} is not one of {names}; correct or unset it")


def choose_backend(configured: BackendName, *networks: nn.Module) -> TorchBackend:
    """Return the `requested_backend` for these networks.

    `auto` takes the numba engine (`multires/cpu`) if it can be imported and was written for exactly
    these modules, and plain torch otherwise. The backend's `reason` says why.

    Raises:
        ConfigError: GESTUREKIT_BACKEND names no backend.
        ModelError: numba is requested, but the engine is missing or does not support a module.
    """
    requested = requested_backend(configured)
    if requested == "torch":
        return TorchBackend("as requested")
    try:
        from gesturekit.multires.cpu.engine import NumbaBackend, unsupported
    except ImportError as error:
        obstacle = f"the numba engine cannot be imported ({error})"
    else:
        obstacle = unsupported(*networks)
        if obstacle is None:
            return NumbaBackend("compiled sparse convolutions on the CPU")
    if requested == "numba":
        raise ModelError(f"backend: numba cannot be used: {obstacle}; auto falls back to torch")
    return TorchBackend(f"slower than numba, but {obstacle}")
