"""How much of where each joint goes is finer than the level below can hold, as in recordings.

Critics weigh what is wrong by its size, and fine detail is a hundredth of a posture: left to
them, fine levels add next to nothing. It is not in the paper; with `losses.detail` at 0 it does not
exist.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

import audio_features as af
from gesturekit.multires import losses
from gesturekit.multires.network.resampling import resample
from gesturekit.multires.training.data import PairedSequence, TrainingData

_FLOOR = 0.1
"""Of the RMS detail of all styles; joints that have less are as good as still."""
_WINDOWS = 64
"""Of each style, evenly chosen, that stand for all."""


class DetailTarget(nn.Module):
    """How much detail one level has at each joint: distributions over windows, one for each style.

    Windows differ: a wave, then rest. So it is the energy distance (Szekely and Rizzo 2013) between
    distributions that is to vanish; were every window held to the mean, all would be alike. Joints
    are compared by their places: along an arm rotations add up, or make up for one another.

    Args:
        sequences: recordings.
        level: its index; not the first, below which there is nothing.
        levels: L.
        places: takes normalised motion (B, D, T) to where joints are, (B, K, 3, T) in metres.
        window: frames at the full rate that are taken together; None for whole sequences.
        styles: how many there are; 1 where there are none.
    """

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
        for sequence in sequences:
            whole = af.level_lengths(sequence.n_frames, levels)[level]
            motion = resample(sequence.motion[None], whole)
            size = whole
            if window is not None and window < sequence.n_frames:
                size = max(2, round(whole * window / sequence.n_frames))
            windows = motion[0].unfold(-1, size, 1).transpose(0, 1)
            powers[sequence.style].append(self._power(places(windows)))
        everywhere = torch.cat([part for parts in powers for part in parts]).mean()
        self.register_buffer("floor", _FLOOR**2 * everywhere)
        for style, parts in enumerate(powers):
            logs = self._log(torch.cat(parts))
            few = torch.linspace(0, len(logs) - 1, min(len(logs), _WINDOWS)).round().long()
            self.register_buffer(f"recorded{style}", logs[few])

    def _power(self, places: Tensor) -> Tensor:
        """(B, K), m^2, of what as many frames as the level below has cannot hold."""
        n_frames = places.shape[-1]
        coarser = resample(places, af.level_lengths(n_frames, 2)[0])
        return (places - resample(coarser, n_frames)).square().mean(dim=(2, 3))

    def _log(self, power: Tensor) -> Tensor:
        return 0.5 * torch.log(power + self.floor)

    def forward(self, places: Tensor, styles: Tensor) -> Tensor:
        """Energy distance, up to a constant, between the detail of motions and of recordings.

        Args:
            places: (B, K, 3, T) of motions of this level.
            styles: (B,) their numbers. One of its kind says nothing about a distribution.
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
    """Return the targets of these levels by index; the first level has none below it."""
    styles = max(1, len(data.styles))
    return {
        i: DetailTarget(data.paired, i, levels, places, data.window, styles).to(device)
        for i in indices
        if i
    }
