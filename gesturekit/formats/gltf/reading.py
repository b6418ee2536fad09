"""Motion of any skeleton in a glTF file.

A rig's joints are turned to the axes of the world at rest, so that its rest pose is that of the
file: joints of most programs have axes along their bones. Scales of nodes become part of offsets
and joint translations; world positions stay those of the file.
"""

from __future__ import annotations

import os
import warnings
from contextlib import suppress
from dataclasses import replace

import numpy as np

from gesturekit.errors import FormatError, MotionError
from gesturekit.formats.conventions import (
    AXES,
    METRES,
    USUAL_FORWARD,
    FileAxes,
    file_axes,
    guess_unit,
    with_y_up,
)
from gesturekit.formats.gltf.faces import expression_nodes
from gesturekit.formats.gltf.file import Gltf
from gesturekit.formats.gltf.scene import AT_REST, Nodes, read_animation
from gesturekit.formats.gltf.vrm import avatar_bones
from gesturekit.motion.motion import Motion
from gesturekit.motion.rotations import invert_quaternions, multiply_quaternions, rotate_vectors
from gesturekit.motion.skeleton import Skeleton, unique_names
from gesturekit.wording import listed, printable

END_SITE = "gesturekit_end_site"
"""Key of the `extras` of nodes that are end sites in files that we wrote."""
_STILL = 1e-5
"""Positions within a parent that vary by no more than this, metres, are a constant offset."""
_MOST = 800_000
"""Nodes times frames that even the smallest file may have; larger files may have more."""
_BODY = 0.6
"""Least share of the joints in one tree, if a node above several trees is not their root."""


