"""What a diffusion run can be told; the defaults are the gesture models of the paper."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from gesturekit.errors import ConfigError


def _positive(**values: float) -> None:
    for name, value in values.items():
        if not 0 < value < math.inf:
            raise ConfigError(f"{name}: {value!r} must be above 0")


@dataclass(frozen=True)
class NetworkConfig:
    """The denoising network (section 3.2 and appendix A.1 of the paper)."""

    blocks: int = 10
    """Residual blocks."""
    layers: int = 4
    """Conformer layers in each block; `diffwave` has one convolution instead."""
    channels: int = 256
    heads: int = 8
    feedforward: int = 1024
    """Hidden channels of the convolutional part of a Conformer layer."""
    embedding: int = 512
    """Width of the embedding of the diffusion step."""
    dilations: tuple[int, ...] = (0, 1, 2)
    """In frames, in turn over the blocks; 0 is a plain feed-forward part instead of convolutions
    of three frames."""
    kernels: int = 21
    """Sigmoids in the position bias of each head."""
    nearest_view: int = 5
    """Frames that the nearest-sighted head sees: 1e-8 of the weight is left at half of them ..."""
    farthest_view: int = 75
    """... and that the farthest-sighted head sees."""
    dropout: float = 0.1
    """On attention weights, in the feed-forward part and on what a layer adds."""
    architecture: Literal["conformer", "diffwave"] = "conformer"
    """`diffwave` is the paper's ablation LDA-DW: one dilated convolution in place of the stack.
    It has no dilation 0; the paper's cycle is 1, 2, 4 ... 512."""

    def __post_init__(self) -> None:
        _positive(
            blocks=self.blocks,
            layers=self.layers,
            channels=self.channels,
            heads=self.heads,
            feedforward=self.feedforward,
            embedding=self.embedding,
            kernels=self.kernels,
            nearest_view=self.nearest_view,
        )
        if self.channels % self.heads:
            raise ConfigError(f"heads: {self.heads} must divide channels, which is {self.channels}")
        if self.farthest_view < self.nearest_view:
            raise ConfigError(
                f"farthest_view: {self.farthest_view} must be at least nearest_view, which is "
                f"{self.nearest_view}"
            )
        lowest = 1 if self.architecture == "diffwave" else 0
        if not self.dilations or min(self.dilations) < lowest:
            raise ConfigError(
                f"dilations: {list(self.dilations)} must be numbers of at least {lowest} for "
                f"architecture {self.architecture}"
            )
        if not 0 <= self.dropout < 1:
            raise ConfigError(f"dropout: {self.dropout} must be at least 0 and below 1")


@dataclass(frozen=True)
class NoiseConfig:
    """How noise is added, step by step, and what the network tells about it."""

    steps: int = 100
    """N; dance, locomotion and fighting: 150."""
    first_beta: float = 0.0074
    """beta_1, rising on a straight line ...; dance, locomotion and fighting: 0.01."""
    last_beta: float = 0.78
    """... to beta_N; the others 0.7."""
    predict: Literal["noise", "velocity"] = "noise"
    """What the network predicts: the noise (the paper), or the velocity of Salimans and Ho."""

    def __post_init__(self) -> None:
        _positive(steps=self.steps)
        for name in ("first_beta", "last_beta"):
            if not 0 < getattr(self, name) < 1:
                raise ConfigError(f"{name}: {getattr(self, name)!r} must be between 0 and 1")
        if self.last_beta < self.first_beta:
            raise ConfigError(
                f"last_beta: {self.last_beta} must be at least first_beta, which is "
                f"{self.first_beta}"
            )
