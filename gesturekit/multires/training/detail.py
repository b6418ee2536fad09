"""Loss on the amount of fine detail that a level adds, compared with recordings.

Detail is joint movement that the frame rate of the next coarser level cannot represent.
Discriminators respond to the size of an error, and detail is only a hundredth of the size of a
pose: without this loss, fine levels add almost nothing. Not in the paper; unused if `losses.detail`
is 0.
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
"""Fraction of the RMS detail over all styles below which a joint counts as still. Fixed; it keeps
the logarithm finite."""
_LEAST = 1e-12
"""Smallest floor, m^2, for rigs whose joints never move relative to the root, such as a single
joint."""
_WINDOWS = 64
"""Number of recorded windows per style, evenly spaced. Fixed; it bounds the cost of a step."""


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
        self.register_buffer("floor", (_FLOOR**2 * everywhere).clamp(min=_LEAST))
        for style, parts in enumerate(powers):
            if not parts:  # no recording has this style of a model to start from
                continue
            logs = self._log(torch.cat(parts))
            few = torch.linspace(0, len(logs) - 1, min(len(logs), _WINDOWS)).round().long()
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
        i: DetailTarget(data.paired, i, levels, places, data.window, styles).to(device)
        for i in indices
        if i
    }
