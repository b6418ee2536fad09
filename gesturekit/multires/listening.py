"""What arm speed the speech asks for: a ridge regression, fitted on the paired part.

It gives random-generation steps, whose speech has no recorded motion, something to aim at. It is
not in the paper; with `losses.arm_speed: 0` it does not exist.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from gesturekit.multires.interpolation import reflect
from gesturekit.multires.kinematics import SMOOTHING_SECONDS, smooth

FLOOR = 0.1
"""Added to arm speeds (rad/s) before the logarithm, so that stillness is finite."""

_CONTEXT_SECONDS = 0.2
_RIDGE = 3.0


class ArmSpeedTarget(nn.Module):
    """Log arm speed from the speech of one level, +-0.2 s around each frame.

    Args:
        frame_seconds: time between two frames of the level.
    """

    def __init__(self, frame_seconds: float) -> None:
        super().__init__()
        self.context = round(_CONTEXT_SECONDS / frame_seconds)
        self.sigma = SMOOTHING_SECONDS / frame_seconds

    def log_speed(self, speed: Tensor) -> Tensor:
        """(B, T) arm speed, rad/s, to its smoothed logarithm (sigma 0.1 s)."""
        return torch.log(smooth(speed, self.sigma) + FLOOR)

    def _context(self, speech: Tensor) -> Tensor:
        """(B, S, T) to (B, T, S (2 c + 1) + 1), the last column ones."""
        windows = reflect(speech, self.context).unfold(-1, 2 * self.context + 1, 1)
        rows = windows.permute(0, 2, 1, 3).flatten(2)
        return torch.cat([rows, torch.ones_like(rows[..., :1])], dim=-1)

    def fit(self, speeches: Sequence[Tensor], speeds: Sequence[Tensor]) -> ArmSpeedTarget:
        """Fit on pairs of (S, T) speech and (T,) arm speed, rad/s, of one level.

        The prediction's spread is set to that of the recording, as a regression always falls
        short of it, and its range to what the recording reaches.
        """
        rows = torch.cat([self._context(speech[None])[0] for speech in speeches]).double()
        goal = torch.cat([self.log_speed(speed[None])[0] for speed in speeds]).double()
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
        return (self._context(speech) @ self.weights).clamp(low, high)
