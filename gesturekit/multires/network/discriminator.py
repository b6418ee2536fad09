"""Discriminators of the pyramid (section 3 of Moreno-Villamarin et al. 2024)."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor, nn

from gesturekit.multires.config import NetworkConfig
from gesturekit.multires.motion_vector import MultiresRepresentation
from gesturekit.multires.network.resampling import reflect
from gesturekit.multires.network.skeleton_conv import (
    SLOPE,
    Convolve,
    convolve_dense,
    skeleton_layers,
)


class LevelDiscriminator(nn.Module):
    """Patch discriminator D_i of one level; it has no speech input.

    With styles, each style adds a learnt projection of the last features to the score (projection
    discriminator, Miyato and Koyama 2018).
    """

    def __init__(
        self, representation: MultiresRepresentation, config: NetworkConfig, n_styles: int = 0
    ) -> None:
        super().__init__()
        self.layers = skeleton_layers(representation, config, output=False)
        width = self.layers[-1].shape[0]
        self.score = nn.Conv1d(width, 1, config.kernel)
        if n_styles:
            self.styled = nn.Conv1d(width, n_styles, config.kernel, bias=False)

    def score_weights(self, n_frames: int, style: Tensor | None = None) -> Tensor:
        """Return the weight of each feature in the mean score, (1 or B, C, T).

        The mean over time of the last, reflect-padded convolution is linear in its input, so that
        it is a weighted sum and no convolution.

        Args:
            n_frames: T.
            style: (B, K) one-hot, or None.
        """
        kernels = self.score.weight
        if style is not None:
            kernels = kernels + torch.einsum("bk,kct->bct", style, self.styled.weight)
        return kernels @ tap_frequencies(n_frames, kernels.shape[-1]).to(kernels)

    def forward(
        self, x: Tensor, style: Tensor | None = None, convolve: Convolve = convolve_dense
    ) -> Tensor:
        """Return the mean score of all patches of each motion, (B,). There is one patch around each
        frame.

        Args:
            x: (B, D, T).
            style: (B, K) one-hot; zeros for a motion without a style.
            convolve: implementation of the convolutions.
        """
        assert self.score.bias is not None
        x = convolve(self.layers, x, SLOPE, SLOPE)
        # Scores are means over time with small differences: too fine for half precision.
        with torch.autocast(x.device.type, enabled=False):
            x = x.to(self.score.weight.dtype)
            return (x * self.score_weights(x.shape[-1], style)).sum(dim=(1, 2)) + self.score.bias


@lru_cache(maxsize=64)
def tap_frequencies(n_frames: int, kernel: int) -> Tensor:
    """Return how often each frame is multiplied by each kernel tap, divided by T: (kernel, T).

    It is the average over time of a reflect-padded convolution, without its weights.
    """
    windows = reflect(torch.eye(n_frames), kernel // 2).unfold(-1, kernel, 1)
    return windows.sum(dim=1).T.contiguous() / n_frames
