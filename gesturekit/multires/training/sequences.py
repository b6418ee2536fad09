"""Recordings of a multires run: normalised motion, speech features and noise, in memory or on
disk."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

import audio_features as af
from gesturekit.multires.network.resampling import resample
from gesturekit.training.data.arrays import Frames
from gesturekit.training.seeds import rng_for

Cut = tuple[int, int, int]
"""Index of a paired sequence, first frame and end."""


@dataclass(frozen=True)
class PairedSequence:
    """Recording with speech features, noise and style.

    Attributes:
        name: id of the manifest item.
        motion: (D, T) normalised motion vectors.
        speech: (S, T) features.
        sigma: (L,) noise scale of each level: RMSE between the level and the upsampled coarser one;
            RMS at the first level. Recordings on disk share those of the sample.
        z_star: noise at level 1 from which this recording is reconstructed, (T_1,), or (D, T_1)
            with separate noise for each channel.
        passive: (X, T) of the corpus's `PassiveChannels`.
        style: index among the corpus's styles; 0 without styles.
        speaker: its speaker; None if the corpus names none.
        take: its recording session, see `gesturekit.corpus.Item`.
    """

    TENSORS: ClassVar[tuple[str, ...]] = ("motion", "speech", "sigma", "z_star", "passive")

    name: str
    motion: Frames
    speech: Frames
    sigma: Tensor
    z_star: Tensor
    passive: Frames
    style: int = 0
    speaker: str | None = None
    take: str = ""

    @property
    def n_frames(self) -> int:
        """Return T, at the full rate."""
        return self.motion.shape[-1]

    @classmethod
    def make(
        cls,
        name: str,
        motion: Frames,
        speech: Frames,
        levels: int,
        seed: int,
        *,
        full_noise: bool = False,
        sigma: Tensor | None = None,
    ) -> PairedSequence:
        """Make a sequence; its noise depends on the seed and the name only.

        `sigma` (L,) is computed from the motion if it is None.
        """
        if sigma is None:
            sigma = level_sigmas(motion[:, :][None], levels)
        channels, n_frames = motion.shape
        n_coarsest = af.level_lengths(n_frames, levels)[0]
        rng = rng_for(seed, "z_star", name)
        if full_noise:
            noise = torch.randn(channels, n_coarsest, generator=rng)
        else:
            noise = torch.randn(n_coarsest, generator=rng) * sigma[0]
        return cls(name, motion, speech, sigma, noise, torch.empty(0, n_frames))

    def cut(self, start: int, stop: int) -> PairedSequence:
        """Return frames `start` to `stop` in memory, with their part of z*."""
        part = slice(start, stop)
        n_coarsest = af.level_lengths(stop - start, len(self.sigma))[0]
        z_star = self.z_star_window(start, n_coarsest)
        return replace(
            self,
            name=f"{self.name}[{start}:{stop}]",
            motion=self.motion[:, part].contiguous(),
            speech=self.speech[:, part].contiguous(),
            z_star=z_star if self.z_star.ndim > 1 else z_star[0],
            passive=self.passive[:, part].contiguous(),
        )

    def z_star_window(self, start: int, n_coarsest: int) -> Tensor:
        """Return the noise (1 or D, T_1) of the window that starts at this full-rate frame."""
        noise = self.z_star.reshape(-1, self.z_star.shape[-1])
        first = round(start * noise.shape[-1] / self.n_frames)
        first = max(0, min(first, noise.shape[-1] - n_coarsest))
        window = noise[:, first : first + n_coarsest]
        # A window as long as its sequence may come out one coarse frame longer by rounding.
        return resample(window, n_coarsest)


def level_sigmas(motion: Tensor, levels: int) -> Tensor:
    """Return sigma_i of all levels (L,) for a normalised motion (1, D, T)."""
    lengths = af.level_lengths(motion.shape[-1], levels)
    pyramid = [resample(motion, n) for n in lengths]
    sigmas = [pyramid[0].square().mean().sqrt()]
    for coarse, fine in zip(pyramid, pyramid[1:], strict=False):
        sigmas.append((fine - resample(coarse, fine.shape[-1])).square().mean().sqrt())
    return torch.stack(sigmas)
