"""The pose autoencoder of the Fréchet gesture distance (Yoon et al. 2020, GENEA)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

N_FEATURES = 32


class PoseAutoencoder(nn.Module):
    """Temporal convolutions with a bottleneck of 32 features (Yoon et al. 2020, `embedding_net`).

    The released network has `LeakyReLU(True)` between its linear layers: a slope of 1, which is the
    identity. These activations are left out here. GENEA's variant lacks the last linear layer of
    the encoder (`fc_mu`) and takes windows of other lengths than 34 frames.

    Args:
        n_inputs: numbers a frame.
        n_frames: frames of a window, from 12.
        mean_layer: True to add the last linear layer of Yoon et al.
    """

    def __init__(self, n_inputs: int, n_frames: int, mean_layer: bool) -> None:
        super().__init__()
        self.n_inputs, self.n_frames, self.mean_layer = n_inputs, n_frames, mean_layer
        n_left = (n_frames - 4 - 4) // 2 + 1 - 2
        self.encoder = nn.Sequential(
            *_block(nn.Conv1d(n_inputs, 32, 3)),
            *_block(nn.Conv1d(32, 64, 3)),
            *_block(nn.Conv1d(64, 64, 4, stride=2)),
            nn.Conv1d(64, 32, 3),
            nn.Flatten(),
            nn.Linear(32 * n_left, 256),
            nn.BatchNorm1d(256),
            nn.Linear(256, 128),
            nn.BatchNorm1d(128),
            nn.Linear(128, N_FEATURES),
            *([nn.Linear(N_FEATURES, N_FEATURES)] if mean_layer else []),
        )
        self.decoder = nn.Sequential(
            nn.Linear(N_FEATURES, 64),
            nn.BatchNorm1d(64),
            nn.Linear(64, 4 * n_frames),
            nn.Unflatten(1, (4, n_frames)),
            *_block(nn.ConvTranspose1d(4, 32, 3)),
            *_block(nn.ConvTranspose1d(32, 32, 3)),
            nn.Conv1d(32, 32, 3),
            nn.Conv1d(32, n_inputs, 3),
        )

    def forward(self, windows: Tensor) -> tuple[Tensor, Tensor]:
        """Return features (B, 32) and the reconstruction of windows (B, n_frames, n_inputs)."""
        features = self.encoder(windows.transpose(1, 2))
        return features, self.decoder(features).transpose(1, 2)


def reconstruction_loss(made: Tensor, windows: Tensor) -> Tensor:
    """Return L1 plus L1 of frame differences of (B, T, D): means over a window, summed over B."""
    error = (made - windows).abs().mean(dim=(1, 2))
    steps = (torch.diff(made, dim=1) - torch.diff(windows, dim=1)).abs().mean(dim=(1, 2))
    return (error + steps).sum()


def _block(convolution: nn.Conv1d | nn.ConvTranspose1d) -> tuple[nn.Module, ...]:
    return convolution, nn.BatchNorm1d(convolution.out_channels), nn.LeakyReLU(0.2)
