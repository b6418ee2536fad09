"""Build the recall library from the training recordings."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from itertools import repeat

import numpy as np
import torch

import audio_features as af
from gesturekit.multires.config import MultiresConfig
from gesturekit.multires.network.resampling import resample
from gesturekit.multires.recall.library import RecalledRecording, RecallLibrary, averaged
from gesturekit.multires.recall.parts import (
    MotionPart,
    defects_of_parts,
    hand_directions,
    joint_places,
    motion_parts,
    movements,
    slow_rows,
    slow_states,
)
from gesturekit.multires.recall.slow_state import SlowState, normal_scores
from gesturekit.multires.recall.wanted import WantedMovement, correlation
from gesturekit.multires.training.data import PairedSequence, TrainingData

log = logging.getLogger(__name__)

_HIGHEST = 0.8
"""Correlation of the two hands above which the weight of their directions no longer grows."""


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
    hands = [np.mean([of_parts[i] for i in asked], axis=0) for of_parts in moved]
    goal = np.concatenate(hands)
    mean, spread = float(goal.mean()), max(float(goal.std()), 1e-3)
    # The trunk moves less than hands do: by quantiles, its movement becomes comparable.
    for i in range(len(asked), len(parts)):
        own = np.concatenate([of_parts[i] for of_parts in moved])
        for of_parts in moved:
            of_parts[i] = _mapped(of_parts[i], own, goal)
    states = [
        np.concatenate(
            [slow_states(part, joints, fps, *own) for part, *own in zip(parts, repeat(where), rows)]
        )
        for where, rows in zip(places, moved, strict=True)
    ]
    scores = normal_scores(states, [(one.speaker, one.style) for one in sequences])
    first = [rows.start for rows in slow_rows(parts)[: len(asked)]]
    wanted = _wanted(data, hands, [own[first].mean(axis=0) for own in scores], fps)
    directions = _directions(parts, joints, fps, places)
    standard = [(np.stack(rows) - mean) / spread for rows in moved]
    rows = zip(sequences, standard, states, directions, defects, strict=True)
    return RecallLibrary(
        settings.level,
        levels,
        fps,
        settings.piece,
        settings.overlap,
        parts,
        tuple(_recalled(*own, levels, settings.level) for own in rows),
        spread,
        mean,
        SlowState.fit(scores, wanted, [sequence.take for sequence in sequences], fps),
        wanted,
        data.passive,
        stretch=settings.stretch,
    )


def _wanted(
    data: TrainingData, movement: Sequence[np.ndarray], slow: Sequence[np.ndarray], fps: float
) -> WantedMovement | None:
    """Return the prediction of movement from speech; None if there is no speech or it fails."""
    if data.conditioner is None:
        return None
    speeches = [sequence.speech.numpy() for sequence in data.paired]
    smaller = (data.conditioner.acoustic, data.conditioner.prosody)
    wanted = WantedMovement.fit(
        speeches,
        movement,
        slow,
        fps,
        data.conditioner.effort,
        smaller,
        takes=[sequence.take for sequence in data.paired],
    )
    if wanted.predicts:
        return wanted
    log.info("Speech does not predict hand movement here: recalled pieces are chosen without it.")
    return None


def _recalled(
    sequence: PairedSequence,
    profiles: np.ndarray,
    states: np.ndarray,
    directions: np.ndarray,
    defects: np.ndarray,
    levels: int,
    level: int,
) -> RecalledRecording:
    """Return a recording with its curves (C, T) at the recalled level."""
    n = af.level_lengths(sequence.n_frames, levels)[level - 1]
    return RecalledRecording(
        resample(sequence.motion[None], n)[0].contiguous(),
        resample(sequence.passive[None], n)[0].contiguous(),
        *(torch.from_numpy(averaged(rows, n)).float() for rows in (profiles, states, directions)),
        sequence.speaker,
        sequence.style,
        torch.from_numpy(_any_near(defects, n)),
    )


def _directions(
    parts: Sequence[MotionPart], joints: Sequence[str], fps: float, places: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Return the weighted directions of both hands, (4, T_k); (0, T_k) without arms."""
    if not parts[0].is_arm:
        return [np.zeros((0, own.shape[-1])) for own in places]
    return _weighted(
        [[hand_directions(part, joints, fps, own) for own in places] for part in parts[:2]]
    )


def _weighted(both: Sequence[Sequence[np.ndarray]]) -> list[np.ndarray]:
    """Return the directions (2, T_k) of both hands (2), as (4, T_k), weighted by their correlation.

    If the hands have correlation r in a row, both get the variance r / (1 - r^2): their product is
    then the logarithm of how much likelier each makes the other, for Gaussians.
    """
    pooled = [np.concatenate(hand, axis=1) for hand in both]
    r = [np.clip(correlation(a, b), 0.0, _HIGHEST) for a, b in zip(*pooled, strict=True)]
    sizes = np.sqrt([own / (1 - own**2) for own in r])
    factors = [sizes / np.maximum(hand.std(axis=1), 1e-3) for hand in pooled]
    return [
        np.concatenate([factor[:, None] * rows for factor, rows in zip(factors, hands)])
        for hands in zip(*both, strict=True)
    ]


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
