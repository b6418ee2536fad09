"""Rotations and forward kinematics in torch: differentiable, batched, for losses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from gesturekit.motion.contacts import foot_points
from gesturekit.motion.model_joints import ModelJoints
from gesturekit.motion.rotations import matrix_from_quaternion


def sixd_to_matrix(x: Tensor) -> Tensor:
    """(..., 6) to rotation matrices (..., 3, 3) by Gram-Schmidt (Zhou et al. 2019).

    The six numbers are the first two columns, one after the other. Lengths are taken as
    sqrt(v.v + 1e-12), so that neither the value nor the gradient is ever NaN, zeros included;
    for columns longer than 1e-3 this differs from the exact rotation by less than 1e-6.
    """
    # Entry by entry over long arrays: three times faster than reductions over axes of three.
    ax, ay, az, bx, by, bz = x.movedim(-1, 0).contiguous().unbind(0)
    scale = torch.rsqrt(ax * ax + ay * ay + az * az + 1e-12)
    ax, ay, az = ax * scale, ay * scale, az * scale
    along = ax * bx + ay * by + az * bz
    bx, by, bz = bx - along * ax, by - along * ay, bz - along * az
    scale = torch.rsqrt(bx * bx + by * by + bz * bz + 1e-12)
    bx, by, bz = bx * scale, by * scale, bz * scale
    cx, cy, cz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    entries = torch.stack([ax, bx, cx, ay, by, cy, az, bz, cz])
    return entries.movedim(0, -1).unflatten(-1, (3, 3))


def rotation_vector_to_matrix(x: Tensor) -> Tensor:
    """Convert rotation vectors (..., 3), radians, to matrices (..., 3, 3) by Rodrigues' formula.

    The angle is taken as sqrt(x.x + 1e-12), so that the gradient is finite at zero.
    """
    angle = (x.square().sum(dim=-1) + 1e-12).sqrt()
    # sin(a) / a and (1 - cos(a)) / a^2; torch.sinc(t) is sin(pi t) / (pi t).
    first = torch.sinc(angle / torch.pi)[..., None, None]
    second = 0.5 * torch.sinc(angle / (2 * torch.pi)).square()[..., None, None]
    vx, vy, vz = x.unbind(-1)
    zero = torch.zeros_like(vx)
    entries = torch.stack([zero, -vz, vy, vz, zero, -vx, -vy, vx, zero], dim=-1)
    cross = entries.unflatten(-1, (3, 3))
    one = torch.eye(3, dtype=x.dtype, device=x.device)
    return one + first * cross + second * (cross @ cross)


class ForwardKinematics(nn.Module):
    """World positions of a rig's joints from local rotation matrices.

    Rotations are multiplied down the tree, one step a level of depth. A position is then a sum
    over the joints above it, p_i = p_root + sum_k R_k s_ki, where s_ki is the offset of k's child
    on the way to i: one batched matrix product for all joints, forward and backward.
    """

    inner: Tensor
    reach: Tensor

    def __init__(self, parents: Sequence[int], offsets: np.ndarray) -> None:
        """Precompute the levels of a tree.

        Args:
            parents: index of each joint's parent, -1 for the root, which comes first.
            offsets: (J, 3) rest offsets, metres; the root's is not used.
        """
        super().__init__()
        parents = [int(parent) for parent in parents]
        offsets = torch.from_numpy(np.array(offsets, dtype=np.float64))
        depth: list[int] = []
        for parent in parents:
            depth.append(depth[parent] + 1 if parent >= 0 else 0)
        # A leaf's own rotation moves nothing: only inner joints are multiplied out, level by
        # level, and stand in that order.
        inner = sorted(set(parents) - {-1}, key=lambda j: depth[j])
        self.register_buffer("inner", torch.tensor(inner, dtype=torch.long))
        self.level_sizes: list[int] = []
        above: list[int] = []
        while len(inner) > sum(self.level_sizes):
            joints = [j for j in inner if depth[j] == len(self.level_sizes)]
            rows = [above.index(parents[j]) for j in joints if above]
            # No gather where every joint of the level above carries on one chain, in order.
            gathered = None if rows == list(range(len(above))) else torch.tensor(rows)
            self.register_buffer(f"rows_{len(self.level_sizes)}", gathered)
            self.level_sizes.append(len(joints))
            above = joints
        reach = torch.zeros(3, len(inner), len(parents), dtype=torch.float64)
        for i in range(len(parents)):
            joint = i
            while parents[joint] >= 0:
                reach[:, inner.index(parents[joint]), i] = offsets[joint]
                joint = parents[joint]
        self.register_buffer("reach", reach.float())

    def forward(self, rotations: Tensor, translation: Tensor) -> Tensor:
        """Positions (..., J, 3), metres.

        Args:
            rotations: (..., J, 3, 3) local rotation matrices.
            translation: (..., 3) world position of the root.
        """
        # Gathered as `from_inner` goes on with them: entries first, joints last.
        inner = rotations.movedim((-2, -1), (0, 1)).index_select(-1, self.inner)
        return self.from_inner(inner.movedim((0, 1), (-2, -1)), translation)

    def from_inner(self, rotations: Tensor, translation: Tensor) -> Tensor:
        """Positions (..., J, 3) from the rotations of `inner` alone, the I joints with children.

        Args:
            rotations: (..., I, 3, 3) local rotation matrices, in the order of `inner`.
            translation: (..., 3) world position of the root.
        """
        root = translation.unsqueeze(-2)
        if not self.level_sizes:
            return root
        # Entries of the matrices first, joints last, (3, 3, ..., joints): the products are then
        # a few operations on long arrays, not thousands of tiny ones.
        local = rotations.movedim((-2, -1), (0, 1))
        turned: list[Tensor] = []
        for level, matrices in enumerate(local.split(self.level_sizes, dim=-1)):
            if level:
                rows = getattr(self, f"rows_{level}")
                above = turned[-1] if rows is None else turned[-1].index_select(-1, rows)
                matrices = (above.unsqueeze(2) * matrices.unsqueeze(0)).sum(dim=1)
            turned.append(matrices)
        # (3, 3, N, inner joints) @ (3, inner joints, J): what each adds to every joint's place.
        batch = rotations.shape[:-3]
        flat = torch.cat(turned, dim=-1).reshape(3, 3, -1, len(self.inner))
        steps = (flat @ self.reach.to(flat.dtype)).sum(dim=1)
        return root + steps.reshape(3, *batch, -1).movedim(0, -1)


class PointKinematics(nn.Module):
    """Positions of joints, or of points fixed to them, by forward kinematics.

    All lengths are in metres of the reference body, as in motion vectors (`ModelJoints.scale`).

    Attributes:
        turned: (n,) indices of the modelled joints whose rotations the positions depend on.
    """

    fixed: Tensor
    rows: Tensor
    turned: Tensor

    def __init__(
        self, model: ModelJoints, joints: Sequence[int], points: np.ndarray | None = None
    ) -> None:
        """Prepare the kinematic chain.

        Args:
            model: the rig and its modelled joints.
            joints: indices in the skeleton, at least one.
            points: (F, 3) offsets from these joints, metres; None for the joints themselves.
        """
        super().__init__()
        skeleton = model.skeleton
        modelled = [skeleton.index(name) for name in model.joints]
        # Only joints on the way from the root to the requested ones.
        needed = {modelled[0]}
        for joint in joints:
            while joint not in needed and joint >= 0:
                needed.add(joint)
                joint = skeleton.parents[joint]
        order = sorted(needed, key=lambda j: (j != modelled[0], j))
        place = {joint: i for i, joint in enumerate(order)}
        still = model.fixed_translations
        offsets = [still.get(skeleton.names[j], skeleton.offsets[j]) for j in order]
        offsets = [offset / model.scale for offset in offsets]
        parents = [-1, *(place[skeleton.parents[j]] for j in order[1:])]
        at = [place[joint] for joint in joints]
        self.wanted: list[int] | slice = slice(None) if at == list(range(len(order))) else at
        if points is not None:
            parents = [*parents, *at]
            offsets += [point / model.scale for point in points]
            self.wanted = slice(len(order), None)
        self.chain = ForwardKinematics(parents, np.array(offsets))
        turning = [order[i] for i in self.chain.inner.tolist()]
        held = [joint for joint in turning if joint not in modelled]
        matrices = matrix_from_quaternion(model.fixed_rotations[held])
        self.register_buffer("fixed", torch.from_numpy(matrices).float())
        # Index of each joint's rotation: modelled joints first, fixed ones after them.
        turned = [joint for joint in turning if joint in modelled]
        rows = [[*turned, *held].index(joint) for joint in turning]
        self.register_buffer("rows", torch.tensor(rows, dtype=torch.long))
        turned = torch.tensor([modelled.index(joint) for joint in turned], dtype=torch.long)
        self.register_buffer("turned", turned)

    def forward(self, rotations: Tensor, height: Tensor) -> Tensor:
        """Return positions (B, T, P, 3), with the root above the origin.

        Args:
            rotations: (B, T, n, 3, 3) matrices of the joints `turned`; the root's in world axes.
            height: (B, T) of the root.
        """
        if len(self.fixed):
            fixed = self.fixed.expand(*rotations.shape[:2], -1, -1, -1)
            rotations = torch.cat([rotations, fixed], dim=2).index_select(2, self.rows)
        root = torch.stack([torch.zeros_like(height), height, torch.zeros_like(height)], dim=-1)
        return self.chain.from_inner(rotations, root)[:, :, self.wanted]


def foot_kinematics(model: ModelJoints) -> PointKinematics | None:
    """Return the kinematics of the rig's foot points (`foot_points`); None if it has none."""
    points = foot_points(model.skeleton)
    if not points:
        return None
    joints = [model.skeleton.index(point.joint) for point in points]
    return PointKinematics(model, joints, np.array([point.offset for point in points]))
