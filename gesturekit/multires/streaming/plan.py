"""Choice of recorded pieces while the person speaks."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gesturekit.multires.recall.library import LEAST_R, RecallLibrary
from gesturekit.multires.recall.pieces import TAPS, spline_weights
from gesturekit.training.seeds import rng_for

# Chosen for sync without jumps on held-out ZeroEGGS takes: the weight of continuity, the factor on
# movement and the time for which a prediction counts on 003 and 067, the others on 067 and 001
# (benchmarks/RESULTS.md, bench_live).
_PIECE, _OVERLAP = 1.0, 0.5
"""Seconds over which pieces are compared, and of the cross-fade into one. After their difference
the next one is chosen, most often the continuation."""
_FACTORS = {"continuity": 100.0, "movement": 8.0, "chance": 0.1}
"""Factors on the library's `ChoiceWeights`. Pieces are shorter than offline: they are chosen more
often, each by the little movement that is predicted, and change no more often than needed: while
one fades into another, a hand cannot rest."""
_KNOWN_SECONDS = 0.6
"""The last prediction counts for this long: pieces are chosen for all of their first half."""
_FASTEST = 3.0
"""Arms play at most so much faster, or slower, than recorded."""
_TEMPO_SECONDS = 0.05
"""Time constant of changes of that speed; hands have mass."""
_KEPT = 4
"""Pieces of a part that are remembered, for the frames before the current one."""
_TAPS = np.array(TAPS)[:, None, None]
_NOW = np.zeros(1)
"""The current motion frame (M = 1), relative to itself."""


@dataclass(frozen=True)
class LiveChoice:
    """Inputs of the choice of pieces, beside the speech.

    Attributes:
        seed: of the noise.
        item: name of the stream.
        speaker: whose recordings to use; None for all.
        style: number of the style; None for any.
        liveliness: factor on the hand speed that is drawn.
        mood_seed: seed of the slow state; None for `seed`.
    """

    seed: int = 0
    item: str = ""
    speaker: str | None = None
    style: int | None = None
    liveliness: float = 1.0
    mood_seed: int | None = None

    @cached_property
    def noise_seed(self) -> int:
        """Seed of the noise of the slow state."""
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

    def at(self, seconds: np.ndarray) -> np.ndarray:
        """Return the predictions (M,) at times (M,); NaN where nothing is known."""
        known = seconds <= self.seconds[-1] + _KNOWN_SECONDS
        return np.where(known, np.interp(seconds, self.seconds, self.values), np.nan)


class LivePlan:
    """Recorded pieces of each part of the body, up to now and on.

    Times are in frames of the recalled level. Arms have a clock of their own, the same for both, so
    that two-handed gestures stay together. Its speed gives the pieces the movement that the speech
    predicts: pieces chosen without the speech to come cannot.

    Args:
        library: recordings.
        choice: of pieces.
        past: motion frames of a window before the current one.
    """

    def __init__(self, library: RecallLibrary, choice: LiveChoice, past: int) -> None:
        self.library, self.choice = library, choice
        self._past = past
        weights = {name: by * getattr(library.weights, name) for name, by in _FACTORS.items()}
        self._searches = library.searches_of(_PIECE, _OVERLAP, replace(library.weights, **weights))
        self._passive = library.passive.columns(library.parts)
        self._curves = [_curves(library, i, own) for i, own in enumerate(self._passive)]
        self._lengths = np.array(library.lengths)
        self._first = np.cumsum([0, *library.lengths])
        self._frame = -1
        self._step = library.level_fps / library.fps
        self._clock = self._step * np.arange(-past, 1.0)  # of the arms, at the last frames
        self._used = [np.zeros(search.n_bins) for search in self._searches]
        # Of each part: begin, the same by its clock, recording, and its frame; the latest last.
        self._pieces: list[list[tuple[float, float, int, float]]] = [[] for _ in library.parts]
        self._due = [0.0] * len(library.parts)
        self._log_tempo = 0.0

    def state(self) -> dict[str, Any]:
        """Return what `restore` needs."""
        return {name: getattr(self, name) for name in _STATE}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from the `state` of a plan with the same arguments."""
        for name in _STATE:
            setattr(self, name, state[name])

    def advance(self, fast: Forecast | None, slow: float | None) -> None:
        """Go on by a motion frame.

        Args:
            fast: fast movement; None without prediction.
            slow: slow movement, in standard deviations.
        """
        self._frame += 1
        if self._frame:
            self._clock = np.append(
                self._clock[1:], self._clock[-1] + self._step * self._tempo(fast)
            )
        now = self._frame * self._step
        due = [i for i in range(len(self._due)) if now >= self._due[i]]
        if due:
            seconds = self._frame / self.library.fps
            scores = self.library.slow_state.at(self.choice.noise_seed, seconds, slow)
        for i in due:
            self._due[i] = now + self._searches[i].hop
            self._choose(i, fast, scores)

    def _tempo(self, fast: Forecast | None) -> float:
        """Return the speed of the arms' clock; 1 is as recorded."""
        arms = [i for i, part in enumerate(self.library.parts) if part.is_arm]
        if fast is None or not arms:
            return 1.0
        own = np.mean([self._shown(i, _NOW, "fast") for i in arms])
        # A conditional mean has the right times, but smaller peaks than the pieces have.
        wanted = fast.values[0] / max(fast.r, LEAST_R)
        goal = np.clip(wanted - self.library.spread * own, -math.log(_FASTEST), math.log(_FASTEST))
        share = 1 - math.exp(-1 / (_TEMPO_SECONDS * self.library.fps))
        self._log_tempo += share * (float(goal) - self._log_tempo)
        return math.exp(self._log_tempo)

    def _choose(self, i: int, fast: Forecast | None, scores: np.ndarray) -> None:
        """Choose what a part shows from now on.

        Args:
            i: number of the part.
            fast: see `advance`.
            scores: (C, 1) drawn scores of all slow channels.
        """
        library, search, pieces = self.library, self._searches[i], self._pieces[i]
        allowed = library.allowed(search.piece, 1, self.choice.speaker, self._styles)
        states = library.drawn_states(scores, i, allowed)[0]
        states[0] += math.log(self.choice.liveliness)
        ahead = np.arange(search.piece) / self._step
        wanted = np.full((search.piece, 1), np.nan)
        if fast is not None:
            wanted[:, 0] = fast.at((np.arange(search.piece) + 0.5) / library.level_fps)
            wanted /= library.spread
        if i == 1:
            beside = self._shown(0, ahead, "directions")
            wanted = np.concatenate([wanted, beside], axis=1)
        others = [self._numbers(j, ahead) for j in range(i)]
        shown = round(float(self._numbers(i, _NOW)[0])) if pieces else None
        choice = self.choice
        best = search.following(
            rng_for(choice.seed, choice.item, "live", library.parts[i].name, self._frame),
            wanted,
            states,
            self._used[i],
            allowed=None if allowed is None else allowed[0],
            others=np.stack(others, axis=1) if others else None,
            shown=shown,
        )
        if shown != search.frame[best]:
            begin = self._frame * self._step, float(self._times(i, _NOW)[0])
            pieces.append((*begin, int(search.recording[best]), float(search.start[best])))
            del pieces[:-_KEPT]

    @property
    def _styles(self) -> np.ndarray | None:
        return None if self.choice.style is None else np.array([self.choice.style])

    def _numbers(self, i: int, offsets: np.ndarray) -> np.ndarray:
        """Return the frames (M,) that a part shows, numbered across all recordings."""
        recordings, frames, _ = self._at(i, offsets)
        frames = np.clip(frames[0], 0, self._lengths[recordings[0]] - 1)
        return self._first[recordings[0]] + np.rint(frames)

    def _at(self, i: int, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what a part shows, and what it is faded over from.

        Recordings, frames and weights, (2, M) each, at motion frames (M,) relative to the current
        one.
        """
        columns = zip(*self._pieces[i], strict=True)
        begins, clocks, recordings, frames = (np.array(column) for column in columns)
        now, times = (self._frame + offsets) * self._step, self._times(i, offsets)
        latest = np.maximum(np.searchsorted(begins, now, side="right") - 1, 0)
        own = np.stack([latest, np.maximum(latest - 1, 0)])
        # Fades are as long as they are, however fast the arms' clock runs.
        part = np.clip((now - begins[latest]) / self._searches[i].overlap, 0.0, 1.0)
        weight = np.where(latest > 0, part**3 * (10 - 15 * part + 6 * part**2), 1.0)
        return recordings[own], frames[own] + times - clocks[own], np.stack([weight, 1 - weight])

    def _shown(self, i: int, offsets: np.ndarray, name: str) -> np.ndarray:
        """Return curves (M, C) of what a part shows at motion frames (M,) relative to now."""
        recordings, frames, weights = self._at(i, offsets)
        last = self._lengths[recordings] - 1
        at = np.clip(frames, 0, last)
        low = at.astype(int)
        around = self._first[recordings] + np.clip(low + _TAPS, 0, last)  # (taps, 2, M)
        weights = (np.stack(spline_weights(at - low)) * weights).astype(np.float32)
        return np.einsum("ijm,ijmc->mc", weights, self._curves[i][name][around])

    def _times(self, i: int, offsets: np.ndarray) -> np.ndarray:
        """Return the times of a part at motion frames (M,) relative to the current one."""
        if not self.library.parts[i].is_arm:
            return (self._frame + offsets) * self._step
        past = np.interp(offsets, np.arange(-self._past, 1.0), self._clock)
        return past + self._step * np.maximum(offsets, 0.0)

    def vectors(self, offsets: np.ndarray) -> np.ndarray:
        """Return the recalled motion at motion frames (M,) relative to the current one.

        (M, D + P): normalised motion vectors, and the movement of each part's pieces.
        """
        n_parts, n_vectors = len(self._curves), len(self.library.recordings[0].motion)
        result = np.empty((len(offsets), n_vectors + n_parts), np.float32)
        for i, part in enumerate(self.library.parts):
            result[:, [*part.columns, n_vectors + i]] = self._shown(i, offsets, "motion")
        return result

    def passive(self) -> Tensor:
        """Return the channels (X, 1) that are recalled but not modelled, at the current frame."""
        result = torch.empty(sum(map(len, self._passive)), 1)
        for i, own in enumerate(self._passive):
            if len(own):
                result[own] = torch.from_numpy(self._shown(i, _NOW, "passive")).T
        return result


def _curves(library: RecallLibrary, i: int, passive: np.ndarray) -> dict[str, np.ndarray]:
    """Return curves (N, C) of part `i` at all frames of all recordings, one after another.

    By name: `motion`, its columns of the motion vector and its movement; `passive`, its channels
    that are not modelled; for the choice, `fast` movement, and `directions` of the first hand.
    """
    columns, recordings = library.parts[i].columns, library.recordings
    found = {
        "motion": [torch.cat([own.motion[columns], own.profiles[i : i + 1]]) for own in recordings],
        "passive": [own.passive[passive] for own in recordings],
        "fast": library.fast_movement[i],
        "directions": [own.directions[:2] for own in recordings],
    }
    return {name: torch.cat(own, dim=1).T.contiguous().numpy() for name, own in found.items()}


_STATE = ("_frame", "_clock", "_used", "_pieces", "_due", "_log_tempo")
