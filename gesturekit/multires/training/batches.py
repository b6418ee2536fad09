"""Batches of windows for the steps of a training stage."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from gesturekit.multires.config import MultiresConfig, TrainingConfig
from gesturekit.multires.network.generator import MultiresGenerator
from gesturekit.multires.network.skeleton_conv import Convolve
from gesturekit.multires.training.data import TrainingData
from gesturekit.multires.training.sequences import PairedSequence
from gesturekit.multires.training.state import TrainingState
from gesturekit.multires.training.window_cache import WindowCache, Windows
from gesturekit.training.seeds import rng_for
from gesturekit.wording import drawn


class Batches:
    """Random and paired windows of one stage, from the window cache or drawn anew.

    Args:
        data: recordings and speech.
        config: of the run.
        network: its levels below the stage generate what the stage upsamples.
        first: index of the stage's coarser level.
        convolve: convolution of the backend.
        source: see `Stage`.
    """

    def __init__(
        self,
        data: TrainingData,
        config: MultiresConfig,
        network: MultiresGenerator,
        first: int,
        convolve: Convolve,
        source: TrainingState | None = None,
    ) -> None:
        self.training = config.training
        self.seed = config.seed
        self.first = first
        self.cache = WindowCache(data, config, network, convolve, source)
        self.size = config.training.windows_per_step
        self.paired = data.paired
        self.own_lengths = data.own_lengths
        self.sequences = {
            n_frames: [data.paired[i] for i in members]
            for n_frames, members in data.window_lengths().items()
        }
        # A length is drawn as often as the recordings or clips that have it.
        self._recorded = {
            n_frames: sum(map(data.draw_weight, members))
            for n_frames, members in self.sequences.items()
        }
        self._spoken = Counter(clip.shape[-1] for clip in data.unpaired)
        self._cached: dict[str, dict[int, Windows]] = {}

    def renew(self, iteration: int) -> None:
        """Fill the window cache, if there is one and it is time to."""
        training = self.training
        if training.window_cache is None or (iteration % training.renew_every and self._cached):
            return
        self._cached = {}
        # The word is part of the seed.
        rng = rng_for(self.seed, "bank", self.first, iteration // training.renew_every)
        shares = {
            n_frames: max(1, training.window_cache * len(members) // len(self.paired))
            for n_frames, members in self.sequences.items()
        }
        counts = {"paired": shares} if training.reconstruction_steps else {}
        if training.discriminator_steps or training.generator_steps:
            counts["random"] = shares
            if self.own_lengths:
                drawn = (self.length("random", rng) for _ in range(training.window_cache))
                counts["random"] = Counter(drawn)
        for kind, lengths in counts.items():
            self._cached[kind] = {n: self._draw(kind, n, lengths[n], rng) for n in lengths}

    def length(self, kind: str, rng: torch.Generator) -> int:
        """Draw the length of the motions of a step, in full-rate frames; `kind` as in `windows`."""
        weights: Mapping[int, float] = self._recorded
        if kind == "random" and self.own_lengths:
            cached = self._cached.get(kind, {})
            weights = {n: len(windows) for n, windows in cached.items()} or self._spoken
        shares = torch.tensor(list(weights.values()), dtype=torch.float32)
        return list(weights)[int(torch.multinomial(shares, 1, generator=rng))]

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
        """Return recorded motion (B, D, T_i) for each discriminator, of the given styles.

        It is shorter than `n_frames` where random steps have their own lengths and the recording
        that is drawn has fewer frames.
        """
        sequences = self._sequences("random", n_frames)
        if self.own_lengths:
            own = [s for s in sequences if styles is None or s.style in styles]
            sequences = [own[int(torch.randint(len(own), (), generator=rng))]]
            n_frames = min(n_frames, sequences[0].n_frames)
        return self.cache.reals(sequences, n_frames, self.first, self.size, rng, styles)

    def _draw(self, kind: str, n_frames: int, count: int, rng: torch.Generator) -> Windows:
        draw = self.cache.paired if kind == "paired" else self.cache.random
        return draw(self._sequences(kind, n_frames), n_frames, self.first, count, rng)

    def _sequences(self, kind: str, n_frames: int) -> Sequence[PairedSequence]:
        """Return the recordings with which motions of this length are made or compared."""
        if kind == "random" and self.own_lengths:
            return self.paired
        return self.sequences[n_frames]


def usage(training: TrainingConfig, iterations: int, seconds: float, recordings: int) -> str:
    """Return how often a stage draws each second of the recordings.

    Args:
        training: of the run.
        iterations: of the stage.
        seconds: of all recordings.
        recordings: their number.
    """
    windows = iterations * training.windows_per_step
    counts = {"as real motion": windows * training.discriminator_steps}
    if training.reconstruction_steps:
        count = windows * training.reconstruction_steps
        if training.window_cache is not None:
            count = math.ceil(iterations / training.renew_every) * training.window_cache
        counts["to be reconstructed"] = count
    share = (training.window or seconds / recordings) / seconds
    parts = [f"{name} about {drawn(count * share)}" for name, count in counts.items() if count]
    return f"each stage draws a second {' and '.join(parts)}"
