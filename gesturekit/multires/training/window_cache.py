"""Window cache: training windows with the output of the finished coarser levels.

While a stage trains two levels, all coarser ones are finished, and their output for given noise
and speech does not change. It is generated for many windows at once, so that a training step runs
only the levels it trains. Random numbers depend on (seed, stage, renewal), so that a resumed run
gets the same windows.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

import audio_features as af
from gesturekit.multires.config import MultiresConfig
from gesturekit.multires.network.generator import MultiresGenerator
from gesturekit.multires.network.resampling import resample
from gesturekit.multires.network.skeleton_conv import Convolve, convolve_dense
from gesturekit.multires.sampling.conditions import (
    condition_levels,
    mixed_styles,
    style_levels,
)
from gesturekit.multires.sampling.trained_model import (
    RandomNoise,
    ZStarPatches,
)
from gesturekit.multires.training.data import TrainingData
from gesturekit.multires.training.sequences import PairedSequence
from gesturekit.multires.training.state import TrainingState


@dataclass(frozen=True)
class Windows:
    """N windows of one length, ready for the levels of a stage.

    Attributes:
        coarser: (N, D, T) output of the level below the stage; None at the first level.
        noise: (N, 1, T_i) for each level of the stage, or None for no noise.
        conditions: (N, S + K, T_i) for each level of the stage, speech features and one-hot
            styles; no channels without conditions.
        speech: (N, S, T_i) the same features, not residual, for the arm-speed loss of random
            steps; None if it is not used.
        targets: (N, D, T_i) recorded motion; None for random steps.
        styles: (N, L) number of the style at each level of the pyramid; 0 without styles.
    """

    coarser: Tensor | None
    noise: tuple[Tensor | None, ...]
    conditions: tuple[Tensor, ...]
    speech: tuple[Tensor, ...] | None
    targets: tuple[Tensor, ...] | None
    styles: Tensor

    def __len__(self) -> int:
        return len(self.styles)

    def take(self, index: Tensor) -> Windows:
        """Return the windows with these numbers, (B,)."""

        def chosen(parts: Sequence[Tensor | None]) -> tuple:
            return tuple(None if part is None else part[index] for part in parts)

        return Windows(
            coarser=None if self.coarser is None else self.coarser[index],
            noise=chosen(self.noise),
            conditions=chosen(self.conditions),
            speech=None if self.speech is None else chosen(self.speech),
            targets=None if self.targets is None else chosen(self.targets),
            styles=self.styles[index],
        )


class WindowCache:
    """Draw the windows that a stage trains on, and generate their coarser levels."""

    def __init__(
        self,
        data: TrainingData,
        config: MultiresConfig,
        network: MultiresGenerator,
        convolve: Convolve = convolve_dense,
        state: TrainingState | None = None,
    ) -> None:
        self.data = data
        self.state = state
        self.config = config
        self.network = network
        self.convolve = convolve
        self.device = next(network.parameters()).device
        self.noise = random_noise(data, config, config.network.levels)
        self.columns = data.conditions(config).columns

    def random(
        self,
        sequences: Sequence[PairedSequence],
        n_frames: int,
        first: int,
        count: int,
        rng: torch.Generator,
    ) -> Windows:
        """Return windows for random-generation steps: unpaired speech, new noise, no targets.

        Coarse levels have styles of these sequences, which are also the discriminator's real
        motions. The windows are `random_margin` frames longer at both ends.
        """
        training, margin = self.config.training, self.config.random_margin
        speech = torch.stack([self.data.speech_window(n_frames, margin, rng) for _ in range(count)])
        n_frames += 2 * margin
        quiet = torch.rand(count, generator=rng) < training.silence
        speech[quiet] = self.data.silence[:, :n_frames]
        lengths = af.level_lengths(n_frames, self.config.network.levels)
        noises = self.noise.gaussian(lengths, lambda _: rng, count=count)
        styles = torch.zeros(count, len(lengths), dtype=torch.long)
        if self.config.styles is not None:
            levels, mixing = self.config.network.levels, self.config.styles.mixing
            styles = mixed_styles(
                self.data.style_shares(sequences),
                self.data.style_shares(self.data.paired),
                count,
                levels,
                mixing,
                rng,
            )
        coarsest = styles[:, :1].expand(-1, lengths[0]).tolist()
        noises[0] = self.noise.shuffled(noises[0], coarsest, rng)
        state = None
        if self.state is not None:
            state = self.state.random(speech, styles[:, 0].tolist(), rng)
            noises = self.data.clocked_noises(state, lengths, self.noise.sigma)
        return self._windows(n_frames, first, speech, styles, noises, None, state)

    def paired(
        self,
        sequences: Sequence[PairedSequence],
        n_frames: int,
        first: int,
        count: int,
        rng: torch.Generator,
    ) -> Windows:
        """Return `count` windows for reconstruction steps: paired speech, z*, recorded motion.

        If there are fewer windows than that, all are returned: a whole sequence has only one.
        """
        lengths = af.level_lengths(n_frames, self.config.network.levels)
        speech, motion, z_star, styles, states = [], [], [], [], []
        starts = sum(sequence.n_frames - n_frames + 1 for sequence in sequences)
        if starts > count:
            windows = random_windows(sequences, n_frames, count, rng)
        else:
            windows = every_window(sequences, n_frames)
        for sequence, start in windows:
            speech.append(sequence.speech[:, start : start + n_frames])
            motion.append(sequence.motion[:, start : start + n_frames])
            z_star.append(sequence.z_star_window(start, lengths[0]))
            styles.append([sequence.style] * len(lengths))
            if self.state is not None:
                states.append(self.state.recorded(sequence)[:, start : start + n_frames])
        state = np.stack(states) if states else None
        return self._windows(
            n_frames,
            first,
            torch.stack(speech),
            torch.tensor(styles),
            [torch.stack(z_star), *([None] * (len(lengths) - 1))]
            if state is None
            else self.data.clocked_noises(state, lengths, self.noise.sigma),
            torch.stack(motion),
            state=state,
        )

    def reals(
        self,
        sequences: Sequence[PairedSequence],
        n_frames: int,
        first: int,
        count: int,
        rng: torch.Generator,
        styles: Sequence[int] | None = None,
    ) -> list[Tensor]:
        """Return recorded motion (B, D, T_i) for the discriminator of each level of the stage.

        Args:
            sequences: recordings to draw from.
            n_frames: length of a window.
            first: index of the first level of the stage.
            count: B.
            rng: random generator.
            styles: number of the style of each motion; None for any.
        """
        lengths = af.level_lengths(n_frames, self.config.network.levels)[first : first + 2]
        if styles is None:
            windows = list(random_windows(sequences, n_frames, count, rng))
        else:
            windows = []
            for style in styles:
                own = [sequence for sequence in sequences if sequence.style == style]
                windows += random_windows(own, n_frames, 1, rng)
        motions = [sequence.motion[:, start : start + n_frames] for sequence, start in windows]
        return [torch.stack([resample(m, n) for m in motions]).to(self.device) for n in lengths]

    @torch.no_grad()
    def _windows(
        self,
        n_frames: int,
        first: int,
        speech: Tensor,
        styles: Tensor,
        noises: list[Tensor | None],
        motion: Tensor | None,
        state: np.ndarray | None = None,
    ) -> Windows:
        """Return windows of T frames with the output of the levels coarser than `first`.

        `speech` is (N, S, T), `styles` (N, L), each of `noises` (N, 1 or D, T_i), `motion` (N, D,
        T), `state` (N, C, T).
        """
        lengths = af.level_lengths(n_frames, self.config.network.levels)
        one_hot = []
        if self.data.styles:
            one_hot = style_levels(styles, len(self.data.styles), lengths)
        features = speech[:, self.columns]
        states = [] if state is None else self.data.state_levels(state, lengths)
        conditions = condition_levels(features, lengths, self.config.residual, one_hot, states)
        to = self.device
        conditions = [level.to(to) for level in conditions]
        noises = [None if noise is None else noise.to(to) for noise in noises]
        coarser = None
        if first and motion is not None and self.config.losses.rec_input == "real":
            coarser = resample(motion.to(to), lengths[first - 1])
        elif first:
            coarser = torch.cat(
                [
                    self.network(
                        [None if n is None else n[part] for n in noises[:first]],
                        [level[part] for level in conditions[:first]],
                        lengths=lengths[:first],
                        convolve=self.convolve,
                    )[-1]
                    for part in _batches(len(speech), self.config.training.batch)
                ]
            )
        here = slice(first, first + 2)
        return Windows(
            coarser=coarser,
            noise=tuple(noises[here]),
            conditions=tuple(conditions[here]),
            speech=tuple(resample(speech.to(to), n) for n in lengths[here])
            if motion is None and self.config.uses_arm_speed
            else None,
            targets=None
            if motion is None
            else tuple(resample(motion.to(to), n) for n in lengths[here]),
            styles=styles.to(to),
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


def random_part(motion: Tensor, n_frames: int, rng: torch.Generator) -> Tensor:
    """Return `n_frames` consecutive frames of a motion (B, D, T) that has at least as many."""
    slack = motion.shape[-1] - n_frames
    start = int(torch.randint(slack + 1, (), generator=rng)) if slack else 0
    return motion[..., start : start + n_frames].contiguous()


def every_window(
    sequences: Sequence[PairedSequence], n_frames: int
) -> Iterator[tuple[PairedSequence, int]]:
    """Yield sequence and start frame of all windows."""
    for sequence in sequences:
        for start in range(sequence.n_frames - n_frames + 1):
            yield sequence, start


def _batches(n: int, size: int) -> Iterator[slice]:
    """Return slices of `size` items that cover n items."""
    return (slice(start, start + size) for start in range(0, n, size))
