"""Batches of windows for the steps of a training stage."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gesturekit.multires.config import MultiresConfig
from gesturekit.multires.network.generator import MultiresGenerator
from gesturekit.multires.network.skeleton_conv import Convolve
from gesturekit.multires.recall.library import RecallLibrary
from gesturekit.multires.training.data import TrainingData
from gesturekit.multires.training.window_cache import WindowCache, Windows
from gesturekit.training.seeds import rng_for


class Batches:
    """Random and paired windows of one stage, from the window cache or drawn anew.

    Args:
        data: recordings and speech.
        config: of the run.
        network: its levels below the stage generate what the stage upsamples.
        first: index of the stage's coarser level.
        convolve: convolution of the backend.
        library: recordings that are recalled; None without recall.
    """

    def __init__(
        self,
        data: TrainingData,
        config: MultiresConfig,
        network: MultiresGenerator,
        first: int,
        convolve: Convolve,
        library: RecallLibrary | None = None,
    ) -> None:
        self.training = config.training
        self.seed = config.seed
        self.first = first
        self.bank = WindowCache(data, config, network, convolve, library)
        self.size = config.training.windows_per_step
        self.sequences = {
            n_frames: [data.paired[i] for i in members]
            for n_frames, members in data.window_lengths().items()
        }
        # A window length is drawn as often as there are frames of recordings that have it.
        self._frames = torch.tensor(
            [float(sum(s.n_frames for s in members)) for members in self.sequences.values()]
        )
        self._cached: dict[str, dict[int, Windows]] = {}

    def renew(self, iteration: int) -> None:
        """Fill the window cache, if there is one and it is time to."""
        training = self.training
        if training.window_cache is None or (iteration % training.renew_every and self._cached):
            return
        self._cached = {"paired": {}, "random": {}}
        rng = rng_for(self.seed, "bank", self.first, iteration // training.renew_every)
        total = sum(map(len, self.sequences.values()))
        for n_frames, members in self.sequences.items():
            count = max(1, training.window_cache * len(members) // total)
            if training.reconstruction_steps:
                self._cached["paired"][n_frames] = self._draw("paired", n_frames, count, rng)
            if training.discriminator_steps or training.generator_steps:
                self._cached["random"][n_frames] = self._draw("random", n_frames, count, rng)

    def length(self, rng: torch.Generator) -> int:
        """Draw the window length of a step, in full-rate frames."""
        return list(self.sequences)[int(torch.multinomial(self._frames, 1, generator=rng))]

    def windows(
        self, kind: str, n_frames: int, rng: torch.Generator, batches: int = 1
    ) -> tuple[Windows, Tensor]:
        """Return windows, and the indices (batches, B) of those of each batch.

        Args:
            kind: `paired` for reconstruction steps, `random` for the others.
            n_frames: length of the windows at the full rate.
            rng: random numbers.
            batches: number of batches.
        """
        size = (batches, self.size)
        if self.training.window_cache is not None:
            windows = self._cached[kind][n_frames]
        else:
            windows = self._draw(kind, n_frames, math.prod(size), rng)
            if len(windows) == math.prod(size):
                return windows, torch.arange(len(windows)).reshape(size)
        return windows, torch.randint(len(windows), size, generator=rng)

    def reals(
        self, n_frames: int, rng: torch.Generator, styles: list[int] | None = None
    ) -> list[Tensor]:
        """Return recorded motion (B, D, T_i) for each discriminator, of the given styles."""
        sequences = self.sequences[n_frames]
        return self.bank.reals(sequences, n_frames, self.first, self.size, rng, styles)

    def _draw(self, kind: str, n_frames: int, count: int, rng: torch.Generator) -> Windows:
        draw = self.bank.paired if kind == "paired" else self.bank.random
        return draw(self.sequences[n_frames], n_frames, self.first, count, rng)