def read_gltf(
    path: str | os.PathLike[str],
    *,
    animation: str | None = None,
    unit: str = "m",
    up: str = "y",
    forward: str = "auto",
    fps: float | None = None,
) -> Motion:
    """Read an animation of a .glb or .gltf file; without one, its rest pose as a single frame.

    Joints are the nodes of all skins, the bones of a VRM avatar, and what hangs on them without a
    mesh; without these, the trees of animated nodes. Of several skeletons the largest is read.
    Animated weights of morph targets with names (`extras.targetNames` of their mesh), and the
    expressions of a VRM animation, are the face.

    Args:
        path: the file. Arrays may lie in it, in data URIs, or in files of its folder.
        animation: name of the animation, or its number from 1 on; by default the longest that
            moves the skeleton.
        unit: of its lengths, one of `METRES`.
        up: axis that points up, "x" to "z" or "-x" to "-z".
        forward: axis that the asset faces; "auto" is +Z for Y up, as the format has it.
        fps: frames per second at which curves are sampled; by default a common rate with frames
            at all keys. The first frame is at the first key.

    Returns:
        The motion, metres, Y up, +Z forward. `info` has `source`, `unit`, `up`, `forward`,
        `animation` (its name), `start` (time of the first frame in it, seconds) and `renamed` (new
        name to name in the file).

    Warns:
        UserWarning: a choice among animations or skeletons, keys between frames, an unlikely unit,
            animated morph targets without names.

    Raises:
        FormatError: not glTF 2.0, broken, compressed, or without joints.
    """
    gltf = Gltf(path)
    if unit not in METRES:
        raise gltf.error(f"unit {unit!r}; expected {', '.join(METRES)}")
    nodes = Nodes(gltf)
    joints, ends = _joints(gltf, nodes)
    names, renamed = _names(gltf, joints)
    moving = nodes.with_ancestors(joints)
    chosen = read_animation(gltf, set(moving), animation)
    try:
        times, rate = chosen.frames(fps, gltf, (_MOST + gltf.size // 8) // len(moving))
        rig = _rest(nodes, joints, ends, names, METRES[unit])
        motion = _moved(rig, nodes.world(joints, chosen.curves, times), METRES[unit], rate)
        motion = replace(_in_our_axes(motion, up, forward), face=chosen.face_at(times, gltf))
    except MotionError as error:
        raise gltf.error(str(error)) from None
    motion.info.update(source=str(path), unit=unit, renamed=renamed)
    motion.info.update(animation=chosen.name, start=float(times[0]))
    likely, is_sure = guess_unit(motion.skeleton, motion.rotations[0])
    if unit == "m" and is_sure and likely != "m":
        text = f"its body is as large as if the unit were {likely}, not m: --in-unit {likely}"
        warnings.warn(f"{path}: {text}", stacklevel=2)
    return motion


def _joints(gltf: Gltf, nodes: Nodes) -> tuple[list[int], list[int]]:
    """Return the nodes of the largest skeleton, parents first, and those of end sites.

    Warns:
        UserWarning: joints that are not below its root.
    """
    entries = gltf.items("nodes")
    expressions = set(expression_nodes(gltf).values())
    named = _named_joints(gltf, nodes, expressions)
    if not named:
        raise gltf.error("no skeleton in it: neither a skin nor an animated node")
    inside, below = set(named), set(named)
    for node in nodes.order:
        is_no_joint = node in expressions or entries[node].keys() & {"mesh", "camera"}
        if nodes.parents[node] in inside and not is_no_joint:
            inside.add(node)
        if nodes.parents[node] in below:
            below.add(node)
    inside = below & set(nodes.with_ancestors(list(inside)))  # also those between two of them
    trees = _trees(nodes, inside)
    root = max(trees, key=lambda node: len(trees[node]))
    above = nodes.parents[root]
    if above >= 0 and len(trees[root]) < _BODY * len(inside):
        beside = [node for node in trees if nodes.parents[node] == above]
        if len(beside) > 1:
            trees[above] = [above, *(node for tree in beside for node in trees.pop(tree))]
            root = above
    tree = set(trees.pop(root))
    if trees:
        named = {node: str(entries[node].get("name", node)) for node in (root, *trees)}
        text = f"several skeletons; that of {named.pop(root)[:60]} with {len(tree)} joints is read"
        others = listed([name[:60] for name in named.values()], 4)
        warnings.warn(f"{gltf.path}: {text}, not {others}", stacklevel=3)
    extras = {node: gltf.object(entries[node], "extras") for node in tree - {root}}
    marked = {node for node, extra in extras.items() if END_SITE in extra}
    if any(nodes.parents[node] in marked for node in tree):
        marked = set()
    joints, ends = ([n for n in nodes.order if n in some] for some in (tree - marked, marked))
    return joints, ends


def _named_joints(gltf: Gltf, nodes: Nodes, expressions: set[int]) -> set[int]:
    """Return joints of all skins and bones of an avatar, or nodes that are animated, and above.

    Nodes of expressions are none.
    """
    entries = gltf.items("nodes")
    n_nodes = len(entries)
    joints = {j for skin in gltf.items("skins") for j in gltf.wholes(skin, "joints", n_nodes)}
    if gltf.object(gltf.json, "extensions").keys() & {"VRM", "VRMC_vrm"}:
        with suppress(FormatError):  # a humanoid with missing bones has joints all the same
            joints |= set(avatar_bones(gltf)[0])
    if joints:
        return joints
    for animation in gltf.items("animations"):
        for channel in gltf.items("channels", animation):
            target = gltf.object(channel, "target")
            if target.get("path") in ("rotation", "translation") and "node" in target:
                joints.add(gltf.whole(target["node"], n_nodes, "node of a channel"))
    joints -= expressions
    whole: set[int] = set()
    for node in nodes.with_ancestors(list(joints)):
        below = set(entries[node].get("children", [])) - expressions
        is_holder = node not in joints and len(below) == 1
        if nodes.parents[node] in whole or not is_holder:
            whole.add(node)
    return whole


def _trees(nodes: Nodes, joints: set[int]) -> dict[int, list[int]]:
    """Return {root: its joints, parents first}."""
    roots: dict[int, int] = {}
    trees: dict[int, list[int]] = {}
    for node in nodes.order:
        if node in joints:
            roots[node] = roots.get(nodes.parents[node], node)
            trees.setdefault(roots[node], []).append(node)
    return trees


def _names(gltf: Gltf, joints: list[int]) -> tuple[list[str], dict[str, str]]:
    """Return unique names of joints, and new name to name in the file."""
    entries = gltf.items("nodes")
    labels = [str(entries[node].get("name", "")) for node in joints]
    named = [printable(name).strip() or f"node_{node}" for name, node in zip(labels, joints)]
    names = unique_names(named)
    return names, {new: old for new, old in zip(names, labels) if new != old}


def _rest(
    nodes: Nodes, joints: list[int], ends: list[int], names: list[str], metres: float
) -> tuple[Skeleton, np.ndarray]:
    """Return the rig at rest, and the world rotations (J, 4) of its nodes there."""
    positions, turns = (each[0] for each in nodes.world(joints + ends, {}, AT_REST))
    at = {node: k for k, node in enumerate(joints)}
    above = np.array([at.get(nodes.parents[node], -1) for node in joints + ends], int)
    offsets = metres * (positions - np.where(above[:, None] >= 0, positions[above], 0.0))
    sites: dict[str, list[np.ndarray]] = {}
    for parent, site in zip(above[len(joints) :], offsets[len(joints) :]):
        sites.setdefault(names[parent], []).append(site)
    n_joints = len(joints)
    parents = (-1, *above[1:n_joints])
    return Skeleton(tuple(names), parents, offsets[:n_joints], end_sites=sites), turns[:n_joints]


def _moved(
    rig: tuple[Skeleton, np.ndarray],
    world: tuple[np.ndarray, np.ndarray],
    metres: float,
    fps: float,
) -> Motion:
    """Return the motion of a rig at rest to world positions (T, J, 3) and rotations (T, J, 4)."""
    (skeleton, rest), (positions, turns) = rig, world
    positions = metres * positions
    turns = multiply_quaternions(turns, invert_quaternions(rest))
    above = list(skeleton.parents[1:])
    inverse = invert_quaternions(turns[:, above])
    local = np.concatenate([turns[:, :1], multiply_quaternions(inverse, turns[:, 1:])], axis=1)
    steps = rotate_vectors(inverse, positions[:, 1:] - positions[:, above])
    low, high = steps.min(axis=0), steps.max(axis=0)
    moves = (high - low > _STILL).any(axis=1)
    offsets = skeleton.offsets.copy()
    offsets[1:][~moves] = ((low + high) / 2)[~moves]
    moving = {skeleton.names[j + 1]: steps[:, j] for j in np.flatnonzero(moves)}
    return Motion(replace(skeleton, offsets=offsets), local, positions[:, 0], fps, moving)


def _in_our_axes(motion: Motion, up: str, forward: str) -> Motion:
    """Return the motion with Y up and +Z forward; its rest pose stands and faces +Z if it can."""
    axes = file_axes(motion)
    forward = USUAL_FORWARD.get(up, "z") if forward == "auto" else forward
    if not {up, forward}.issubset(AXES):
        raise MotionError(f"axes {up!r} and {forward!r}; expected {', '.join(AXES)}")
    rest = axes.rest or (None if "forward" in axes.guessed else (axes.up, axes.forward))
    motion = with_y_up(motion, FileAxes(up, forward, rest))
    motion.info.update(up=up, forward=forward)
    return motion
