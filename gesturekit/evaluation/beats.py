"""Beats of sounds and of motions, found once and compared with each other."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from audio_features import Wave
from gesturekit.evaluation.clips import Clip, load_wave
from gesturekit.evaluation.metrics import rhythm
from gesturekit.evaluation.pairs import WINDOW_SECONDS, Stretch
from gesturekit.motion import Motion


@dataclass(frozen=True)
class Sound:
    """A recording's sound and its beats.

    Attributes:
        wave: the sound.
        onsets: (B,) speech onsets, seconds.
        pulse: (B,) beats of the beat tracker, seconds.
    """

    wave: Wave
    onsets: np.ndarray
    pulse: np.ndarray

    @classmethod
    def load(cls, path: Path | Stretch, window: int | None) -> Sound:
        """Read a sound, or one 10 s window of it.

        Raises:
            AudioError: it cannot be read.
        """
        wave = load_wave(path)
        if window is not None:
            wave = wave.slice(window * WINDOW_SECONDS, WINDOW_SECONDS)
        return cls(wave, rhythm.speech_onsets(wave), rhythm.music_beats(wave))


load_sound = functools.lru_cache(maxsize=16)(Sound.load)


@dataclass(frozen=True, eq=False)
class MotionBeats:
    """Beats of a motion, compared with those of sounds.

    Attributes:
        motion: generated or recorded motion of the clip.
        clip: the clip.
        mean_speed: {joint name: mean speed over the recordings, m/s}.
        variant: of the beat alignment.
    """

    motion: Motion
    clip: Clip
    mean_speed: Mapping[str, float]
    variant: Literal["seconds", "bailando"]

    def alignment(self, sound: Sound) -> rhythm.BeatResult:
        """Return the beat alignment with a sound, see `rhythm.beat_alignment`."""
        return rhythm.beat_result([self._whole], sound.pulse, self.motion.duration, rhythm.KERNEL)

    def consistency(self, sound: Sound) -> rhythm.BeatResult:
        """Return the beat consistency with a sound, see `rhythm.beat_consistency`."""
        kernel = rhythm.CONSISTENCY_KERNEL
        return rhythm.beat_result(self._by_joint, sound.onsets, self.motion.duration, kernel)

    @functools.cached_property
    def _whole(self) -> np.ndarray:
        return rhythm.motion_beats(self.motion, variant=self.variant, joints=self.clip.joints)

    @functools.cached_property
    def _by_joint(self) -> list[np.ndarray]:
        upper = set(rhythm.upper_body_joints(self.clip.recording))
        joints = [name for name in self.clip.joints if name in upper]
        usual = None
        if set(joints) <= set(self.mean_speed):
            usual = np.array([self.mean_speed[name] for name in joints])
        return rhythm.joint_beats(self.motion, mean_speed=usual, joints=joints)
