"""What the speech asks of the arms: a ridge regression, fitted on the paired part.

It gives random-generation steps, whose speech has no recorded motion, something to aim at: how
fast the arms move, and by how much their speed changes. The first alone is met by arms that shake
instead of swinging. It is not in the paper; with `losses.arm_speed` and `losses.arm_acceleration`
at 0 it does not exist.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

import audio_features as af
from gesturekit.multires.network.resampling import reflect, resample
from gesturekit.multires.training.data import PairedSequence
from gesturekit.multires.training.kinematics import (
    CAPTURE_SECONDS,
    SMOOTHING_SECONDS,
    VectorKinematics,
    smooth,
)

FLOORS = (1.0, 10.0)
"""Added to arm speed (rad/s) and acceleration (rad/s^2) before the logarithm. Less than a calm
speaker's, so that they are compared by their ratio; not much less, or the loss is about how still
the arms are in pauses."""

_CONTEXT_SECONDS = 0.2
_RIDGE = 30.0
_MANNER_SECONDS = 3.0
_MANNER_WEIGHT = 5.0


def log_movement(speed: Tensor, acceleration: Tensor, frame_seconds: float) -> Tensor:
    """(B, T) of the arms, rad/s and rad/s^2, to (B, 2, T) smoothed logarithms (sigma 0.1 s)."""
    both = torch.stack([speed, acceleration], dim=1)
    floors = both.new_tensor(FLOORS)[:, None]
    return torch.log(smooth(both, SMOOTHING_SECONDS / frame_seconds) + floors)


def arm_targets(
    sequences: Sequence[PairedSequence],
    indices: Sequence[int],
    levels: int,
    values_of: Callable[[Tensor], Tensor],
    kinematics: VectorKinematics,
    device: torch.device,
) -> list[ArmTarget]:
    """Fit a regression for each level, from the paired speech to the recorded arm movement.

    Recorded speed is raw and generated speed smoothed (`VectorKinematics.arm_speed`): generated
    arms have to move as fast as the recorded ones without trembling. For acceleration it is the
    other way round: recorded without capture noise, generated with all trembling.

    Args:
        sequences: recordings.
        indices: of the levels.
        levels: L.
        values_of: converts normalised motion (B, D, T) to its own units.
        kinematics: of the rig.
        device: on which the networks are trained.
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
            movement = log_movement(
                kinematics.arm_speed(values, stride, smoothing=0.0),
                kinematics.arm_acceleration(values, stride, smoothing=CAPTURE_SECONDS),
                stride / kinematics.fps,
            )
            movements.append(movement[0])
            speeches.append(resample(sequence.speech.to(device), n))
        target = ArmTarget(stride / kinematics.fps).to(device)
        targets.append(target.fit(speeches, movements))
    return targets


class ArmTarget(nn.Module):
    """Log arm speed and log arm acceleration from the speech of one level.

    What it reads: the features +-0.2 s around each frame, which tell when the arms move, and how
    much each feature varies within +-3 s, which tells how lively the speaker is on the whole: in
    speech that is centred clip by clip, only the spread says so.

    Args:
        frame_seconds: time between two frames of the level.
    """

    def __init__(self, frame_seconds: float) -> None:
        super().__init__()
        self.context = round(_CONTEXT_SECONDS / frame_seconds)
        self.manner = round(_MANNER_SECONDS / frame_seconds)
        self.frame_seconds = frame_seconds

    def _rows(self, speech: Tensor) -> Tensor:
        """(B, S, T) to (B, T, S (2 c + 1) + S + 1), the last column ones."""
        windows = reflect(speech, self.context).unfold(-1, 2 * self.context + 1, 1)
        rows = windows.permute(0, 2, 1, 3).flatten(2)
        spread = _MANNER_WEIGHT * _local_spread(speech, self.manner).transpose(1, 2)
        return torch.cat([rows, spread, torch.ones_like(rows[..., :1])], dim=-1)

    def fit(self, speeches: Sequence[Tensor], movements: Sequence[Tensor]) -> ArmTarget:
        """Fit on pairs of (S, T) speech and (2, T) `log_movement`, of one level.

        The range is set to what the recording reaches. The spread stays that of a regression, less
        than the recording's: speech tells only a part, and what is added to seem as lively is
        added at the wrong times and to calm speech.
        """
        rows = torch.cat([self._rows(speech[None])[0] for speech in speeches]).double()
        goal = torch.cat([movement.T for movement in movements]).double()
        mean = goal.mean(dim=0)
        penalty = _RIDGE * torch.eye(rows.shape[1], dtype=torch.float64, device=rows.device)
        penalty[-1, -1] = 1e-6
        weights = torch.linalg.solve(
            rows.T @ rows + penalty * len(rows) ** 0.5, rows.T @ (goal - mean)
        )
        weights[-1] += mean - (rows @ weights).mean(dim=0)
        self.register_buffer("weights", weights.float(), persistent=False)
        limits = torch.quantile(goal, goal.new_tensor([0.01, 0.99]), dim=0)
        self.register_buffer("range", limits.float()[..., None])
        return self

    def forward(self, speech: Tensor) -> Tensor:
        """(B, S, T) speech of this level to (B, 2, T) log arm speed and acceleration."""
        low, high = self.range
        return (self._rows(speech) @ self.weights).transpose(1, 2).clamp(low, high)


def _local_spread(x: Tensor, reach: int) -> Tensor:
    """(B, S, T) standard deviation over the frames up to `reach` before and after each."""
    around = reflect(x, reach)
    width = 2 * reach + 1
    mean = F.avg_pool1d(around, width, stride=1)
    square = F.avg_pool1d(around.square(), width, stride=1)
    return (square - mean.square()).clamp(min=1e-3).sqrt()
