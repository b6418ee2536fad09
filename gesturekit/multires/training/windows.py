"""Windows that a stage trains on, with the output of the finished coarser levels.

While a stage trains two levels, all coarser ones are finished, and their output for given noise
and speech does not change. With a window cache it is generated for many windows at once, so that a
training step runs only the levels it trains. Random numbers depend on (seed, stage, renewal), so
that a resumed run gets the same windows.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gesturekit.multires.config import MultiresConfig
from gesturekit.multires.networks import Convolve, MultiresGenerator, convolve_dense
from gesturekit.multires.pyramid import RandomNoise, ZStarPatches, mixed_styles
from gesturekit.multires.resampling import resample
from gesturekit.multires.training.data import PairedSequence, TrainingData
from gesturekit.multires.training.state import TrainingState
from gesturekit.training.seeds import rng_for
from gesturekit.wording import drawn


@dataclass(frozen=True)
class Windows:
    """N windows of one length, ready for the levels of a stage.

    Attributes:
        coarser: (N, D, T) output of the level below the stage; None at the first level.
        noise: (N, 1, T_i) for each level of the stage, or None for no noise.
        conditions: (N, S + K + C, T_i) for each level of the stage: speech features, one-hot
            styles and state of movement; no channels without conditions.
        speech: (N, S, T_i) the same features, not residual, for the arm-speed loss of random
            steps; empty if it is not used.
        targets: (N, D, T_i) recorded motion; empty for random steps.
        styles: (N, L) number of the style at each level of the pyramid; 0 without styles.
    """

    coarser: Tensor | None
    noise: tuple[Tensor | None, ...]
    conditions: tuple[Tensor, ...]
    speech: tuple[Tensor, ...]
    targets: tuple[Tensor, ...]
    styles: Tensor

    def __len__(self) -> int:
        return len(self.styles)

    def take(self, index: Tensor) -> Windows:
        """Return the windows with these numbers, (B,)."""
        return Windows(
            None if self.coarser is None else self.coarser[index],
            tuple(None if noise is None else noise[index] for noise in self.noise),
            tuple(condition[index] for condition in self.conditions),
            tuple(speech[index] for speech in self.speech),
            tuple(target[index] for target in self.targets),
            self.styles[index],
        )


class Batches:
    """Random and paired windows of one stage, from the window cache or drawn anew.

    Args:
        data: recordings and speech.
        config: of the run.
        network: its levels below the stage generate what the stage upsamples.
        first: index of the stage's coarser level.
        convolve: convolution of the backend.
        state: the state of movement; None for a model without it.
    """

    def __init__(
        self,
        data: TrainingData,
        config: MultiresConfig,
        network: MultiresGenerator,
        first: int,
        convolve: Convolve = convolve_dense,
        state: TrainingState | None = None,
    ) -> None:
        self.data, self.config, self.network, self.state = data, config, network, state
        self.first, self.convolve = first, convolve
        self.device = next(network.parameters()).device
        self.noise = random_noise(data, config, config.network.levels)
        self.size = config.windows_per_step
        groups = data.window_lengths()
        self.sequences = {n: [data.paired[i] for i in group] for n, group in groups.items()}
        # A length is drawn as often as the recordings or clips that have it.
        self._recorded = {n: sum(map(data.draw_weight, own)) for n, own in self.sequences.items()}
        self._spoken = Counter(clip.shape[-1] for clip in data.unpaired)
        self._cached: dict[str, dict[int, Windows]] = {}

    def renew(self, iteration: int) -> None:
        """Fill the window cache, if there is one and it is time to."""
        training = self.config.training
        if training.window_cache is None or (iteration % training.renew_every and self._cached):
            return
        self._cached = {}
        # The word is part of the seed.
        rng = rng_for(self.config.seed, "bank", self.first, iteration // training.renew_every)
        size, total = training.window_cache, len(self.data.paired)
        shares = {n: max(1, size * len(own) // total) for n, own in self.sequences.items()}
        counts = {"paired": shares} if training.reconstruction_steps else {}
        if training.discriminator_steps or training.generator_steps:
            counts["random"] = shares
            if self.data.own_lengths:
                lengths = (self.length("random", rng) for _ in range(training.window_cache))
                counts["random"] = Counter(lengths)
        for kind, count_of in counts.items():
            self._cached[kind] = {n: self._draw(kind, n, count_of[n], rng) for n in count_of}

    def length(self, kind: str, rng: torch.Generator) -> int:
        """Draw the length of the motions of a step, in full-rate frames; `kind` as in `windows`."""
        weights: Mapping[int, float] = self._recorded
        if kind == "random" and self.data.own_lengths:
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
        if self.config.training.window_cache is not None:
            windows = self._cached[kind][n_frames]
        else:
            windows = self._draw(kind, n_frames, math.prod(size), rng)
            if len(windows) == math.prod(size):
                return windows, torch.arange(len(windows)).reshape(size)
        return windows, torch.randint(len(windows), size, generator=rng)

    def reals(
        self, n_frames: int, rng: torch.Generator, styles: Sequence[int] | None = None
    ) -> list[Tensor]:
        """Return recorded motion (B, D, T_i) for each discriminator, of the given styles.

        It is shorter than `n_frames` where random steps have their own lengths and the recording
        that is drawn has fewer frames.
        """
        sequences = self._sequences("random", n_frames)
        if self.data.own_lengths:
            allowed = [s for s in sequences if styles is None or s.style in styles]
            sequences = [allowed[int(torch.randint(len(allowed), (), generator=rng))]]
            n_frames = min(n_frames, sequences[0].n_frames)
        return self.recorded(sequences, n_frames, self.size, rng, styles)

    def _draw(self, kind: str, n_frames: int, count: int, rng: torch.Generator) -> Windows:
        draw = self.paired if kind == "paired" else self.random
        return draw(self._sequences(kind, n_frames), n_frames, count, rng)

    def _sequences(self, kind: str, n_frames: int) -> Sequence[PairedSequence]:
        """Return the recordings with which motions of this length are made or compared."""
        if kind == "random" and self.data.own_lengths:
            return self.data.paired
        return self.sequences[n_frames]

    def random(
        self, sequences: Sequence[PairedSequence], n_frames: int, count: int, rng: torch.Generator
    ) -> Windows:
        """Return windows for random-generation steps: unpaired speech, new noise, no targets.

        Coarse levels have styles of these sequences, which are also the discriminator's real
        motions. The windows are `random_margin` frames longer at both ends.
        """
        data, config, margin = self.data, self.config, self.config.random_margin
        speech = torch.stack([data.speech_window(n_frames, margin, rng) for _ in range(count)])
        n_frames += 2 * margin
        quiet = torch.rand(count, generator=rng) < config.training.silence
        speech[quiet] = data.silence[:, :n_frames]
        lengths = config.network.lengths(n_frames)
        noises = self.noise.gaussian(lengths, lambda _: rng, count=count)
        styles = torch.zeros(count, len(lengths), dtype=torch.long)
        if config.styles is not None:
            coarse, fine = data.style_shares(sequences), data.style_shares(data.paired)
            styles = mixed_styles(coarse, fine, count, len(lengths), config.styles.mixing, rng)
        coarsest = styles[:, :1].expand(-1, lengths[0]).tolist()
        noises[0] = self.noise.shuffled(noises[0], coarsest, rng)
        state = None
        if self.state is not None:
            state = self.state.random(speech, styles[:, 0].tolist(), rng)
        return self._windows(speech, styles, noises, state)

    def paired(
        self, sequences: Sequence[PairedSequence], n_frames: int, count: int, rng: torch.Generator
    ) -> Windows:
        """Return `count` windows for reconstruction steps: paired speech, z*, recorded motion.

        If there are fewer windows than that, all are returned: a whole sequence has only one.
        """
        lengths = self.config.network.lengths(n_frames)
        starts = [sequence.n_frames - n_frames + 1 for sequence in sequences]
        if sum(starts) > count:
            chosen = list(random_windows(sequences, n_frames, count, rng))
        else:
            pairs = zip(sequences, starts, strict=True)
            chosen = [(sequence, start) for sequence, n in pairs for start in range(n)]
        parts = [(s, slice(start, start + n_frames)) for s, start in chosen]
        state = None
        if self.state is not None:
            state = np.stack([self.state.recorded(s)[:, frames] for s, frames in parts])
        z_star = torch.stack([s.z_star_window(start, lengths[0]) for s, start in chosen])
        return self._windows(
            torch.stack([s.speech[:, frames] for s, frames in parts]),
            torch.tensor([[s.style] * len(lengths) for s, _ in chosen]),
            [z_star, *[None] * (len(lengths) - 1)],
            state,
            torch.stack([s.motion[:, frames] for s, frames in parts]),
        )

    def recorded(
        self,
        sequences: Sequence[PairedSequence],
        n_frames: int,
        count: int,
        rng: torch.Generator,
        styles: Sequence[int] | None = None,
    ) -> list[Tensor]:
        """Return recorded motion (B, D, T_i) for the discriminator of each level of the stage.

        Args:
            sequences: recordings to draw from.
            n_frames: length of a window.
            count: B.
            rng: random generator.
            styles: number of the style of each motion; None for any.
        """
        lengths = self.config.network.lengths(n_frames)
        if styles is None:
            windows = list(random_windows(sequences, n_frames, count, rng))
        else:
            windows = []
            for style in styles:
                alike = [sequence for sequence in sequences if sequence.style == style]
                windows += random_windows(alike, n_frames, 1, rng)
        motions = [sequence.motion[:, start : start + n_frames] for sequence, start in windows]
        return [
            torch.stack([resample(motion, n) for motion in motions]).to(self.device)
            for n in lengths[self.first : self.first + self.config.training.stage_levels]
        ]

    @torch.no_grad()
    def _windows(
        self,
        speech: Tensor,
        styles: Tensor,
        noises: list[Tensor | None],
        state: np.ndarray | None,
        motion: Tensor | None = None,
    ) -> Windows:
        """Return windows of T frames with the output of the levels coarser than the stage.

        `speech` is (N, S, T), `styles` (N, L), each of `noises` (N, 1 or D, T_i) unless `state`
        (N, C, T) makes it, `motion` (N, D, T) for reconstruction.
        """
        config, to, first, coarser = self.config, self.device, self.first, None
        lengths, given = config.network.lengths(speech.shape[-1]), self.data.conditions
        conditions = [level.to(to) for level in given.of_batch(speech, lengths, styles, state)]
        if state is not None:
            noises = self.noise.clocked(state, given.n_carriers, lengths)
        noises = [None if noise is None else noise.to(to) for noise in noises]
        stage = slice(first, first + config.training.stage_levels)
        asks_arms = motion is None and config.uses_arm_speed
        targets = () if motion is None else [resample(motion.to(to), n) for n in lengths[stage]]
        if first and motion is not None and config.losses.rec_input == "real":  # eq. 15 as printed
            coarser = resample(motion.to(to), lengths[first - 1])
        elif first:
            made, size = [], config.training.batch
            for start in range(0, len(styles), size):
                batch = slice(start, start + size)
                levels = self.network(
                    [None if noise is None else noise[batch] for noise in noises[:first]],
                    [level[batch] for level in conditions[:first]],
                    lengths=lengths[:first],
                    convolve=self.convolve,
                )
                made.append(levels[-1])
            coarser = torch.cat(made)
        return Windows(
            coarser,
            tuple(noises[stage]),
            tuple(conditions[stage]),
            tuple(resample(speech.to(to), n) for n in lengths[stage]) if asks_arms else (),
            tuple(targets),
            styles.to(to),
        )


def random_noise(data: TrainingData, config: MultiresConfig, levels: int) -> RandomNoise:
    """Return the noise of random motions, with noise at this many of the coarsest levels."""
    patches = None
    if config.z_star_shuffle:
        z_stars = [sequence.z_star for sequence in data.sample]
        styles = [sequence.style for sequence in data.sample]
        patches = ZStarPatches(z_stars, styles, config.z_star_shuffle)
    sigma = torch.stack([sequence.sigma for sequence in data.sample])
    return RandomNoise(sigma.mean(dim=0), levels, patches)


def random_windows(
    sequences: Sequence[PairedSequence], n_frames: int, count: int, rng: torch.Generator
) -> Iterator[tuple[PairedSequence, int]]:
    """Yield sequence and start frame of random windows, every start equally likely."""
    starts = torch.tensor([float(sequence.n_frames - n_frames + 1) for sequence in sequences])
    for which in torch.multinomial(starts, count, replacement=True, generator=rng).tolist():
        yield sequences[which], int(torch.randint(int(starts[which]), (), generator=rng))


def usage(config: MultiresConfig, iterations: int, seconds: float, recordings: int) -> str:
    """Return how often a stage draws each second of the recordings.

    Args:
        config: of the run.
        iterations: of the stage.
        seconds: of all recordings.
        recordings: their number.
    """
    training, windows = config.training, iterations * config.windows_per_step
    counts = {"as real motion": windows * training.discriminator_steps}
    if training.reconstruction_steps:
        count = windows * training.reconstruction_steps
        if training.window_cache is not None:
            count = math.ceil(iterations / training.renew_every) * training.window_cache
        counts["to be reconstructed"] = count
    share = (training.window or seconds / recordings) / seconds
    parts = [f"{name} about {drawn(count * share)}" for name, count in counts.items() if count]
    return f"each stage draws a second {' and '.join(parts)}"
