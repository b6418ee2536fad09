"""Channels of the state of movement, measured from joint positions; differentiable, for losses.

Slow channels say how much the body moves and where the hands are held, over some two seconds. The
fast channel of a hand says when it moves, and the coupling how much both hands move together. None
depends on where the body faces, and no motion can be rebuilt from them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from gesturekit.errors import MotionError
from gesturekit.motion.parts import SIDES, find_parts
from gesturekit.motion.skeleton import Skeleton
from gesturekit.state.prediction import SLOW_SECONDS

SPEED_FLOOR = 0.05
"""Added to speeds before the logarithm, m/s on the reference body."""
CARRIERS = 4
"""Carriers of each hand, see `StateProcess.carriers`: for the directions in which it moves."""
_WIDTH_FLOOR = 0.01
"""Added to widths before the logarithm, m on the reference body."""
_SPEED_SECONDS, _FAST_SECONDS = 0.04, 0.06
"""Standard deviations of the Gaussians that smooth velocities, and the fast logarithm of speed."""
_COUPLED_SECONDS, _COUPLED_SPEED = 1.0, 0.05
"""Smoothing of the coupling, and the vertical speed in m/s below which hands are not coupled."""
_TINY = 1e-8
"""Keeps the gradients of square roots finite."""
_FACING_SECONDS = 1.0
"""Standard deviation of the Gaussian that smooths where the body faces."""
_OF_HAND = ("movement", "height", "side", "forward", "width", "fast")


class StateChannels:
    """The C channels of a rig.

    - movement: slow part of the logarithm of the speed, m/s, relative to the root; of each hand,
      of the trunk and of the head;
    - height, side, forward: mean place of a hand above, outwards from and before the root, metres;
    - width: logarithm of the local standard deviation of the place, metres;
    - fast: logarithm of a hand's speed less its slow part;
    - coupling: local correlation of the hands' vertical velocities.

    A rig without known arms has the movement and the fast channel of all its joints.

    Args:
        hands: the joints of the left and of the right hand, as indices of the modelled joints; all
            joints as one group where the arms are not known or not modelled.
        trunk: index of the joint that carries both arms; None without.
        shoulders: indices of the left and of the right shoulder, which tell where the body faces;
            empty where the arms are not known.
        head: index of the head; None where it is not known or not modelled.

    Attributes:
        names: names of the channels.
        fast: (C,) bool, True for fast channels.
        movement: (C,) bool, True for channels of slow movement.
        of_hands: (H,) the channel of slow movement that belongs to each fast channel.
        held: the slow channels of each hand, which a network gets in the time of its movement.
        counts: (C,) weight of each channel in losses: 4 for a fast one, 1 for a slow one. Otherwise
            the few fast channels are lost among the slow ones, which are easier to obey.
        n_carriers: 4 H, see `StateProcess.carriers`.
        width: C + H + 4 H, the channels of `StateProcess.condition`.
    """

    def __init__(
        self,
        hands: Sequence[tuple[int, ...]],
        trunk: int | None = None,
        shoulders: Sequence[int] = (),
        head: int | None = None,
    ) -> None:
        self.hands, self.trunk, self.shoulders, self.head = hands, trunk, shoulders, head
        # Parts of the body of which only the movement is a channel, and their joints.
        parts = (("trunk", trunk), ("head", head))
        self._others = [(name, joint) for name, joint in parts if joint is not None]
        names = ["movement", "fast"]
        if len(hands) == 2:
            names = [f"{side} {name}" for side in SIDES for name in _OF_HAND]
            names += ["coupling", *(f"{name} movement" for name, _ in self._others)]
        self.names = tuple(names)
        self.fast = np.array([name.endswith("fast") for name in names])
        self.movement = np.array([name.endswith("movement") for name in names])
        self.of_hands = np.flatnonzero(self.movement)[: len(hands)]
        self.held = [np.arange(*ends) for ends in zip(self.of_hands, np.flatnonzero(self.fast))]
        self.counts = np.where(self.fast, 4.0, 1.0)
        self.n_carriers = CARRIERS * len(hands)
        self.width = len(names) + len(hands) + self.n_carriers

    @classmethod
    def find(cls, skeleton: Skeleton, joints: Sequence[str]) -> StateChannels:
        """Return the channels of a rig with these modelled joints."""
        whole = cls([tuple(range(len(joints)))])
        try:
            body = find_parts(skeleton)
        except MotionError:
            return whole
        arms, hands = [body.arms[side] for side in SIDES], []
        for arm in arms:
            known = [name for name in (arm.wrist, arm.elbow) if name in joints]
            if not known or arm.shoulder not in joints:
                return whole
            hands.append((joints.index(known[0]),))
        above = [set(skeleton.ancestors(skeleton.index(arm.shoulder))) for arm in arms]
        trunk = [j for j in above[0] & above[1] if j and skeleton.names[j] in joints]
        return cls(
            hands,
            joints.index(skeleton.names[max(trunk)]) if trunk else None,
            [joints.index(arm.shoulder) for arm in arms],
            joints.index(body.head) if body.head in joints else None,
        )

    def __call__(self, places: Tensor, fps: float) -> Tensor:
        """Return the channels (B, C, T).

        Args:
            places: (B, K, 3, T) positions of the modelled joints, metres on the reference body.
            fps: frames per second.
        """
        places = places - places[:, :1]
        groups = [*self.hands, *((joint,) for _, joint in self._others)]
        moving = sorted({joint for group in groups for joint in group})
        moved = places[:, moving]
        # A single frame does not move.
        steps = torch.gradient(moved, dim=-1)[0] if moved.shape[-1] > 1 else 0 * moved
        velocity = _smoothed(steps * fps, _SPEED_SECONDS * fps)
        speed = dict(zip(moving, (velocity.square().sum(dim=2) + _TINY).sqrt().unbind(dim=1)))
        speeds = [torch.stack([speed[joint] for joint in group]).mean(dim=0) for group in groups]
        logarithms, n_hands = torch.log(torch.stack(speeds, dim=1) + SPEED_FLOOR), len(self.hands)
        # All that is smoothed alike is smoothed at once, which takes a third of the time.
        fast = _smoothed(logarithms[:, :n_hands], _FAST_SECONDS * fps)
        held = self._held(places, fps)
        slow = _smoothed(torch.cat([logarithms, held, held.square()], dim=1), SLOW_SECONDS * fps)
        sizes = [len(groups), held.shape[1], held.shape[1]]
        movement, mean, square = slow.split(sizes, dim=1)
        rows: list[Tensor] = []
        for hand in range(n_hands):
            rows.append(movement[:, hand])
            if n_hands == 2:
                place = slice(3 * hand, 3 * hand + 3)
                variance = (square[:, place] - mean[:, place].square()).clamp(min=0).sum(dim=1)
                width = torch.log((variance + _TINY).sqrt() + _WIDTH_FLOOR)
                rows += [*mean[:, place].unbind(dim=1), width]
            rows.append(fast[:, hand] - movement[:, hand])
        if n_hands == 2:
            left, right = (velocity[:, moving.index(hand[0]), 1] for hand in self.hands)
            products = torch.stack([left.square(), right.square(), left * right], dim=1)
            *powers, both = _smoothed(products, _COUPLED_SECONDS * fps).unbind(dim=1)
            floor = _COUPLED_SPEED**2
            rows.append(both / ((powers[0] + floor) * (powers[1] + floor)).sqrt())
        rows += movement[:, n_hands:].unbind(dim=1)
        return torch.stack(rows, dim=1)

    def _held(self, places: Tensor, fps: float) -> Tensor:
        """Return height, side and forward of each hand (B, 3 H, T); (B, 0, T) without two hands.

        `places` (B, K, 3, T) are relative to the root.
        """
        if len(self.hands) == 1:
            return places[:, :0, 0]
        hands = [places[:, joints[0]] for joints in self.hands]
        left, right = (places[:, joint] for joint in self.shoulders)
        across = _smoothed((left - right)[:, ::2], _FACING_SECONDS * fps)
        x, z = (across / (across.square().sum(dim=1, keepdim=True) + _TINY).sqrt()).unbind(dim=1)
        rows: list[Tensor] = []
        for place, outwards in zip(hands, (1.0, -1.0)):
            side = place[:, 0] * x + place[:, 2] * z
            rows += [place[:, 1], outwards * side, place[:, 2] * x - place[:, 0] * z]
        return torch.stack(rows, dim=1)


def averaged(
    values: np.ndarray, n_frames: int, start: int = 0, stop: int | None = None
) -> np.ndarray:
    """Return values (..., T) averaged over each of `n_frames` equal parts of their duration.

    With start and stop, only that range of the parts is computed.
    """
    stop, length = n_frames if stop is None else stop, values.shape[-1]
    if length == n_frames:
        return values[..., start:stop]
    edges = np.arange(start, stop + 1) * (length / n_frames)
    first = int(edges[0])
    needed = values[..., first : min(length, int(np.ceil(edges[-1])))]
    zero = np.zeros((*needed.shape[:-1], 1))
    total = np.concatenate([zero, np.cumsum(needed, axis=-1, dtype=np.float64)], axis=-1)
    at = np.clip(edges - first, 0, needed.shape[-1])
    low = np.minimum(at.astype(int), needed.shape[-1] - 1)
    sums = total[..., low] + (at - low) * (total[..., low + 1] - total[..., low])
    return (np.diff(sums) / np.diff(edges)).astype(values.dtype)


def _smoothed(x: Tensor, sigma: float) -> Tensor:
    """Filter (..., T) by a Gaussian of `sigma` frames, cut at 3 sigma; end frames are repeated."""
    reach = int(3 * sigma)
    if reach == 0:
        return x
    at = torch.arange(-reach, reach + 1, device=x.device, dtype=x.dtype)
    kernel = torch.exp(-0.5 * (at / sigma) ** 2)
    # Indices, as the gradient of torch's own padding is not deterministic on a GPU.
    frames = torch.arange(-reach, x.shape[-1] + reach, device=x.device).clamp(0, x.shape[-1] - 1)
    rows = x.reshape(-1, 1, x.shape[-1]).index_select(-1, frames)
    return F.conv1d(rows, (kernel / kernel.sum())[None, None]).reshape(x.shape)
