"""From a wave to what a model hears: features on motion frames, normalised for any speaker."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import audio_features as af

LIMIT = 6.0
"""Normalised features are kept within this many standard deviations."""

_PRIOR_SECONDS = 1.0
"""How much active speech the training mean is worth when a clip's own mean is taken."""


@dataclass(frozen=True, eq=False)
class SpeechConditioner:
    """Extracts features, puts them on motion frames by true time, and normalises them.

    Each clip is centred on the mean of its own active speech, which takes a stranger's voice,
    microphone and room to where the training voices were, and scaled by the spread seen in
    training, which leaves monotonous speech monotonous and silence silent. Where a clip holds
    little or no speech, the training mean takes the place of its own.

    Attributes:
        extractor: an extractor of `audio_features`.
        fps: frames per second of the motion.
        align: how features reach the motion frames, see `FeatureTrack.to_rate`.
        centre: (S,) mean of active speech in training.
        scale: (S,) standard deviation of centred active speech in training.
    """

    extractor: Any
    fps: float
    align: str
    centre: np.ndarray
    scale: np.ndarray

    @classmethod
    def fit(
        cls, waves: Sequence[af.Wave], extractor: Any, fps: float, align: str
    ) -> SpeechConditioner:
        """Learn centre and scale from training speech, paired and unpaired alike."""
        raw = cls(extractor, fps, align, np.zeros(extractor.dim), np.ones(extractor.dim))
        clips = []
        for wave in waves:
            values, active = raw._extract(wave, wave.n_frames(fps))
            if active.any():
                clips.append(values[active])
        if not clips:
            return raw
        centre = np.mean([clip.mean(axis=0) for clip in clips], axis=0)
        spread = np.concatenate([clip - clip.mean(axis=0) for clip in clips]).std(axis=0)
        return cls(extractor, fps, align, centre, np.maximum(spread, 1e-3))

    @property
    def dim(self) -> int:
        """S, the number of features."""
        return self.extractor.dim

    def _extract(self, wave: af.Wave, n_frames: int) -> tuple[np.ndarray, np.ndarray]:
        """Features (T, S) and whether there is active speech (T,), on motion frames."""
        values = (
            self.extractor.extract(wave.at_level())
            .to_rate(self.fps, n_frames=n_frames, method=self.align)
            .values.astype(np.float64)
        )
        activity = wave.active()
        centres = np.round(np.arange(n_frames) / self.fps / 0.01).astype(int)
        return values, activity[np.minimum(centres, len(activity) - 1)]

    def __call__(self, wave: af.Wave, n_frames: int | None = None) -> np.ndarray:
        """(T, S) float32 normalised features; T follows from the wave's length unless given."""
        n_frames = wave.n_frames(self.fps) if n_frames is None else n_frames
        values, active = self._extract(wave, n_frames)
        prior = _PRIOR_SECONDS * self.fps
        own = values[active].sum(axis=0)
        centre = (own + prior * self.centre) / (active.sum() + prior)
        normalised = (values - centre) / self.scale
        return np.clip(normalised, -LIMIT, LIMIT).astype(np.float32)

    def silence(self, n_frames: int) -> np.ndarray:
        """(T, S) float32: what the model hears when nobody speaks."""
        rate = 16000
        seconds = max(1.0, n_frames / self.fps)
        nothing = af.Wave(np.zeros(int(np.ceil(seconds * rate)), np.float32), rate, None)
        return self(nothing, n_frames)
