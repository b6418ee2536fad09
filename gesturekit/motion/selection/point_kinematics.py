"""Differentiable positions of joints and foot points from the rotations of the modelled joints."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from gesturekit.motion.contacts import foot_points
from gesturekit.motion.rotations import matrix_from_quaternion
from gesturekit.motion.selection.model_joints import ModelJoints
from gesturekit.motion.torch_kinematics import ForwardKinematics


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
        self.register_buffer("fixed", torch.from_numpy(matrices).float(), persistent=False)
        # Index of each joint's rotation: modelled joints first, fixed ones after them.
        turned = [joint for joint in turning if joint in modelled]
        rows = [[*turned, *held].index(joint) for joint in turning]
        self.register_buffer("rows", torch.tensor(rows, dtype=torch.long), persistent=False)
        turned = torch.tensor([modelled.index(joint) for joint in turned], dtype=torch.long)
        self.register_buffer("turned", turned, persistent=False)

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
