"""Prediction of arm speed and acceleration from speech: a ridge regression on paired recordings.

The prediction is the target on random-generation steps, whose speech has no recorded motion.
Trembling arms could match a speed target alone, so acceleration has a target too. Not in the paper;
unused if `losses.arm_speed` and `losses.arm_acceleration` are 0.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

import audio_features as af
from gesturekit.multires.kinematics import (
    CAPTURE_SECONDS,
    SMOOTHING_SECONDS,
    VectorKinematics,
    smooth,
)
from gesturekit.multires.network.resampling import reflect, resample
from gesturekit.multires.training.data import PairedSequence

# Fixed: the recipes' loss weights were chosen with these values.
_CONTEXT_SECONDS = 0.2
_RIDGE = 30.0
_RIDGE_FEATURES = 32
"""Number of features up to which the ridge penalty is constant; it grows with the number of further
features."""
_SPREAD_SECONDS = 3.0
_SPREAD_WEIGHT = 5.0


def log_movement(
    speed: Tensor, acceleration: Tensor, frame_seconds: float, floors: Sequence[float]
) -> Tensor:
    """Return (B, 2, T) smoothed logarithms (sigma 0.1 s) of (B, T) arm movement.

    Args:
        speed: (B, T), rad/s.
        acceleration: (B, T), rad/s^2.
        frame_seconds: time between two frames.
        floors: added to speed and acceleration before the logarithm, see `LossConfig.arm_floors`.
    """
    both = torch.stack([speed, acceleration], dim=1)
    added = both.new_tensor(floors)[:, None]
    return torch.log(smooth(both, SMOOTHING_SECONDS / frame_seconds) + added)


def recorded_movement(
    kinematics: VectorKinematics, values: Tensor, stride: float, floors: Sequence[float]
) -> Tensor:
    """Return (B, 2, T) log arm movement of recordings, without capture noise.

    Args:
        kinematics: of the rig.
        values: (B, D, T) motion vectors in their own units.
        stride: full-rate frames between two frames.
        floors: see `log_movement`.
    """
    return log_movement(
        kinematics.arm_speed(values, stride, smoothing=0.0),
        kinematics.arm_acceleration(values, stride, smoothing=CAPTURE_SECONDS),
        stride / kinematics.fps,
        floors,
    )


def arm_targets(
    sequences: Sequence[PairedSequence],
    indices: Sequence[int],
    levels: int,
    values_of: Callable[[Tensor], Tensor],
    kinematics: VectorKinematics,
    device: torch.device,
    floors: Sequence[float],
) -> list[ArmTarget]:
    """Fit a regression for each level, from the paired speech to the recorded arm movement.

    Recorded speed is unfiltered and generated speed is smoothed (`VectorKinematics.arm_speed`), so
    that generated arms have to move as fast as the recorded ones without trembling. Acceleration is
    filtered the other way round: recordings without capture noise, generated motion with all its
    trembling.

    Args:
        sequences: recordings.
        indices: of the levels.
        levels: L.
        values_of: converts normalised motion (B, D, T) to its own units.
        kinematics: of the rig.
        device: on which the networks are trained.
        floors: see `log_movement`.
    """
    targets = []
    for i in indices:
        speeches, movements = [], []
        stride = 1.0
        for sequence in sequences:
            n = af.level_lengths(sequence.n_frames, levels)[i]
            if n < 2:
                continue  # a single frame has no speed
            stride = sequence.n_frames / n
            values = values_of(resample(sequence.motion[None].to(device), n))
            movements.append(recorded_movement(kinematics, values, stride, floors)[0])
            speeches.append(resample(sequence.speech.to(device), n))
        target = ArmTarget(stride / kinematics.fps).to(device)
        targets.append(target.fit(speeches, movements))
    return targets


class ArmTarget(nn.Module):
    """Ridge regression from the speech of one level to log arm speed and log arm acceleration.

    Inputs are the features within 0.2 s of each frame, which predict when the arms move, and the
    standard deviation of each feature within 3 s, which predicts how lively the speaker is.
    Features that are centred per clip carry no other information about that.

    Args:
        frame_seconds: time between two frames of the level.
    """

    def __init__(self, frame_seconds: float) -> None:
        super().__init__()
        self.context = round(_CONTEXT_SECONDS / frame_seconds)
        self.spread = round(_SPREAD_SECONDS / frame_seconds)
        self.frame_seconds = frame_seconds

    def _inputs(self, speech: Tensor) -> Tensor:
        """Return (B, T, S (2 c + 1) + S + 1) inputs from (B, S, T) speech, the last column ones."""
        windows = reflect(speech, self.context).unfold(-1, 2 * self.context + 1, 1)
        context = windows.permute(0, 2, 1, 3).flatten(2)
        spread = _SPREAD_WEIGHT * _local_spread(speech, self.spread).transpose(1, 2)
        return torch.cat([context, spread, torch.ones_like(context[..., :1])], dim=-1)

    def fit(self, speeches: Sequence[Tensor], movements: Sequence[Tensor]) -> ArmTarget:
        """Fit the weights, and limit predictions to the recordings' range (1st to 99th percentile).

        Predictions vary less than the recordings, as in any regression. Scaling them up would add
        movement at the wrong times.

        Args:
            speeches: (S, T) of each recording.
            movements: (2, T) `log_movement` of each recording.
        """
        inputs = torch.cat([self._inputs(speech[None])[0] for speech in speeches]).double()
        goal = torch.cat([movement.T for movement in movements]).double()
        mean = goal.mean(dim=0)
        ridge = _RIDGE * max(1.0, speeches[0].shape[0] / _RIDGE_FEATURES)
        penalty = ridge * torch.eye(inputs.shape[1], dtype=torch.float64, device=inputs.device)
        penalty[-1, -1] = 1e-6
        weights = torch.linalg.solve(
            inputs.T @ inputs + penalty * len(inputs) ** 0.5, inputs.T @ (goal - mean)
        )
        weights[-1] += mean - (inputs @ weights).mean(dim=0)
        self.register_buffer("weights", weights.float(), persistent=False)
        limits = torch.quantile(goal, goal.new_tensor([0.01, 0.99]), dim=0)
        self.register_buffer("range", limits.float()[..., None])
        return self

    def forward(self, speech: Tensor) -> Tensor:
        """Return (B, 2, T) log arm speed and acceleration from (B, S, T) speech of this level."""
        low, high = self.range
        return (self._inputs(speech) @ self.weights).transpose(1, 2).clamp(low, high)


def _local_spread(x: Tensor, reach: int) -> Tensor:
    """Return the standard deviation (B, S, T) over `reach` frames before and after each."""
    around = reflect(x, reach)
    width = 2 * reach + 1
    mean = F.avg_pool1d(around, width, stride=1)
    square = F.avg_pool1d(around.square(), width, stride=1)
    return (square - mean.square()).clamp(min=1e-3).sqrt()
