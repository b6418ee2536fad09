"""Build the recall library from the training recordings."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

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
from gesturekit.multires.recall.slow_state import SlowState
from gesturekit.multires.training.data import TrainingData
from gesturekit.multires.training.sequences import PairedSequence
from gesturekit.state.prediction import WantedMovement, correlation
from gesturekit.state.process import normal_scores

log = logging.getLogger(__name__)

_HIGHEST = 0.8
"""Correlation of the two hands above which the weight of their directions no longer grows."""


def build_library(data: TrainingData, config: MultiresConfig) -> RecallLibrary | None:
    """Return the recall library of a run; None without `recall`."""
    settings, fps, levels = config.recall, config.fps, config.network.levels
    if settings is None:
        return None
    parts = motion_parts(data.representation, settings.parts == "arms")
    joints = data.representation.joints
    sample = _curves(data, data.sample, parts, fps)
    recalled = sample if data.recalled is data.sample else _curves(data, data.recalled, parts, fps)
    # Speech predicts the movement of the hands: that of both arms, or of the only part.
    asked = [i for i, part in enumerate(parts) if part.is_arm] or [0]
    hands = [curves.moved[asked].mean(axis=0) for curves in sample]
    goal = np.concatenate(hands)
    mean, spread = float(goal.mean()), max(float(goal.std()), 1e-3)
    # The trunk moves less than hands do: by quantiles, its movement becomes comparable.
    for i in range(len(asked), len(parts)):
        own = np.concatenate([curves.moved[i] for curves in sample])
        for curves in dict.fromkeys((*sample, *recalled)):
            curves.moved[i] = _mapped(curves.moved[i], own, goal)
    states = {
        curves: np.concatenate(
            [
                slow_states(part, joints, fps, curves.places, rows)
                for part, rows in zip(parts, curves.moved, strict=True)
            ]
        )
        for curves in (*sample, *recalled)
    }
    of_sample = [states[curves] for curves in sample]
    scores = normal_scores(of_sample, [(one.speaker, one.style) for one in data.sample])
    first = [rows.start for rows in slow_rows(parts)[: len(asked)]]
    wanted = _wanted(data, hands, [own[first].mean(axis=0) for own in scores], fps)
    weights = _weights([curves.directions for curves in sample])
    return RecallLibrary(
        settings.level,
        levels,
        fps,
        settings.piece,
        settings.overlap,
        parts,
        tuple(
            _recalled(
                sequence,
                (curves.moved - mean) / spread,
                states[curves],
                weights * curves.directions,
                curves.defects,
                levels,
                settings.level,
            )
            for sequence, curves in zip(data.recalled, recalled, strict=True)
        ),
        spread,
        mean,
        SlowState.fit(scores, wanted, [sequence.take for sequence in data.sample], fps),
        wanted,
        data.passive,
        stretch=settings.stretch,
    )


@dataclass(frozen=True, eq=False)
class _Curves:
    """Curves of a recording of T frames: joint positions (K, 3, T), movement of each part (P, T),
    directions of both hands (4, T), or none (0, T) without arms, and defects (P, T)."""

    places: np.ndarray
    moved: np.ndarray
    directions: np.ndarray
    defects: np.ndarray


def _curves(
    data: TrainingData, sequences: Sequence[PairedSequence], parts: Sequence[MotionPart], fps: float
) -> list[_Curves]:
    """Return the curves of each sequence."""
    representation, found = data.representation, []
    joints = representation.joints
    for sequence in sequences:
        values = data.normaliser.inverse(sequence.motion[:, :][None])[0]
        places = joint_places(representation, fps, values)
        arms = [hand_directions(part, joints, fps, places) for part in parts[:2] if part.is_arm]
        found.append(
            _Curves(
                places,
                np.stack(movements(parts, joints, fps, places)),
                np.concatenate(arms) if arms else np.empty((0, sequence.n_frames)),
                defects_of_parts(parts, representation, fps, values),
            )
        )
    return found


def _wanted(
    data: TrainingData, movement: Sequence[np.ndarray], slow: Sequence[np.ndarray], fps: float
) -> WantedMovement | None:
    """Return the prediction of movement from speech; None if there is no speech or it fails."""
    if data.conditioner is None:
        return None
    speeches = [sequence.speech[:, :].numpy() for sequence in data.sample]
    smaller = (data.conditioner.acoustic, data.conditioner.prosody)
    wanted = WantedMovement.fit(
        speeches,
        movement,
        slow,
        fps,
        data.conditioner.effort,
        smaller,
        takes=[sequence.take for sequence in data.sample],
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
        motion=resample(sequence.motion[:, :][None], n)[0].contiguous(),
        passive=resample(sequence.passive[:, :][None], n)[0].contiguous(),
        profiles=torch.from_numpy(averaged(profiles, n)).float(),
        states=torch.from_numpy(averaged(states, n)).float(),
        directions=torch.from_numpy(averaged(directions, n)).float(),
        speaker=sequence.speaker,
        style=sequence.style,
        defective=torch.from_numpy(_any_near(defects, n)),
    )


def _weights(directions: Sequence[np.ndarray]) -> np.ndarray:
    """Return the weights (4, 1) of the directions (4, T_k) of both hands; (0, 1) without arms.

    If the hands have correlation r in a row, both get the variance r / (1 - r^2): their product is
    then the logarithm of how much likelier each makes the other, for Gaussians.
    """
    pooled = np.concatenate(directions, axis=1)
    first, second = pooled[:2], pooled[2:]
    r = [np.clip(correlation(a, b), 0.0, _HIGHEST) for a, b in zip(first, second, strict=True)]
    sizes = np.tile(np.sqrt([own / (1 - own**2) for own in r]), 2)[: len(pooled)]
    return (sizes / np.maximum(pooled.std(axis=1), 1e-3))[:, None]


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
