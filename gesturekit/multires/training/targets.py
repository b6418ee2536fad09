"""Targets of losses on random steps that are not in the paper: arm movement, detail and state.

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

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gesturekit.multires import losses
from gesturekit.multires.kinematics import VectorKinematics
from gesturekit.multires.motion_vector import Normaliser
from gesturekit.multires.resampling import reflect, resample
from gesturekit.multires.training.data import PairedSequence
from gesturekit.multires.training.state import TrainingState
from gesturekit.state.channels import averaged

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
_LEAST_FRAMES = 4
"""Frames of a recording at a level from which its state is measured there."""
_DETAIL_WINDOWS = 64
"""Number of recorded windows per style, evenly spaced. Fixed; it bounds the cost of a step."""


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
        places: converts normalised motion (B, D, T) to joint positions (B, K, 3, T), metres.
        window: frames of a window at the full rate; None for whole sequences.
        styles: number of styles; 1 without styles.
    """

    floor: Tensor

    def __init__(
        self,
        sequences: Sequence[PairedSequence],
        level: int,
        places: Callable[[Tensor], Tensor],
        window: int | None,
        styles: int,
    ) -> None:
        super().__init__()
        self.network = sequences[0].network
        powers: list[list[Tensor]] = [[] for _ in range(styles)]
        share = MOST_WINDOWS / sum(sequence.n_frames for sequence in sequences)
        for sequence in sequences:
            whole = sequence.lengths[level]
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
        everywhere = torch.cat([power for of_style in powers for power in of_style]).mean()
        self.register_buffer("floor", (_DETAIL_FLOOR**2 * everywhere).clamp(min=_LEAST_DETAIL))
        for style, of_style in enumerate(powers):
            if not of_style:  # no recording has this style of a model to start from
                continue
            logs = self._log(torch.cat(of_style))
            few = torch.linspace(0, len(logs) - 1, min(len(logs), _DETAIL_WINDOWS)).round().long()
            self.register_buffer(f"recorded{style}", logs[few])

    def _power(self, places: Tensor) -> Tensor:
        """Return the mean square (B, K), m^2, of movement too fast for the next coarser level."""
        n_frames = places.shape[-1]
        coarser = resample(places, self.network.lengths(n_frames)[-2])
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
            alike = made[styles == style]
            if len(alike) < 2:
                continue
            recorded = getattr(self, f"recorded{style}") / made.shape[1] ** 0.5
            total = total + len(alike) / len(made) * losses.detail(alike, recorded)
        return total


class StateTarget(nn.Module):
    """State of movement that a level should show, given the state of the whole motion.

    A coarse level moves less than the finest one, and shows little of the fast movement: a line for
    each channel, fitted to the recordings, tells what it shows, and the share of the variance that
    the line explains tells how much the channel counts there.

    Args:
        state: of the recordings.
        level: index of the level.
        places: converts normalised motion (B, D, T) to joint positions (B, K, 3, T), metres.
    """

    line: Tensor
    weight: Tensor

    def __init__(
        self, state: TrainingState, level: int, places: Callable[[Tensor], Tensor]
    ) -> None:
        super().__init__()
        self.channels, fps = state.process.channels, state.process.fps
        self.fps = fps
        given, shown = [], []
        for sequence in state.data.sample:
            n_frames = sequence.lengths[level]
            if n_frames < _LEAST_FRAMES:
                continue
            self.fps = fps * n_frames / sequence.n_frames
            channels = state.recorded(sequence)[: len(self.channels.names)]
            given.append(torch.from_numpy(averaged(channels, n_frames)))
            motion = resample(sequence.motion[:, :][None], n_frames)
            shown.append(self.channels(places(motion).cpu(), self.fps)[0])
        if not given:  # nothing is asked of levels of so few frames
            given = shown = [torch.zeros(len(self.channels.names), _LEAST_FRAMES)]
        self.register_buffer("line", torch.from_numpy(_lines(given, shown)).float()[..., None])
        slope, _, size = self.line
        counts = torch.from_numpy(self.channels.counts).float()[:, None]
        together = torch.cat(given, dim=1)
        explained = (slope * together.std(dim=1, keepdim=True) / size).square().clamp(max=1.0)
        self.register_buffer("weight", counts * explained / size)

    def forward(self, places: Tensor, state: Tensor) -> Tensor:
        """Return the loss () of joint positions (B, K, 3, T), metres, of a state (B, C, T)."""
        slope, offset, _ = self.line
        return losses.state(self.channels(places, self.fps), slope * state + offset, self.weight)


def _lines(given: Sequence[Tensor], shown: Sequence[Tensor]) -> np.ndarray:
    """Return slope and offset of the least-squares line of each channel, and its deviation, (3, C).

    Args:
        given: (C, T_k) of each recording.
        shown: (C, T_k), to be predicted from it.
    """
    x, y = (torch.cat(list(parts), dim=1).double().numpy() for parts in (given, shown))
    mean = y.mean(axis=1)
    away = x - x.mean(axis=1, keepdims=True)
    slope = (away * y).mean(axis=1) / np.maximum(np.square(away).mean(axis=1), 1e-9)
    return np.stack([slope, mean - slope * x.mean(axis=1), np.maximum(y.std(axis=1), 1e-3)])


def arm_target(
    sequences: Sequence[PairedSequence],
    index: int,
    normaliser: Normaliser,
    kinematics: VectorKinematics,
) -> ArmTarget:
    """Fit the regression of a level from the paired speech to the recorded arm movement.

    Recorded speed is unfiltered and generated speed is smoothed (`VectorKinematics.arm_speed`), so
    that generated arms have to move as fast as the recorded ones without trembling. Acceleration is
    filtered the other way round: recordings without capture noise, generated motion with all its
    trembling.
    """
    device, stride = normaliser.mean.device, 1.0
    speeches, movements = [], []
    for sequence in sequences:
        n = sequence.lengths[index]
        if n < 2:
            continue  # a single frame has no speed
        stride = sequence.n_frames / n
        values = normaliser.inverse(resample(sequence.motion[:, :][None].to(device), n))
        movements.append(kinematics.recorded_arm_movement(values, stride)[0])
        speeches.append(resample(sequence.speech[:, :].to(device), n))
    return ArmTarget(stride / kinematics.fps).to(device).fit(speeches, movements)
