"""One signal without holes, made of blocks of sound that come late, in bursts, or not at all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

BRIDGE = 0.2
"""Longest gap that is filled by sound like the last one, seconds; after it there is silence."""
_DRIFT = 1e-3
"""Largest difference between the clocks of sound card and computer that is followed."""
_MOST_IDLE = 1.0
"""Most silence made at once, seconds; a computer that slept goes on with the present."""


@dataclass(frozen=True)
class Block:
    """Sound as a source delivers it.

    Attributes:
        samples: (N,) float32, mono.
        time: when its first sample was captured, seconds of `time.monotonic`; None for sound that
            is read as fast as possible.
    """

    samples: np.ndarray
    time: float | None = None


class Timeline:
    """Place of each block in the sound that the stream gets.

    Sound that is missing for up to `BRIDGE` is replaced by a mirror image of what came before,
    which fades. In a longer gap silence follows as the time passes. Sound that comes when its time
    was filled already is dropped. A gap that is found too late to be filled, as the computer was
    busy or slept, is skipped. The clock of the sound card is followed, so that its drift is no gap.

    Args:
        rate: samples per second.
        tolerance: seconds by which a block may come early or late without being taken for a gap.

    """

    def __init__(self, rate: int, tolerance: float) -> None:
        self._bridged = self._silent = self._dropped = self._skipped = 0.0
        self._rate, self._tolerance = rate, tolerance
        self._given, self._missing = 0, 0
        self._origin: float | None = None
        self._last = np.zeros(round(BRIDGE * rate), np.float32)

    @property
    def seconds(self) -> float:
        """Length of the sound that the stream got."""
        return self._given / self._rate

    def counts(self) -> dict[str, float]:
        """Return how many seconds of sound were bridged, silent, dropped and skipped so far."""
        names = ("bridged", "silent", "dropped", "skipped")
        return {name: getattr(self, f"_{name}") for name in names}

    def moment(self, seconds: float) -> float | None:
        """Return the clock's time of a second of the stream's sound; None without a clock."""
        return None if self._origin is None else self._origin + seconds

    def place(self, block: Block, now: float) -> np.ndarray:
        """Return the samples that the stream gets for a block, which is taken at time `now`."""
        samples, filled = block.samples, np.empty(0, np.float32)
        if block.time is not None:
            origin = self._origin = block.time if self._origin is None else self._origin
            ahead = origin + self.seconds - block.time
            if ahead > self._tolerance:
                late = min(round(ahead * self._rate), len(samples))
                self._dropped += late / self._rate
                samples = samples[late:]
            elif -ahead > self._tolerance:
                is_behind = now - block.time - len(samples) / self._rate > BRIDGE
                bridged = 0.0 if is_behind else min(-ahead, BRIDGE)
                filled = self._filled(round(bridged * self._rate))
                self._skip(origin, -ahead - bridged)
            else:
                drift = _DRIFT * len(samples) / self._rate
                self._origin = origin - float(np.clip(ahead, -drift, drift))
        if len(samples):
            self._given += len(samples)
            self._missing = 0
            self._last = np.concatenate([self._last, samples])[-len(self._last) :]
        return np.concatenate([filled, samples])

    def idle(self, now: float) -> np.ndarray:
        """Return the samples with which the stream goes on while no block comes."""
        origin = self._origin = now if self._origin is None else self._origin
        due = now - origin - self.seconds - self._tolerance - BRIDGE
        self._skip(origin, due - _MOST_IDLE)
        return self._filled(max(round(min(due, _MOST_IDLE) * self._rate), 0))

    def _skip(self, origin: float, seconds: float) -> None:
        self._origin = origin + max(seconds, 0.0)
        self._skipped += max(seconds, 0.0)

    def _filled(self, count: int) -> np.ndarray:
        """Return `count` samples that go on from the last ones, mirrored and fading to silence."""
        places = self._missing + np.arange(count)
        kept = places[places < len(self._last)]
        filled = np.zeros(count, np.float32)
        filled[: len(kept)] = self._last[::-1][kept] * (1 - kept / len(self._last))
        self._bridged += len(kept) / self._rate
        self._silent += (count - len(kept)) / self._rate
        self._missing += count
        self._given += count
        return filled
