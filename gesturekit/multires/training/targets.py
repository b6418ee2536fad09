"""Targets of losses on random steps that are not in the paper: arm movement and detail.

`ArmTarget` predicts arm speed and acceleration from speech by a ridge regression on paired
recordings, since the speech of these steps has no recorded motion. Trembling arms could match a
speed target alone, so acceleration has a target too. Unused if `losses.arm_speed` and
`losses.arm_acceleration` are 0.

`DetailTarget` holds the amount of fine detail in the recordings. Detail is joint movement that the
frame rate of the next coarser level cannot represent. Discriminators respond to the size of an
error, and detail is only a hundredth of the size of a pose: without this loss, fine levels add
almost nothing. Unused if `losses.detail` is 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

import audio_features as af
from gesturekit.multires import losses
from gesturekit.multires.kinematics import (
    CAPTURE_SECONDS,
    SMOOTHING_SECONDS,
    VectorKinematics,
    smooth,
)
from gesturekit.multires.network.resampling import reflect, resample
from gesturekit.multires.training.data import TrainingData
from gesturekit.multires.training.sequences import PairedSequence

# Fixed: the recipes' loss weights were chosen with these values.
_CONTEXT_SECONDS = 0.2
_RIDGE = 30.0
_RIDGE_FEATURES = 32
"""Number of features up to which the ridge penalty is constant; it grows with the number of further
features."""
_SPREAD_SECONDS = 3.0
_SPREAD_WEIGHT = 5.0

_DETAIL_FLOOR = 0.1
"""Fraction of the RMS detail over all styles below which a joint counts as still. Fixed; it keeps
the logarithm finite."""
_LEAST_DETAIL = 1e-12
"""Smallest floor, m^2, for rigs whose joints never move relative to the root, such as a single
joint."""
_MOST_INPUTS = 20_000_000
"""Numbers of speech inputs that arm movement is fitted to; of more, every second, third ... frame
is used. An hour of light features has 33 million, and of 768 columns of an encoder 830 million."""
MOST_WINDOWS = 2048
"""Number of recorded windows whose detail is computed; of more than that, this many, evenly spaced
over the recordings. Windows beside each other overlap, so that more would change the mean by less
than 1 %."""
_WINDOWS_AT_ONCE = 256  # bounds the memory of their joint positions
_FLOORS = 1.0, 10.0
"""Added to arm speed (rad/s) and acceleration (rad/s^2) before the logarithm, so that slow movement
counts little."""
_DETAIL_WINDOWS = 64
"""Number of recorded windows per style, evenly spaced. Fixed; it bounds the cost of a step."""


def log_movement(speed: Tensor, acceleration: Tensor, frame_seconds: float) -> Tensor:
    """Return (B, 2, T) smoothed logarithms (sigma 0.1 s) of (B, T) arm movement.

    Args:
        speed: (B, T), rad/s.
        acceleration: (B, T), rad/s^2.
        frame_seconds: time between two frames.
    """
    both = torch.stack([speed, acceleration], dim=1)
    added = both.new_tensor(_FLOORS)[:, None]
    return torch.log(smooth(both, SMOOTHING_SECONDS / frame_seconds) + added)


def recorded_movement(kinematics: VectorKinematics, values: Tensor, stride: float) -> Tensor:
    """Return (B, 2, T) log arm movement of recordings, without capture noise.

    Args:
        kinematics: of the rig.
        values: (B, D, T) motion vectors in their own units.
        stride: full-rate frames between two frames.
    """
    return log_movement(
        kinematics.arm_speed(values, stride, smoothing=0.0),
        kinematics.arm_acceleration(values, stride, smoothing=CAPTURE_SECONDS),
        stride / kinematics.fps,
    )


def arm_targets(
    sequences: Sequence[PairedSequence],
    indices: Sequence[int],
    levels: int,
    values_of: Callable[[Tensor], Tensor],
    kinematics: VectorKinematics,
    device: torch.device,
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
            values = values_of(resample(sequence.motion[:, :][None].to(device), n))
            movements.append(recorded_movement(kinematics, values, stride)[0])
            speeches.append(resample(sequence.speech[:, :].to(device), n))
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

    weights: Tensor
    range: Tensor

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
        columns = speeches[0].shape[0] * (2 * self.context + 2) + 1
        every = math.ceil(columns * sum(speech.shape[1] for speech in speeches) / _MOST_INPUTS)
        # Copied by `double`: a view would keep the inputs of all frames in memory.
        inputs = torch.cat([self._inputs(speech[None])[0, ::every].double() for speech in speeches])
        goal = torch.cat([movement.T[::every] for movement in movements]).double()
        mean = goal.mean(dim=0)
        ridge = _RIDGE * max(1.0, speeches[0].shape[0] / _RIDGE_FEATURES)
        penalty = inputs.new_full((columns,), ridge)
        penalty[-1] = 1e-6
        penalty *= len(inputs) ** 0.5
        # With the columns of an encoder, the dual problem is smaller and has the same solution.
        if len(inputs) < columns:
            scaled = inputs / penalty
            gram = scaled @ inputs.T
            gram.diagonal().add_(1.0)
            weights = scaled.T @ torch.linalg.solve(gram, goal - mean)
        else:
            gram = inputs.T @ inputs
            gram.diagonal().add_(penalty)
            weights = torch.linalg.solve(gram, inputs.T @ (goal - mean))
        weights[-1] += mean - (inputs @ weights).mean(dim=0)
        self.register_buffer("weights", weights.float())
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


class DetailTarget(nn.Module):
    """Distribution over windows of the detail of each joint, for one level and each style.

    The loss is the energy distance (Szekely and Rizzo 2013) between generated and recorded
    distributions; a distance from the mean would make all windows the same. Positions are compared,
    not rotations, because rotations along an arm can compensate each other.

    Args:
        sequences: recordings.
        level: index of the level; not the first.
        levels: L.
        places: converts normalised motion (B, D, T) to joint positions (B, K, 3, T), metres.
        window: frames of a window at the full rate; None for whole sequences.
        styles: number of styles; 1 without styles.
    """

    floor: Tensor

    def __init__(
        self,
        sequences: Sequence[PairedSequence],
        level: int,
        levels: int,
        places: Callable[[Tensor], Tensor],
        window: int | None,
        styles: int,
    ) -> None:
        super().__init__()
        powers: list[list[Tensor]] = [[] for _ in range(styles)]
        share = MOST_WINDOWS / sum(sequence.n_frames for sequence in sequences)
        for sequence in sequences:
            whole = af.level_lengths(sequence.n_frames, levels)[level]
            motion = resample(sequence.motion[:, :][None], whole)
            size = whole
            if window is not None and window < sequence.n_frames:
                size = max(2, round(whole * window / sequence.n_frames))
            windows = places(motion)[0].unfold(-1, size, 1).movedim(-2, 0)
            most = max(1, math.ceil(share * sequence.n_frames))
            if most < len(windows):
                windows = windows[torch.linspace(0, len(windows) - 1, most).round().long()]
            for some in windows.split(_WINDOWS_AT_ONCE):
                powers[sequence.style].append(self._power(some))
        everywhere = torch.cat([part for parts in powers for part in parts]).mean()
        self.register_buffer("floor", (_DETAIL_FLOOR**2 * everywhere).clamp(min=_LEAST_DETAIL))
        for style, parts in enumerate(powers):
            if not parts:  # no recording has this style of a model to start from
                continue
            logs = self._log(torch.cat(parts))
            few = torch.linspace(0, len(logs) - 1, min(len(logs), _DETAIL_WINDOWS)).round().long()
            self.register_buffer(f"recorded{style}", logs[few])

    def _power(self, places: Tensor) -> Tensor:
        """Return the mean square (B, K), m^2, of movement too fast for the next coarser level."""
        n_frames = places.shape[-1]
        coarser = resample(places, af.level_lengths(n_frames, 2)[0])
        return (places - resample(coarser, n_frames)).square().mean(dim=(2, 3))

    def _log(self, power: Tensor) -> Tensor:
        return 0.5 * torch.log(power + self.floor)

    def forward(self, places: Tensor, styles: Tensor) -> Tensor:
        """Return the energy distance, up to a constant, of generated and recorded detail.

        Args:
            places: (B, K, 3, T) joint positions of generated motions, metres.
            styles: (B,) style indices. A style with a single motion is left out.
        """
        made = self._log(self._power(places))
        made = made / made.shape[1] ** 0.5
        total = made.sum() * 0
        for style in styles.unique().tolist():
            own = made[styles == style]
            if len(own) < 2:
                continue
            recorded = getattr(self, f"recorded{style}") / made.shape[1] ** 0.5
            total = total + len(own) / len(made) * losses.detail(own, recorded)
        return total


def detail_targets(
    data: TrainingData,
    indices: Sequence[int],
    levels: int,
    places: Callable[[Tensor], Tensor],
    device: torch.device,
) -> dict[int, DetailTarget]:
    """Return {index: target} of these levels; the first level has none, as there is no coarser
    level."""
    styles = max(1, len(data.styles))
    return {
        i: DetailTarget(data.sample, i, levels, places, data.window, styles).to(device)
        for i in indices
        if i
    }
