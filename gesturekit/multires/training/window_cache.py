"""Windows whose coarser levels are generated beforehand.

While two levels train, all coarser ones are finished: what they generate from given noise and
speech does not change. A bank holds it for many windows at once, so that a training step only
runs the levels it trains. Every window is drawn from (seed, pair, renewal), so that a resumed run
makes the same bank again.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

import audio_features as af
from gesturekit.multires.config import MultiresConfig
from gesturekit.multires.network.generator import MultiresGenerator
from gesturekit.multires.network.resampling import resample
from gesturekit.multires.network.skeleton_conv import Convolve, convolve_dense
from gesturekit.multires.sampling.noise import Recall
from gesturekit.multires.sampling.styles import mixed_styles, style_levels
from gesturekit.multires.training.data import PairedSequence, TrainingData


@dataclass(frozen=True)
class Windows:
    """N windows of one length, ready for the levels of a pair.

    Attributes:
        coarser: (N, D, T) what the level below the pair generated; None at the first level.
        noise: noise for each level of the pair, (N, 1, T_i) or None for none at all.
        conditions: (N, S + K, T_i) residual speech features and one-hot styles for each level of
            the pair; no channels at all where there is no condition.
        speech: (N, S, T_i) the same speech, not residual, for the arm-speed loss of random steps;
            None where nothing asks for it.
        targets: (N, D, T_i) recorded motion; None on random steps, which have none.
        styles: (N, L) number of the style at each level of all; 0 where there are none.
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
        """The windows at these numbers, (B,)."""

        def rows(parts: Sequence[Tensor | None]) -> tuple:
            return tuple(None if part is None else part[index] for part in parts)

        return Windows(
            coarser=None if self.coarser is None else self.coarser[index],
            noise=rows(self.noise),
            conditions=rows(self.conditions),
            speech=None if self.speech is None else rows(self.speech),
            targets=None if self.targets is None else rows(self.targets),
            styles=self.styles[index],
        )


def condition_levels(
    speech: Tensor, lengths: Sequence[int], residual: bool, styles: Sequence[Tensor] = ()
) -> list[Tensor]:
    """(B, S, T) speech and (B, K, T_i) styles to the (B, S + K, T_i) that each level is told."""
    heard = _speech_levels(speech, lengths, residual)
    if not styles:
        return heard
    return [torch.cat(parts, dim=1) for parts in zip(heard, styles, strict=True)]


def _speech_levels(speech: Tensor, lengths: Sequence[int], residual: bool) -> list[Tensor]:
    batch, width, n_frames = speech.shape
    if not residual or not width:
        return [resample(speech, n) for n in lengths]
    flat = speech.permute(2, 0, 1).reshape(n_frames, batch * width).numpy()
    return [
        torch.from_numpy(level).float().reshape(-1, batch, width).permute(1, 2, 0)
        for level in af.residual_pyramid(flat, lengths)
    ]


class Bank:
    """Makes the windows that a pair of levels trains on."""

    def __init__(
        self,
        data: TrainingData,
        config: MultiresConfig,
        network: MultiresGenerator,
        convolve: Convolve = convolve_dense,
    ) -> None:
        self.data = data
        self.config = config
        self.network = network
        self.convolve = convolve
        self.device = next(network.parameters()).device
        self.sigma = torch.stack([sequence.sigma for sequence in data.paired]).mean(dim=0)
        self.recall = recall(data, config)

    def random(
        self,
        sequences: Sequence[PairedSequence],
        n_frames: int,
        first: int,
        count: int,
        rng: torch.Generator,
    ) -> Windows:
        """Windows for random-generation steps: unpaired speech, fresh noise, no recorded motion.

        They begin with a style of one of these recordings, beside which a discriminator sees them,
        and are `random_margin` longer at either end.
        """
        n_frames += 2 * self.config.random_margin
        training = self.config.training
        speech = torch.stack([self.data.speech_window(n_frames, rng) for _ in range(count)])
        quiet = torch.rand(count, generator=rng) < training.silence
        speech[quiet] = self.data.silence[:, :n_frames]
        lengths = af.level_lengths(n_frames, self.config.network.levels)
        noises = [
            torch.randn(count, 1, n, generator=rng) * sigma
            for n, sigma in zip(lengths, self.sigma, strict=True)
        ]
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
        if self.recall is not None:
            noises[0] = torch.cat(
                [self.recall([own] * lengths[0], rng) for own in styles[:, 0].tolist()]
            )
        return self._windows(n_frames, first, speech, styles, noises, None)

    def paired(
        self,
        sequences: Sequence[PairedSequence],
        n_frames: int,
        first: int,
        count: int,
        rng: torch.Generator,
    ) -> Windows:
        """Windows for reconstruction steps: paired speech, z*, and the recorded motion.

        `count` of them, or every one there is where that is fewer: a whole sequence has one.
        """
        lengths = af.level_lengths(n_frames, self.config.network.levels)
        speech, motion, z_star, styles = [], [], [], []
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
        return self._windows(
            n_frames,
            first,
            torch.stack(speech),
            torch.tensor(styles),
            [torch.stack(z_star), *([None] * (len(lengths) - 1))],
            torch.stack(motion),
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
        """Recorded motion (B, D, T_i) for the discriminators of the pair, of these styles."""
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
    ) -> Windows:
        lengths = af.level_lengths(n_frames, self.config.network.levels)
        told = []
        if self.data.styles:
            told = style_levels(styles, len(self.data.styles), lengths)
        conditions = condition_levels(speech, lengths, self.config.residual, told)
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
                        [None if noise is None else noise[part] for noise in noises[:first]],
                        [level[part] for level in conditions[:first]],
                        lengths=lengths[:first],
                        convolve=self.convolve,
                    )[-1]
                    for part in _chunks(len(speech), self.config.training.batch)
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


def recall(data: TrainingData, config: MultiresConfig) -> Recall | None:
    """What random noise is put together from; None where it is drawn anew."""
    if not config.z_star_shuffle:
        return None
    z_stars = [sequence.z_star for sequence in data.paired]
    return Recall(z_stars, [sequence.style for sequence in data.paired], config.z_star_shuffle)


def random_windows(
    sequences: Sequence[PairedSequence], n_frames: int, count: int, rng: torch.Generator
) -> Iterator[tuple[PairedSequence, int]]:
    """Sequences and start frames of random windows, every start equally likely."""
    room = torch.tensor([float(sequence.n_frames - n_frames + 1) for sequence in sequences])
    for which in torch.multinomial(room, count, replacement=True, generator=rng).tolist():
        yield sequences[which], int(torch.randint(int(room[which]), (), generator=rng))


def every_window(
    sequences: Sequence[PairedSequence], n_frames: int
) -> Iterator[tuple[PairedSequence, int]]:
    """Sequences and start frames of all windows, each once."""
    for sequence in sequences:
        for start in range(sequence.n_frames - n_frames + 1):
            yield sequence, start


def _chunks(n: int, size: int) -> Iterator[slice]:
    return (slice(start, start + size) for start in range(0, n, size))
