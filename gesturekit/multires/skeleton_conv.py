"""Skeleton-aware convolution: each joint sees the joints near it on the rig's own tree.

Aberman et al. 2020, in the form of Li et al. 2022 (GANimator). The channels of a frame are split
into blocks: one a modelled joint, one a foot contact, one for the root's displacement.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gesturekit.motion.representation import MultiresRepresentation
from gesturekit.multires.interpolation import reflect


def block_neighbours(representation: MultiresRepresentation, distance: int) -> np.ndarray:
    """(B, B) bool: which blocks see which.

    Joints at most `distance` bones apart see one another. A contact stands at its foot's joint.
    The root's displacement stands at the root joint and sees all contacts.
    """
    skeleton = representation.skeleton
    joints = [skeleton.index(name) for name in representation.joints]
    # Distances over the whole rig: a joint that is not modelled still lies between its neighbours.
    n_joints = skeleton.n_joints
    apart = np.full((n_joints, n_joints), np.inf)
    np.fill_diagonal(apart, 0)
    for child, parent in enumerate(skeleton.parents):
        if parent >= 0:
            apart[child, parent] = apart[parent, child] = 1
    for middle in range(n_joints):
        apart = np.minimum(apart, apart[:, middle, None] + apart[None, middle])
    feet = [skeleton.index(point.joint) for point in representation.foot_points]
    places = [*joints, *feet, representation.root]
    near = apart[np.ix_(places, places)] <= distance
    contacts = slice(len(joints), len(joints) + len(feet))
    near[-1, contacts] = near[contacts, -1] = True
    return near


class SkeletonConv1d(nn.Module):
    """Convolution over time whose output blocks see only the input blocks near them.

    Only live weights are parameters: some 80 % of the dense kernel is zero and costs neither
    memory, nor optimiser state, nor room in the model file. The arithmetic is a dense convolution,
    which on a CPU beats grouped and gathered ones at these sizes (benchmarks/RESULTS.md).

    Args:
        neighbours: (B, B) bool, from `block_neighbours`.
        sizes_in: channels of each input block.
        sizes_out: channels of each output block.
        kernel: odd number of frames; the ends are padded by reflection.
    """

    live: Tensor

    def __init__(
        self, neighbours: np.ndarray, sizes_in: Sequence[int], sizes_out: Sequence[int], kernel: int
    ) -> None:
        super().__init__()
        self.padding = kernel // 2
        self.shape = (sum(sizes_out), sum(sizes_in), kernel)
        mask = np.repeat(np.repeat(neighbours, sizes_out, axis=0), sizes_in, axis=1)
        live = np.flatnonzero(np.repeat(mask[..., None], kernel, axis=2))
        self.register_buffer("live", torch.from_numpy(live), persistent=False)
        # Each output channel starts as a layer of its own fan-in would (Kaiming, a = sqrt 5).
        bound = 1 / np.sqrt(kernel * mask.sum(axis=1))
        per_weight = np.broadcast_to(bound[:, None, None], self.shape).reshape(-1)[live]
        self.weight = nn.Parameter(torch.empty(len(live)).uniform_(-1, 1))
        self.bias = nn.Parameter(torch.empty(self.shape[0]).uniform_(-1, 1))
        with torch.no_grad():
            self.weight.mul_(torch.from_numpy(per_weight.astype(np.float32)))
            self.bias.mul_(torch.from_numpy(bound.astype(np.float32)))

    def dense_weight(self) -> Tensor:
        """(channels out, channels in, kernel), zero where blocks do not see one another."""
        dense = self.weight.new_zeros(math.prod(self.shape))
        return dense.index_put((self.live,), self.weight).view(self.shape)

    def forward(self, x: Tensor) -> Tensor:
        """(B, channels in, T) to (B, channels out, T)."""
        return F.conv1d(reflect(x, self.padding), self.dense_weight(), self.bias)
