"""State of movement in training: measured in recordings, drawn for random steps.

The state of a random step is new for each window, see `TrainingState.random`. A recording's
carriers, and the noise of level 1 that is made of them, are always the same, as its z* is.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import cycle

import numpy as np
import torch
from torch import Tensor

from gesturekit.multires.config import MultiresConfig
from gesturekit.multires.kinematics import VectorKinematics, measured_state
from gesturekit.multires.model import MultiresModel
from gesturekit.multires.pyramid import Pyramid, style_levels
from gesturekit.multires.retrieval import RecordedLibrary, RecordedMotion
from gesturekit.multires.training.data import PairedSequence, TrainingData
from gesturekit.state.process import RecordedState, StateProcess
from gesturekit.training.seeds import rng_for

_RECORDED, _LIVELINESS = 0.5, 0.3
"""Share of recorded states in random steps, and the most that is added to or taken from their
movement, see `TrainingState.random`."""
_CALIBRATIONS, _CALIBRATION_SECONDS = 4, 180.0
"""Rounds of calibration, and the seconds of motion that each makes."""
_MOST_SECONDS, _MOST_PASSIVE_SECONDS = 1200.0, 300.0
"""Seconds of recorded motion in a model: whole bodies, or fingers and faces. Of more, the same
share of each recording is kept."""
_LEAST_SECONDS = 4.0
"""Seconds of each recording that are kept at least: the length of a piece."""


class TrainingState:
    """State of the training recordings, and the process from which random steps draw.

    Args:
        data: recordings.
        config: of the run.

    Attributes:
        process: fitted to the recordings.
    """

    def __init__(self, data: TrainingData, config: MultiresConfig) -> None:
        self.data, self.config, channels = data, config, data.conditions.state
        assert channels is not None
        self._channels = channels
        self._kinematics = VectorKinematics(data.representation, config.fps, arms=False)
        self._values = {sequence.name: self._measured(sequence) for sequence in data.sample}
        recordings = [
            RecordedState(
                self._values[sequence.name],
                sequence.speech[:, :].numpy(),
                sequence.take,
                (sequence.speaker, sequence.style if data.conditions.styles else None),
            )
            for sequence in data.sample
        ]
        conditioner = data.conditions.conditioner
        self.process = StateProcess.fit(channels, recordings, config.fps, conditioner)
        self._recorded: dict[str, np.ndarray] = {}

    def recorded(self, sequence: PairedSequence) -> np.ndarray:
        """Return the condition (C, T) of a recording."""
        if sequence.name not in self._recorded:
            seed = rng_for(self.config.seed, "carriers", sequence.name).initial_seed() >> 1
            values = self._values.get(sequence.name)
            values = self._measured(sequence) if values is None else values
            self._recorded[sequence.name] = self.process.condition(seed, values)
        return self._recorded[sequence.name]

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
        group = (None, style if self.data.conditions.styles else None)
        return self.process.draw(seed, speech.numpy(), group)

    def _window(self, n_frames: int, style: int, rng: torch.Generator) -> np.ndarray | None:
        """Return recorded channels (C, n_frames) of a style; None if no recording is as long."""
        known = [
            self._values[sequence.name]
            for sequence in self.data.sample
            if sequence.n_frames >= n_frames
            and (not self.data.conditions.styles or sequence.style == style)
        ]
        if not known:
            return None
        starts = torch.tensor([float(values.shape[1] - n_frames + 1) for values in known])
        chosen = int(torch.multinomial(starts, 1, generator=rng))
        start = int(torch.randint(int(starts[chosen]), (), generator=rng))
        return known[chosen][:, start : start + n_frames].copy()

    def calibrated(self, model: MultiresModel) -> StateProcess:
        """Return the process for a trained model, see `StateProcess.calibrated`."""
        process = self.process
        for number in range(_CALIBRATIONS):
            seconds, pairs = 0.0, list[tuple[np.ndarray, np.ndarray]]()
            for sequence in cycle(self.data.sample):
                key = ("calibration", number, len(pairs))
                seed = rng_for(self.config.seed, *key).initial_seed() >> 1
                speech = sequence.speech[:, :].numpy()
                style = sequence.style if self.data.conditions.styles else None
                drawn = process.draw(seed, speech, (sequence.speaker, style))
                condition = process.condition(seed, drawn)
                pairs.append((drawn, self._made(model, condition, speech, style)))
                seconds += sequence.n_frames / process.fps
                if seconds > _CALIBRATION_SECONDS:
                    break
            wanted, shown = (np.concatenate(rows, axis=1) for rows in zip(*pairs, strict=True))
            process = process.calibrated(wanted, shown)
        return process

    def library(self) -> RecordedLibrary | None:
        """Return what a model plays; None if its network makes all that moves in the recordings."""
        data, config = self.data, self.config
        if data.passive.is_empty and not config.retrieval:
            return None
        total = sum(sequence.n_frames for sequence in data.sample) / config.fps
        most = _MOST_SECONDS if config.retrieval else _MOST_PASSIVE_SECONDS
        recordings = []
        for sequence in data.sample:
            share = round(sequence.n_frames * min(1.0, most / total))
            n_frames = min(sequence.n_frames, max(share, round(_LEAST_SECONDS * config.fps)))
            start = (sequence.n_frames - n_frames) // 2
            frames = slice(start, start + n_frames)
            speech = sequence.speech[:, :].numpy()
            state = self.process.with_voice(self._values[sequence.name], speech)[:, frames]
            motion = sequence.motion[:, frames].contiguous()
            recordings.append(
                RecordedMotion(
                    state=torch.from_numpy(state.astype(np.float32)),
                    motion=motion if config.retrieval else motion[:0],
                    passive=sequence.passive[:, frames].contiguous(),
                    speaker=sequence.speaker,
                    style=sequence.style,
                )
            )
        return RecordedLibrary(config.fps, data.passive, tuple(recordings))

    def _made(
        self, model: MultiresModel, state: np.ndarray, speech: np.ndarray, style: int | None
    ) -> np.ndarray:
        """Return the channels (C, T) of a motion that is made of a condition (C + H + 4 H, T)."""
        lengths, styles = model.network_config.lengths(state.shape[1]), list[Tensor]()
        if style is not None:
            numbers = torch.full((1, len(lengths)), style)
            styles = style_levels(numbers, len(model.styles), lengths)
        condition = model.conditions.of_motion(speech.T, lengths, styles, (), state)
        pyramid = Pyramid(model, lengths, condition, partial(rng_for, self.config.seed))
        return measured_state(pyramid.random(), model.representation, self._channels, model.fps)

    @torch.no_grad()
    def _measured(self, sequence: PairedSequence) -> np.ndarray:
        """Return the channels (C, T) of a recording, in their own units."""
        places = self._kinematics.places(self.data.normaliser.inverse(sequence.motion[:, :][None]))
        return self._channels(places, self.config.fps)[0].double().numpy()
