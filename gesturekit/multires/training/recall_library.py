"""Build the recall library from the training recordings."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np
import torch

import audio_features as af
from gesturekit.multires.config import MultiresConfig
from gesturekit.multires.network.resampling import resample
from gesturekit.multires.recall.library import RecalledRecording, RecallLibrary, averaged
from gesturekit.multires.recall.parts import (
    defects_of_parts,
    hand_directions,
    joint_places,
    motion_parts,
    movements,
)
from gesturekit.multires.recall.wanted import WantedMovement, correlation, slow_part
from gesturekit.multires.training.data import TrainingData

log = logging.getLogger(__name__)

_HIGHEST = 0.8
"""Correlation of the two hands above which the weight of the first hand no longer grows."""


def build_library(data: TrainingData, config: MultiresConfig) -> RecallLibrary | None:
    """Return the recall library of a run; None without `recall`."""
    settings, fps, levels = config.recall, config.fps, config.network.levels
    if settings is None:
        return None
    representation, sequences = data.representation, data.paired
    parts = motion_parts(representation, settings.parts == "arms")
    joints = representation.joints
    values = [data.normaliser.inverse(sequence.motion[None])[0] for sequence in sequences]
    places = [joint_places(representation, fps, own) for own in values]
    defects = [defects_of_parts(parts, representation, fps, own) for own in values]
    moved = [movements(parts, joints, fps, own) for own in places]
    # Speech predicts the movement of the hands: that of both arms, or of the only part.
    asked = [i for i, part in enumerate(parts) if part.is_arm] or [0]
    every = [np.mean([of_parts[i] for i in asked], axis=0) for of_parts in moved]
    goals = [np.concatenate(curves) for curves in _with_slow(every, fps)]
    mean = float(goals[0].mean())
    spread = np.array([max(goal.std(), 1e-3) for goal in goals])
    goals = [(goal - mean) / width for goal, width in zip(goals, spread, strict=True)]
    profiles: list[list[np.ndarray]] = [[] for _ in sequences]
    for i in range(len(parts)):
        for curves, goal in zip(_with_slow([m[i] for m in moved], fps), goals, strict=True):
            own = np.concatenate(curves)
            for of_sequence, curve in zip(profiles, curves, strict=True):
                of_sequence.append(_mapped(curve, own, goal))
    directions = [np.zeros((0, sequence.n_frames)) for sequence in sequences]
    if parts[0].is_arm:
        of_arms = [
            [hand_directions(part, joints, fps, own) for own in places] for part in parts[:2]
        ]
        directions = _weighted(*of_arms)
    recordings = []
    for sequence, rows, led, faulty in zip(sequences, profiles, directions, defects, strict=True):
        n = af.level_lengths(sequence.n_frames, levels)[settings.level - 1]
        recordings.append(
            RecalledRecording(
                resample(sequence.motion[None], n)[0].contiguous(),
                resample(sequence.passive[None], n)[0].contiguous(),
                torch.from_numpy(averaged(np.stack(rows), n)).float(),
                torch.from_numpy(averaged(led, n)).float(),
                sequence.speaker,
                sequence.style,
                torch.from_numpy(_any_near(faulty, n)),
            )
        )
    return RecallLibrary(
        settings.level,
        levels,
        fps,
        settings.piece,
        settings.overlap,
        parts,
        tuple(recordings),
        spread,
        mean,
        _wanted(data, every, fps),
        data.passive,
        stretch=settings.stretch,
    )


def _wanted(
    data: TrainingData, movement: Sequence[np.ndarray], fps: float
) -> WantedMovement | None:
    """Return the prediction of movement from speech; None if there is no speech or it fails."""
    if data.conditioner is None:
        return None
    speeches = [sequence.speech.numpy() for sequence in data.paired]
    smaller = (data.conditioner.acoustic, data.conditioner.prosody)
    wanted = WantedMovement.fit(
        speeches,
        movement,
        fps,
        data.conditioner.effort,
        smaller,
        takes=[sequence.take for sequence in data.paired],
    )
    if wanted.predicts:
        return wanted
    log.info("Speech does not predict hand movement here: recalled pieces are chosen without it.")
    return None


def _with_slow(
    curves: Sequence[np.ndarray], fps: float
) -> tuple[Sequence[np.ndarray], Sequence[np.ndarray]]:
    """Return movement curves (T_k,) and their slow parts."""
    return curves, [slow_part(curve, fps) for curve in curves]


def _weighted(first: Sequence[np.ndarray], second: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Scale the directions (2, T_k) of the first hand by how well they predict the second hand.

    If the hands have correlation r, a row gets the standard deviation r^2 / (1 - r^2): the ratio of
    explained to unexplained variance of the second hand.
    """
    both = np.stack([np.concatenate(first, axis=1), np.concatenate(second, axis=1)])
    factors = []
    for a, b in zip(*both, strict=True):
        r = min(abs(correlation(a, b)), _HIGHEST)
        factors.append(r**2 / (1 - r**2) / max(a.std(), 1e-3))
    return [rows * np.array(factors)[:, None] for rows in first]


def _any_near(flags: np.ndarray, n_frames: int) -> np.ndarray:
    """Resample flags (P, T) to (P, n_frames): both frames around a flagged one are flagged."""
    result = np.zeros((len(flags), n_frames), bool)
    part, frame = np.nonzero(flags)
    place = (frame + 0.5) * n_frames / flags.shape[1] - 0.5
    for near in (np.floor(place), np.ceil(place)):
        result[part, np.clip(near, 0, n_frames - 1).astype(int)] = True
    return result


def _mapped(curve: np.ndarray, own: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Map a curve from the distribution of `own` values to that of `goal`, by quantiles."""
    shares = np.linspace(0, 1, 101)
    return np.interp(curve, np.quantile(own, shares), np.quantile(goal, shares))
