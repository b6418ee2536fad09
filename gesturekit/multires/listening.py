"""What arm speed the speech asks for: a ridge regression, fitted on the paired part.

It gives random-generation steps, whose speech has no recorded motion, something to aim at. It is
not in the paper; with `losses.arm_speed: 0` it does not exist.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gesturekit.multires.interpolation import reflect
from gesturekit.multires.kinematics import SMOOTHING_SECONDS, smooth

FLOOR = 1.0
"""Added to arm speeds (rad/s) before the logarithm. Less than a calm speaker's, so that speeds are
compared by their ratio; not much less, or the loss is about how still the arms are in pauses."""

_CONTEXT_SECONDS = 0.2
_RIDGE = 30.0
_MANNER_SECONDS = 5.0
_MANNER_WEIGHT = 10.0


def log_speed(speed: Tensor, frame_seconds: float) -> Tensor:
    """(B, T) arm speed, rad/s, to its smoothed logarithm (sigma 0.1 s)."""
    return torch.log(smooth(speed, SMOOTHING_SECONDS / frame_seconds) + FLOOR)


class ArmSpeedTarget(nn.Module):
    """Log arm speed from the speech of one level.

    What it reads: the features +-0.2 s around each frame, which tell when the arms move, and how
    much each feature varies within +-5 s, which tells how lively the speaker is on the whole: in
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

    def fit(self, speeches: Sequence[Tensor], speeds: Sequence[Tensor]) -> ArmSpeedTarget:
        """Fit on pairs of (S, T) speech and (T,) arm speed, rad/s, of one level.

        The prediction's spread is set to that of the recording, as a regression always falls
        short of it, and its range to what the recording reaches.
        """
        rows = torch.cat([self._rows(speech[None])[0] for speech in speeches]).double()
        goal = torch.cat(
            [log_speed(speed[None], self.frame_seconds)[0] for speed in speeds]
        ).double()
        mean = goal.mean()
        penalty = _RIDGE * torch.eye(rows.shape[1], dtype=torch.float64, device=rows.device)
        penalty[-1, -1] = 1e-6
        weights = torch.linalg.solve(
            rows.T @ rows + penalty * len(rows) ** 0.5, rows.T @ (goal - mean)
        )
        predicted = rows @ weights
        gain = goal.std() / predicted.std().clamp(min=1e-6)
        weights = weights * gain.clamp(max=3.0)
        weights[-1] += mean - (rows @ weights).mean()
        self.register_buffer("weights", weights.float(), persistent=False)
        self.register_buffer("range", torch.quantile(goal, goal.new_tensor([0.01, 0.99])).float())
        return self

    def forward(self, speech: Tensor) -> Tensor:
        """(B, S, T) speech of this level to (B, T) log arm speed."""
        low, high = self.range
        return (self._rows(speech) @ self.weights).clamp(low, high)


def _local_spread(x: Tensor, reach: int) -> Tensor:
    """(B, S, T) standard deviation over the frames up to `reach` before and after each."""
    around = reflect(x, reach)
    width = 2 * reach + 1
    mean = F.avg_pool1d(around, width, stride=1)
    square = F.avg_pool1d(around.square(), width, stride=1)
    return (square - mean.square()).clamp(min=1e-3).sqrt()
