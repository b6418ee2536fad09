"""State of movement while the person speaks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from gesturekit.state.process import StateProcess
from gesturekit.training.seeds import rng_for


@dataclass(frozen=True)
class LiveChoice:
    """Inputs of a stream beside the speech.

    Attributes:
        seed: of the random numbers.
        item: name of the stream.
        speaker: whose movement to draw; None for all.
        style: number of the style; None for any.
        liveliness: factor on the hand speed that is drawn.
        mood_seed: seed of the state of movement; None for `seed`.
    """

    seed: int = 0
    item: str = ""
    speaker: str | None = None
    style: int | None = None
    liveliness: float = 1.0
    mood_seed: int | None = None

    @cached_property
    def noise_seed(self) -> int:
        """Seed of the noise of the state of movement."""
        seed = self.seed if self.mood_seed is None else self.mood_seed
        return rng_for(seed, self.item, "live", "mood").initial_seed() >> 1


@dataclass(frozen=True, eq=False)
class Forecast:
    """Predicted fast movement.

    Attributes:
        seconds: (H,) from now, ascending from 0.
        values: (H,) log m/s.
        r: correlation of the first with recorded movement.
        shares: (H,) how much is known of what the whole sound tells.
    """

    seconds: np.ndarray
    values: np.ndarray
    r: float
    shares: np.ndarray


class LiveState:
    """Drawn state of movement of a window around the current frame.

    What was drawn for a frame when it was the current one stays. The frames to come have the same
    noise at each step, as it depends on time alone, and what is known of the speech so far.

    Args:
        process: from which it is drawn.
        choice: seeds, speaker, style and liveliness.
        around: frames of the window before the current one, and from it on.
    """

    def __init__(self, process: StateProcess, choice: LiveChoice, around: int) -> None:
        self._process, self._choice, self._around = process, choice, around
        self._seed = rng_for(choice.seed, choice.item, "live", "carriers").initial_seed() >> 1
        self._frame = -1
        self._noise = np.empty((len(process.mean), 0))
        self._values = np.empty((len(process.mean), 2 * around))
        self._clocks = np.zeros((len(process.channels.of_hands), 2 * around))

    def state(self) -> dict[str, Any]:
        """Return what `restore` needs."""
        return {name: getattr(self, name) for name in _STATE}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from the `state` of one with the same arguments."""
        for name in _STATE:
            setattr(self, name, state[name])

    def advance(self, speech: np.ndarray, fast: Forecast | None, slow: float | None) -> np.ndarray:
        """Go on by a motion frame and return the condition (C + H + 4 H, T) of the window.

        Args:
            speech: (T, S) features of the window, as far as they are known.
            fast: fast movement; None without prediction.
            slow: slow movement, in standard deviations.
        """
        self._frame += 1
        process, around, begun = self._process, self._around, self._frame > 0
        first = self._frame - around
        missing = 2 * around - self._noise.shape[1] + begun
        last = first + 2 * around
        new = process.noise(self._choice.noise_seed, np.arange(last - missing, last))
        self._noise = np.concatenate([self._noise[:, begun:], new], axis=1)
        # Before the first frame all is drawn as if nothing had been said.
        kept = around if begun else 0
        self._values = np.roll(self._values, -1, axis=1)
        self._values[:, kept:] = self._drawn(speech, fast, slow)[:, kept:]
        clocks = np.roll(self._clocks, -1, axis=1)
        steps = process.clocks(self._values)[:, kept:]
        clocks[:, kept:] = np.cumsum(steps, axis=1) + (clocks[:, [kept - 1]] if begun else 0.0)
        self._clocks = clocks
        return process.condition(self._seed, self._values, clocks)

    @property
    def coming(self) -> np.ndarray:
        """(C, T / 2) the channels of the current frame, and of those to come."""
        return self._values[:, self._around :]

    def _drawn(self, speech: np.ndarray, fast: Forecast | None, slow: float | None) -> np.ndarray:
        """Return the channels (C, T) of the window; arguments as for `advance`."""
        predicted, known = None, np.zeros(2 * self._around)
        if fast is not None and slow is not None:
            seconds = np.maximum(np.arange(-self._around, self._around) / self._process.fps, 0.0)
            known = np.interp(seconds, fast.seconds, fast.shares, right=0.0)
            values = np.interp(seconds, fast.seconds, fast.values / np.maximum(fast.shares, 1e-6))
            predicted = values, np.full(len(known), slow)
        return self._process.values(
            self._noise,
            self._process.voices(speech.T),
            predicted,
            group=(self._choice.speaker, self._choice.style),
            liveliness=self._choice.liveliness,
            known=known,
        )


_STATE = ("_frame", "_noise", "_values", "_clocks")
