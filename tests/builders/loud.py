"""A stand-in for a model that streams: arms that rise with the loudness of the last sound."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np
from numpy.typing import ArrayLike

from gesturekit.motion import Motion, Skeleton
from gesturekit.motion.skeleton import forward_kinematics
from gesturekit.systems import model_folder

WINDOW = 0.1


class LoudModel:
    """A model on the demo's rig, whose motion is that of `LoudStream`."""

    def __init__(self) -> None:
        rig = json.loads((model_folder("demo") / "skeleton.json").read_text(encoding="utf-8"))
        self.skeleton = Skeleton.from_json(rig["skeleton"])

    def stream(
        self, sample_rate: int, look_ahead: float = 0.2, seed: int = 0, item: str = ""
    ) -> LoudStream:
        return LoudStream(self.skeleton, sample_rate, look_ahead)

    def generate(self, *, seconds: float, seed: int = 0) -> Motion:
        return raised(self.skeleton, np.zeros(round(30 * seconds)), 30.0)


@dataclass
class LoudStream:
    """A stream whose frame k is final as soon as the sound up to k / fps + look_ahead is known."""

    skeleton: Skeleton
    sample_rate: int
    look_ahead: float
    fps: float = 30.0
    n_frames: int = 0
    sound: np.ndarray = field(default_factory=lambda: np.zeros(0, np.float32))

    @property
    def latency(self) -> float:
        return self.look_ahead

    def step(self, samples: np.ndarray) -> Motion | None:
        assert samples.dtype == np.float32 and samples.ndim == 1
        self.sound = np.concatenate([self.sound, samples])
        return self._up_to(len(self.sound) / self.sample_rate - self.look_ahead)

    def finish(self) -> Motion | None:
        duration = Fraction(len(self.sound), self.sample_rate)
        return self._up_to(float((duration * 30 - Fraction(1, 2)) / 30))

    def _up_to(self, seconds: float) -> Motion | None:
        frames = np.arange(self.n_frames, int(np.floor(seconds * self.fps + 1e-9)) + 1)
        if not len(frames):
            return None
        self.n_frames = int(frames[-1]) + 1
        angles = [self._loudness(frame / self.fps) for frame in frames]
        return raised(self.skeleton, np.array(angles), self.fps)

    def _loudness(self, seconds: float) -> float:
        at = round(seconds * self.sample_rate)
        sound = self.sound[max(at - round(WINDOW * self.sample_rate), 0) : at + 1]
        return 4 * float(np.sqrt(np.mean(np.square(sound, dtype=float))))


def raised(skeleton: Skeleton, angles: ArrayLike, fps: float) -> Motion:
    """Return a motion whose right arm is raised by angles (T,) radians from a T-pose."""
    angles = np.asarray(angles)
    rotations = np.tile([0.0, 0.0, 0.0, 1.0], (len(angles), skeleton.n_joints, 1))
    rotations[:, skeleton.index("RightArm"), 2] = -np.sin(angles / 2)
    rotations[:, skeleton.index("RightArm"), 3] = np.cos(angles / 2)
    lowest = forward_kinematics(rotations[0], np.zeros(3), skeleton)[:, 1].min()
    return Motion(skeleton, rotations, np.tile([0.0, -lowest, 0.0], (len(angles), 1)), fps)
