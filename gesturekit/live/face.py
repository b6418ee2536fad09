"""Face of a stream, made from the energy of its sound."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gesturekit.face import EnergyFace
from gesturekit.model import MotionStream
from gesturekit.motion import Motion
from gesturekit.motion.face import FaceTrack


class LiveFace:
    """Adds a face by rules to the motion of a stream; a recorded face that is played stays.

    A frame whose face is not final yet gets the newest one: with a `look_ahead` below the delay of
    `EnergyFace`, the mouth is late by the difference.

    Args:
        stream: the stream, before its first frame.
        seed: of blinks and gaze.
    """

    def __init__(self, stream: MotionStream, seed: int) -> None:
        self._rate = stream.sample_rate
        self._rules = EnergyFace(self._rate, stream.fps, seed)
        self._values = np.zeros((1, len(self._rules.names)))  # from frame _first
        self._first, self._next = -1, 0

    def shown(self, motion: Motion) -> Motion:
        """Return a motion with all channels of the face at 1, unless it has one of its own."""
        values = np.ones((motion.n_frames, len(self._rules.names)))
        return _with_face(motion, FaceTrack(self._rules.names, values, "rules"))

    def added(self, samples: np.ndarray, motion: Motion | None) -> Motion | None:
        """Return a step's motion with its face.

        Args:
            samples: (N,) of the step; none after the last sound.
            motion: frames that became final, if any did.
        """
        if not len(samples):
            silence = self._rules.delay + (0 if motion is None else motion.duration)
            samples = np.zeros(int(silence * self._rate) + 1, np.float32)
        self._values = np.concatenate([self._values, self._rules.step(samples)])
        if motion is None:
            return None
        last = len(self._values) - 1
        at = np.arange(self._next, self._next + motion.n_frames) - self._first
        face = FaceTrack(self._rules.names, self._values[at.clip(0, last)], "rules")
        self._next += motion.n_frames
        shown = min(self._next - self._first, last)
        self._values, self._first = self._values[shown:], self._first + shown
        return _with_face(motion, face)


def _with_face(motion: Motion, face: FaceTrack) -> Motion:
    return motion if motion.face is not None else replace(motion, face=face)
