"""State of movement in training: measured in recordings, drawn for random steps, held by a loss.

The state of a random step is new for each window, see `TrainingState.random`. A recording's
carriers, and the noise of level 1 that is made of them, are always the same, as its z* is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import cycle

import numpy as np
import torch
from torch import Tensor, nn

import audio_features as af
from gesturekit.multires import losses
from gesturekit.multires.config import MultiresConfig
from gesturekit.multires.kinematics import VectorKinematics
from gesturekit.multires.network.resampling import resample
from gesturekit.multires.sampling.conditions import style_levels
from gesturekit.multires.sampling.trained_model import Pyramid, TrainedModel, clocked_noise
from gesturekit.multires.training.data import TrainingData
from gesturekit.multires.training.sequences import PairedSequence
from gesturekit.state.channels import averaged
from gesturekit.state.process import RecordedState, StateProcess
from gesturekit.training.seeds import rng_for

_LEAST_FRAMES = 4
"""Frames of a recording at a level from which its state is measured there."""
_RECORDED, _LIVELINESS = 0.5, 0.3
"""Share of recorded states in random steps, and the most that is added to or taken from their
movement, see `TrainingState.random`."""
_CALIBRATIONS, _CALIBRATION_SECONDS = 4, 180.0
"""Rounds of calibration, and the seconds of motion that each makes."""


class TrainingState:
    """State of the training recordings, and the process from which random steps draw.

    Args:
        data: recordings.
        config: of the run.

    Attributes:
        process: fitted to the recordings.
    """

    def __init__(self, data: TrainingData, config: MultiresConfig) -> None:
        self.data, self.seed = data, config.seed
        self._kinematics = VectorKinematics(data.representation, config.fps, arms=False)
        self._values = {sequence.name: self._measured(sequence) for sequence in data.sample}
        recordings = [
            RecordedState(
                self._values[sequence.name],
                sequence.speech[:, :].numpy(),
                sequence.take,
                (sequence.speaker, sequence.style if data.styles else None),
            )
            for sequence in data.sample
        ]
        channels, conditioner = data.state_channels, data.conditioner
        self.process = StateProcess.fit(channels, recordings, config.fps, conditioner)
        self._recorded: dict[str, np.ndarray] = {}

    def recorded(self, sequence: PairedSequence) -> np.ndarray:
        """Return the condition (C, T) of a recording."""
        if sequence.name not in self._recorded:
            seed = rng_for(self.seed, "carriers", sequence.name).initial_seed() >> 1
            values = self._values.get(sequence.name)
            values = self._measured(sequence) if values is None else values
            self._recorded[sequence.name] = self.process.condition(seed, values)
        return self._recorded[sequence.name]

    def with_voice(self, sequence: PairedSequence) -> np.ndarray:
        """Return the channels of a recording and its voice activity, (C + 1, T)."""
        speech = sequence.speech[:, :].numpy()
        return self.process.with_voice(self._values[sequence.name], speech)

    def drawn(self, speech: Tensor, style: int, rng: torch.Generator) -> np.ndarray:
        """Return the condition (1, C, T) of a motion to speech (S, T), as in generation."""
        seed = int(torch.randint(2**62, (), generator=rng))
        return self.process.condition(seed, self._draw(seed, speech, style))[None]

    def random(self, speech: Tensor, styles: Sequence[int], rng: torch.Generator) -> np.ndarray:
        """Return conditions (N, C, T) for windows of speech (N, S, T) with these styles (N).

        About half are drawn, as in generation, and half are recorded, with new carriers: channels
        that are drawn do not agree as recorded ones do. All are made calmer or livelier, so that
        the network follows speeds that are unusual for the rest of the state.
        """
        conditions = []
        for window, style in zip(speech, styles, strict=True):
            seed = int(torch.randint(2**62, (), generator=rng))
            share, shift = torch.rand(2, generator=rng).tolist()
            values = self._window(window.shape[1], style, rng) if share < _RECORDED else None
            if values is None:
                values = self._draw(seed, window, style)
            values[self.process.channels.movement] += _LIVELINESS * (2 * shift - 1)
            conditions.append(self.process.condition(seed, values))
        return np.stack(conditions)

    def _draw(self, seed: int, speech: Tensor, style: int) -> np.ndarray:
        """Draw the channels (C, T) of a motion to speech (S, T)."""
        group = (None, style if self.data.styles else None)
        return self.process.draw(seed, speech.numpy(), group)

    def _window(self, n_frames: int, style: int, rng: torch.Generator) -> np.ndarray | None:
        """Return recorded channels (C, n_frames) of a style; None if no recording is as long."""
        known = [
            self._values[own.name]
            for own in self.data.sample
            if own.n_frames >= n_frames and (not self.data.styles or own.style == style)
        ]
        if not known:
            return None
        starts = torch.tensor([float(values.shape[1] - n_frames + 1) for values in known])
        chosen = int(torch.multinomial(starts, 1, generator=rng))
        start = int(torch.randint(int(starts[chosen]), (), generator=rng))
        return known[chosen][:, start : start + n_frames].copy()

    def calibrated(self, model: TrainedModel) -> StateProcess:
        """Return the process for a trained model, see `StateProcess.calibrated`."""
        process = self.process
        for number in range(_CALIBRATIONS):
            seconds, pairs = 0.0, list[tuple[np.ndarray, np.ndarray]]()
            for sequence in cycle(self.data.sample):
                key = ("calibration", number, len(pairs))
                seed = rng_for(self.seed, *key).initial_seed() >> 1
                speech = sequence.speech[:, :].numpy()
                style = sequence.style if self.data.styles else None
                drawn = process.draw(seed, speech, (sequence.speaker, style))
                condition = process.condition(seed, drawn)
                pairs.append((drawn, self._made(model, condition, speech, style)))
                seconds += sequence.n_frames / process.fps
                if seconds > _CALIBRATION_SECONDS:
                    break
            wanted, shown = (np.concatenate(rows, axis=1) for rows in zip(*pairs, strict=True))
            process = process.calibrated(wanted, shown)
        return process

    @torch.no_grad()
    def _made(
        self, model: TrainedModel, state: np.ndarray, speech: np.ndarray, style: int | None
    ) -> np.ndarray:
        """Return the channels (C, T) of a motion that is made of a condition (C + H + 4 H, T)."""
        lengths = af.level_lengths(state.shape[1], model.network_config.levels)
        styles = []
        if style is not None:
            numbers = torch.full((1, len(lengths)), style)
            styles = style_levels(numbers, len(model.styles), lengths)
        sigma = model.noise.sigma.mean(dim=0)[0]
        noise = clocked_noise(state[None], self.process.channels.n_carriers, lengths[0], sigma)
        condition = model.conditions.of_motion(speech.T, lengths, styles, (), state)
        values = Pyramid(model, lengths, condition).from_noise(noise)
        return self._channels(torch.from_numpy(values.T[None]).float())

    @torch.no_grad()
    def _measured(self, sequence: PairedSequence) -> np.ndarray:
        """Return the channels (C, T) of a recording, in their own units."""
        return self._channels(self.data.normaliser.inverse(sequence.motion[:, :][None]))

    def _channels(self, values: Tensor) -> np.ndarray:
        """Return the channels (C, T) of motion vectors (1, D, T)."""
        places = self._kinematics.places(values)
        return self.data.state_channels(places, self._kinematics.fps)[0].double().numpy()


class StateTarget(nn.Module):
    """State of movement that a level should show, given the state of the whole motion.

    A coarse level moves less than the finest one, and shows little of the fast movement: a line for
    each channel, fitted to the recordings, tells what it shows, and the share of the variance that
    the line explains tells how much the channel counts there.

    Args:
        state: of the recordings.
        level: index of the level.
        levels: L.
        places: converts normalised motion (B, D, T) to joint positions (B, K, 3, T), metres.
    """

    line: Tensor
    weight: Tensor

    def __init__(
        self, state: TrainingState, level: int, levels: int, places: Callable[[Tensor], Tensor]
    ) -> None:
        super().__init__()
        self.channels, fps = state.process.channels, state.process.fps
        self.fps = fps
        given, shown = [], []
        for sequence in state.data.sample:
            n_frames = af.level_lengths(sequence.n_frames, levels)[level]
            if n_frames < _LEAST_FRAMES:
                continue
            self.fps = fps * n_frames / sequence.n_frames
            own = averaged(state.recorded(sequence)[: len(self.channels.names)], n_frames)
            given.append(torch.from_numpy(own))
            motion = resample(sequence.motion[:, :][None], n_frames)
            shown.append(self.channels(places(motion).cpu(), self.fps)[0])
        if not given:  # nothing is asked of levels of so few frames
            given = shown = [torch.zeros(len(self.channels.names), _LEAST_FRAMES)]
        self.register_buffer("line", torch.from_numpy(_lines(given, shown)).float()[..., None])
        slope, _, size = self.line
        counts = torch.from_numpy(self.channels.counts).float()[:, None]
        together = torch.cat(given, dim=1)
        explained = (slope * together.std(dim=1, keepdim=True) / size).square().clamp(max=1.0)
        self.register_buffer("weight", counts * explained / size)

    def forward(self, places: Tensor, state: Tensor) -> Tensor:
        """Return the loss () of joint positions (B, K, 3, T), metres, of a state (B, C, T)."""
        slope, offset, _ = self.line
        return losses.state(self.channels(places, self.fps), slope * state + offset, self.weight)


def _lines(given: Sequence[Tensor], shown: Sequence[Tensor]) -> np.ndarray:
    """Return slope and offset of the least-squares line of each channel, and its deviation, (3, C).

    Args:
        given: (C, T_k) of each recording.
        shown: (C, T_k), to be predicted from it.
    """
    x, y = (torch.cat(list(parts), dim=1).double().numpy() for parts in (given, shown))
    mean = y.mean(axis=1)
    away = x - x.mean(axis=1, keepdims=True)
    slope = (away * y).mean(axis=1) / np.maximum(np.square(away).mean(axis=1), 1e-9)
    return np.stack([slope, mean - slope * x.mean(axis=1), np.maximum(y.std(axis=1), 1e-3)])


def state_targets(
    state: TrainingState | None,
    indices: Sequence[int],
    config: MultiresConfig,
    places: Callable[[Tensor], Tensor],
    device: torch.device,
) -> dict[int, StateTarget]:
    """Return {index: target} of these levels; none without `losses.state`.

    Arguments are as for `StateTarget`.
    """
    if not config.losses.state or state is None:
        return {}
    levels = config.network.levels
    return {i: StateTarget(state, i, levels, places).to(device) for i in indices}
