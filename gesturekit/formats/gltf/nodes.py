"""Tree of the nodes of a glTF file, and their transforms at rest or along curves."""

from __future__ import annotations

from collections.abc import Mapping
from heapq import heappop, heappush

import numpy as np

from gesturekit.formats.gltf.animation import Curve
from gesturekit.formats.gltf.file import FARTHEST, Gltf
from gesturekit.motion.rotations import (
    matrix_from_quaternion,
    multiply_quaternions,
    normalize_quaternions,
    quaternion_from_matrix,
)

AT_REST = np.zeros(1)
"""A time (1,) for the rest pose, which has no curves."""
_DEEPEST = 1000
"""Largest number of nodes above one another; bodies have about 20."""
_AT_ONCE, _FEWEST = 100_000, 20
"""Nodes times frames that are computed in one block, which bounds memory, and its least frames."""


class Nodes:
    """Tree of N nodes.

    Attributes:
        order: all nodes, parents first, otherwise in the order of the file.
        parents: parent of each node, -1 for roots.
        depth: number of nodes above each node.
        rest: {"translation": (N, 3), "rotation": (N, 4), "scale": (N, 3)} in the parent's frame.
    """

    def __init__(self, gltf: Gltf) -> None:
        """Read the nodes of a file.

        Raises:
            FormatError: they form no tree, or one that is too deep.
        """
        nodes = gltf.items("nodes")
        below = [gltf.wholes(node, "children", len(nodes)) for node in nodes]
        self.parents = [-1] * len(nodes)
        for above, children in enumerate(below):
            for child in children:
                if self.parents[child] != -1 or child == above:
                    raise gltf.error(f"node {child} has two parents")
                self.parents[child] = above
        self.depth = [0] * len(nodes)
        self.order: list[int] = []
        waiting = [node for node, parent in enumerate(self.parents) if parent == -1]
        while waiting:  # a heap
            self.order.append(node := heappop(waiting))
            for child in below[node]:
                self.depth[child] = self.depth[node] + 1
                heappush(waiting, child)
        if len(self.order) < len(nodes):
            raise gltf.error("its nodes form no tree")
        if any(depth > _DEEPEST for depth in self.depth):
            raise gltf.error(f"over {_DEEPEST} nodes above one another")
        self._gltf = gltf
        found = [np.concatenate(self._local(node)) for node in nodes]
        rest = np.array(found).reshape(len(nodes), 10)
        self.rest = {
            "translation": rest[:, :3],
            "rotation": rest[:, 3:7],
            "scale": rest[:, 7:],
        }

    def _local(self, node: dict) -> tuple[np.ndarray, ...]:
        gltf = self._gltf
        if "matrix" in node:
            matrix = gltf.numbers(node, "matrix", [0.0] * 16).reshape(4, 4).T
            linear = matrix[:3, :3]
            scale = np.linalg.norm(linear, axis=0)
            if np.linalg.det(linear) < 0:
                scale[0] *= -1
            turn = quaternion_from_matrix(linear / np.where(scale == 0, 1.0, scale))
            return matrix[:3, 3], turn, scale
        turn = normalize_quaternions(gltf.numbers(node, "rotation", [0.0, 0.0, 0.0, 1.0]))
        return (
            gltf.numbers(node, "translation", [0.0, 0.0, 0.0]),
            turn,
            gltf.numbers(node, "scale", [1.0, 1.0, 1.0]),
        )

    def with_ancestors(self, nodes: list[int]) -> list[int]:
        """Return nodes and all above them, parents first."""
        found = set(nodes)
        for node in nodes:
            while (node := self.parents[node]) >= 0 and node not in found:
                found.add(node)
        return [node for node in self.order if node in found]

    def matrices(self) -> np.ndarray:
        """Return the transforms (N, 4, 4) from each node to the world at rest."""
        everything = list(range(len(self.parents)))
        places, _, linear = self._block(self.order, {}, AT_REST)
        back = np.argsort(self.order)
        world = np.tile(np.eye(4), (len(everything), 1, 1))
        world[:, :3, :3], world[:, :3, 3] = linear[0, back], places[0, back]
        return world

    def world(
        self,
        nodes: list[int],
        curves: Mapping[tuple[int, str], Curve],
        times: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return world positions (T, n, 3) and rotations (T, n, 4) of nodes at times (T,).

        Args:
            nodes: n nodes.
            curves: by node and property; other properties are those at rest.
            times: seconds.

        Raises:
            FormatError: a node is too far away.
        """
        needed = self.with_ancestors(nodes)
        at = {node: k for k, node in enumerate(needed)}
        wanted = [at[node] for node in nodes]
        positions = np.empty((len(times), len(nodes), 3))
        rotations = np.empty((len(times), len(nodes), 4))
        size = max(_FEWEST, _AT_ONCE // len(needed))
        for start in range(0, len(times), size):
            part = slice(start, start + size)
            places, turns, _ = self._block(needed, curves, times[part])
            positions[part], rotations[part] = places[:, wanted], turns[:, wanted]
        return positions, rotations

    def _block(
        self, nodes: list[int], curves: Mapping[tuple[int, str], Curve], times: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return positions (T, n, 3), rotations (T, n, 4) and linear parts (T, n, 3, 3).

        `nodes` are n nodes with all above them, parents first.
        """
        at = {node: k for k, node in enumerate(nodes)}
        local = {name: np.tile(rest[nodes], (len(times), 1, 1)) for name, rest in self.rest.items()}
        for (node, name), curve in curves.items():
            if node in at:
                local[name][:, at[node]] = curve.at(times)
        places, turns = local["translation"], local["rotation"]
        linear = matrix_from_quaternion(turns) * local["scale"][..., None, :]
        parents = np.array([at.get(self.parents[node], -1) for node in nodes], int)
        depth = np.array([self.depth[node] for node in nodes], int)
        by_depth = np.argsort(depth, kind="stable")
        for level in np.split(by_depth, np.flatnonzero(np.diff(depth[by_depth])) + 1)[1:]:
            above = parents[level]
            places[:, level] = places[:, above] + np.einsum(
                "tnij,tnj->tni", linear[:, above], places[:, level]
            )
            turns[:, level] = multiply_quaternions(turns[:, above], turns[:, level])
            linear[:, level] = linear[:, above] @ linear[:, level]
        if not ((np.abs(places) <= FARTHEST).all() and (np.abs(linear) <= FARTHEST).all()):
            raise self._gltf.error(f"places of its nodes are beyond {FARTHEST:g}")
        return places, turns, linear
