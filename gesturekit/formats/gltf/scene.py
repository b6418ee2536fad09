"""Nodes of a glTF file, their transforms at rest or along curves, and the rate of the keys."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from heapq import heappop, heappush
from typing import Any

import numpy as np

from gesturekit.errors import FormatError
from gesturekit.formats.gltf.faces import expression_nodes, target_names, without_derived
from gesturekit.formats.gltf.file import FARTHEST, Gltf
from gesturekit.motion.face import MAX_CHANNELS, FaceTrack
from gesturekit.motion.resampling import COMMON_RATES, HIGHEST_FPS, LOWEST_FPS, checked_fps
from gesturekit.motion.rotations import (
    matrix_from_quaternion,
    multiply_quaternions,
    normalize_quaternions,
    quaternion_from_matrix,
    slerp,
)
from gesturekit.wording import listed, printable

_WIDTHS = {"translation": 3, "rotation": 4, "scale": 3, "weights": 1}
_SHOWN = 6
_EARLY = 1e-4
"""Seconds between a key and the time of its frame: rounding to float32."""
_NEAR = 0.02
"""Largest distance of a key from its frame, in frames."""
_SLOWEST, _FASTEST = 20.0, 240.0
"""Least and greatest frame rate of a motion whose keys are far apart, or lie anywhere."""
_ALIKE = 5e-3
"""Relative distance within which a common rate is likelier than the mean of the steps."""
_NO_KEYS_RATE = 30.0
_LONGEST_NAME, _NAME_STEPS = 200, 50
"""Longest name of a face channel, characters, and the work that a name counts as."""


class NoAnimationWarning(UserWarning):
    """A file without an animation, of which the rest pose is read."""


@dataclass(frozen=True, eq=False)
class Curve:
    """Keys of one property of a node.

    Attributes:
        times: (K,) seconds, in order.
        values: (K, D); for CUBICSPLINE (K, 3, D) with the tangents before and after each value.
        interpolation: LINEAR, STEP or CUBICSPLINE.
    """

    times: np.ndarray
    values: np.ndarray
    interpolation: str

    def at(self, times: np.ndarray) -> np.ndarray:
        """Return the values (T, D) at times (T,); before and after all keys those at the ends."""
        last = len(self.times) - 1
        left = np.clip(np.searchsorted(self.times, times + _EARLY) - 1, 0, last)
        right = np.minimum(left + 1, last)
        span = self.times[right] - self.times[left]
        after = times - self.times[left]
        after[after <= _EARLY] = 0.0  # at the key, or before all
        share = np.minimum(after, span) / np.maximum(span, 1e-9)
        is_rotation = self.values.shape[-1] == 4
        if self.interpolation == "CUBICSPLINE":
            u, dt = share[:, None], span[:, None]
            (_, start, out), (into, end, _) = (
                np.moveaxis(self.values[k], 1, 0) for k in (left, right)
            )
            between = (
                (2 * u**3 - 3 * u**2 + 1) * start
                + (u**3 - 2 * u**2 + u) * dt * out
                + (3 * u**2 - 2 * u**3) * end
                + (u**3 - u**2) * dt * into
            )
            return normalize_quaternions(between) if is_rotation else between
        start, end = self.values[left], self.values[right]
        if self.interpolation == "STEP":
            return start
        if is_rotation:
            return slerp(start, end, share)
        return start + share[:, None] * (end - start)


@dataclass(frozen=True, eq=False)
class Animation:
    """An animation of a file.

    Attributes:
        name: in the file, or "" if it has none.
        curves: by node and property (translation, rotation, scale).
        rate: frames per second that our own files declare, or None.
        face: curves (K, 1) of face channels, by name.
        origin: of the face, see `FaceTrack`.
    """

    name: str
    curves: Mapping[tuple[int, str], Curve]
    rate: float | None = None
    face: Mapping[str, Curve] = field(default_factory=dict)
    origin: str = "recorded"

    def frames(self, fps: float | None, gltf: Gltf, most: int) -> tuple[np.ndarray, float]:
        """Return the times (T,) of frames from the first key to the last, and their rate.

        Args:
            fps: frames per second, or None for the rate of the keys.
            gltf: the file, for its name in messages.
            most: largest number of frames.

        Warns:
            UserWarning: no common rate has frames at all keys.

        Raises:
            FormatError: too many frames.
            MotionError: an invalid rate.
        """
        times = np.zeros(1)
        for curves in (self.curves, self.face):
            keys = {id(curve.times): curve.times for curve in curves.values()}
            if len(times) == 1 and keys:  # a face that moves on a body that does not
                times = np.unique(np.concatenate([*keys.values()]))
        first, last = float(times[0]), float(times[-1])
        if fps is None and self.rate and _fits(times, self.rate):
            fps = self.rate
        if fps is None:
            fps, fits = _rate(times)
            if not fits:
                text = f"of no common rate: read at {fps:g} fps; --in-fps sets another"
                warnings.warn(f"{gltf.path}: its keys are {text}", stacklevel=4)
        n_frames = np.floor((last - first) * checked_fps(fps) + 0.5) + 1
        if n_frames > most:
            raise gltf.error(f"{n_frames:.0f} frames, over {most}: cut it, or lower its --in-fps")
        return first + np.arange(n_frames) / fps, fps

    def face_at(self, times: np.ndarray, gltf: Gltf) -> FaceTrack | None:
        """Return the face at times (T,), or None if the file has none.

        Raises:
            FormatError: so many values that the file is too small for them.
            MotionError: values that are not finite, or beyond 1e9.
        """
        if not self.face:
            return None
        size = len(times) * len(self.face)
        gltf.spend("its face", decoded=8 * size, work=size)
        values = np.concatenate([curve.at(times) for curve in self.face.values()], axis=1)
        return FaceTrack(tuple(self.face), values, self.origin)


def _fits(times: np.ndarray, rate: float) -> bool:
    """Return whether all times are those of frames."""
    frames = (times - times[0]) * rate
    return bool((np.abs(frames - np.rint(frames)) <= _NEAR + _EARLY * rate / 10).all())


def _rate(times: np.ndarray) -> tuple[float, bool]:
    """Return the likely frame rate of sorted keys (K,), and whether all lie at frames."""
    steps = np.diff(times)
    steps = steps[steps > _EARLY]
    if not len(steps):
        return _NO_KEYS_RATE, True
    span, step = float(times[-1] - times[0]), float(np.median(steps))
    keyed = round(span / step) / span
    if abs(keyed - round(keyed)) < 1e-6 * keyed:  # rounding to float32
        keyed = round(keyed)
    even = keyed * np.ceil(_SLOWEST / keyed)
    common = [*COMMON_RATES, *(rate / 1.001 for rate in COMMON_RATES)]
    near = [rate for rate in common if abs(rate / even - 1) < _ALIKE]
    likely = sorted(near, key=lambda rate: abs(rate - even))
    if np.ptp(steps) < 0.1 * step and even == keyed:
        likely.append(even)
    for rate in (*likely, *common, even):
        if rate <= _FASTEST and _fits(times, rate):
            return float(rate), True
    dense = 1 / float(np.quantile(steps, 0.1))
    return float(min((r for r in COMMON_RATES if r >= dense), default=_FASTEST)), False


def read_animation(gltf: Gltf, nodes: set[int], name: str | None) -> Animation:
    """Return one animation of a file, with the curves of some nodes.

    Args:
        gltf: the file.
        nodes: those whose curves are read.
        name: of the animation, or its number from 1 on; None for the longest that moves the nodes.

    Warns:
        UserWarning: there are several. NoAnimationWarning: none, in a file other than .vrm.

    Raises:
        FormatError: no animation of this name, or a broken one.
    """
    entries, keys = gltf.items("animations"), _Keys(gltf)
    names = [str(entry.get("name", "")) for entry in entries]
    numbers = list(map(str, range(1, len(names) + 1)))
    labels = [label[:60] or number for label, number in zip(names, numbers)]
    shown = listed(labels, _SHOWN)
    if name is not None:
        if name not in (*names, *numbers):
            raise FormatError(f"{gltf.path}: no animation {name!r}; it has {shown or 'none'}")
        chosen = (names if name in names else numbers).index(name)
        return keys.animation(entries[chosen], nodes)
    bodies = {k: keys.seconds(keys.of_nodes(entry, nodes)) for k, entry in enumerate(entries)}
    faces = {k: keys.seconds(keys.of_face(entry)) for k, entry in enumerate(entries)}
    ends = faces if any(faces.values()) and not any(bodies.values()) else bodies
    if moving := {k: end for k, end in ends.items() if end is not None}:
        longest = max(moving, key=moving.__getitem__)
        if len(moving) > 1:
            text = f"the longest is read, {labels[longest]}; --animation NAME chooses"
            warnings.warn(f"{gltf.path}: of its animations ({shown}), {text}", stacklevel=3)
        read = keys.animation(entries[longest], nodes)
        with_face = [k for k, end in faces.items() if end is not None]
        if len(with_face) == 1 and bodies[with_face[0]] is None:
            # Blender may write those of bones and of morph targets apart.
            read = replace(read, face=keys.face(entries[with_face[0]]))
        return read
    if gltf.path.suffix.lower() != ".vrm":  # avatars have none
        said = f"{gltf.path}: no animation of its skeleton: one frame, at rest"
        warnings.warn(said, NoAnimationWarning, stacklevel=3)
    return Animation("", {})


_Channel = tuple[int, str, dict[str, Any]]
"""Node and property of a channel, and its sampler."""


class _Keys:
    """Keys of the animations of a file; those that several channels share are decoded once."""

    def __init__(self, gltf: Gltf) -> None:
        self._gltf = gltf
        self._times: dict[object, tuple[np.ndarray, np.ndarray | None]] = {}
        self._curves: dict[tuple[object, ...], Curve] = {}
        expressions = expression_nodes(gltf)
        self._expressions = {expressions[name]: name for name in without_derived(expressions)}

    def animation(self, entry: dict[str, Any], nodes: set[int]) -> Animation:
        """Return an animation with the curves of some nodes."""
        curves = {
            (node, path): self._curve(sampler, path)
            for node, path, sampler in self.of_nodes(entry, nodes)
        }
        extras = self._gltf.object(entry, "extras")
        fps = extras.get("fps", 0)
        right = type(fps) in (int, float) and LOWEST_FPS <= fps <= HIGHEST_FPS
        name, rate = str(entry.get("name", "")), float(fps) if right else None
        origin = "rules" if extras.get("face") == "rules" else "recorded"
        return Animation(name, curves, rate, self.face(entry), origin)

    def seconds(self, samplers: Iterable[_Channel]) -> float | None:
        """Return the time of the last key; None without samplers."""
        return max((self._at(sampler)[0][-1] for _, _, sampler in samplers), default=None)

    def face(self, entry: dict[str, Any]) -> dict[str, Curve]:
        """Return the curves (K, 1) of morph targets and expressions of an animation, by name.

        Of several with one name it is the first.

        Warns:
            UserWarning: morph targets that have no names, or too many.
        """
        gltf, found = self._gltf, dict[str, Curve]()
        for node, path, sampler in self.of_face(entry):
            names, n_targets = [self._expressions.get(node, "")], 1
            if path == "weights":
                names, n_targets = target_names(gltf, gltf.item("nodes", node))
                gltf.spend("names of its morph targets", work=_NAME_STEPS * len(names))
            if len(names) != n_targets or len(found) + n_targets > MAX_CHANNELS:
                what = f"{n_targets} morph targets with {len(names)} targetNames are left out"
                need = f"expected a name for each, and at most {MAX_CHANNELS} in all"
                warnings.warn(f"{gltf.path}: {what}; {need}", stacklevel=5)
                continue
            curve = self._curve(sampler, path, n_targets)
            for k, name in enumerate(names):
                label = printable(name[:_LONGEST_NAME]).strip() or f"target{k}"
                values = curve.values[..., k : k + 1]
                found.setdefault(label, Curve(curve.times, values, curve.interpolation))
        return found

    def of_nodes(self, entry: dict[str, Any], nodes: set[int]) -> Iterator[_Channel]:
        """Yield the channels that move some nodes."""
        return ((n, p, s) for n, p, s in self._channels(entry) if n in nodes and p != "weights")

    def of_face(self, entry: dict[str, Any]) -> Iterator[_Channel]:
        """Yield the channels of morph targets and expressions."""
        for node, path, sampler in self._channels(entry):
            if path == "weights" or (path == "translation" and node in self._expressions):
                yield node, path, sampler

    def _channels(self, entry: dict[str, Any]) -> Iterator[_Channel]:
        gltf, samplers = self._gltf, self._gltf.items("samplers", entry)
        n_nodes = len(gltf.items("nodes"))
        for channel in gltf.items("channels", entry):
            target = gltf.object(channel, "target")
            path = target.get("path")
            if "node" not in target or not isinstance(path, str) or path not in _WIDTHS:
                continue  # pointers of extensions
            node = gltf.whole(target["node"], n_nodes, "node of a channel")
            at = gltf.whole(channel.get("sampler"), len(samplers), "sampler")
            yield node, path, samplers[at]

    def _at(self, sampler: dict[str, Any]) -> tuple[np.ndarray, np.ndarray | None]:
        """Return the times (K,) of a sampler in order, and the order unless it is that in file."""
        index = sampler.get("input")
        stored = self._gltf.array(index, "times", 1)[:, 0]
        if index not in self._times:
            if not len(stored):
                raise self._gltf.error("an animation has 0 times")
            self._gltf.spend("times", decoded=8 * len(stored), work=len(stored))
            times, order = stored.astype(float), None
            if (np.diff(times) < 0).any():
                order = np.argsort(times, kind="stable")
                times = times[order]
            self._times[index] = times, order
        return self._times[index]

    def _curve(self, sampler: dict[str, Any], path: str, n_values: int = 1) -> Curve:
        """Return a curve of one value a key, or of `n_values` weights."""
        gltf, how = self._gltf, sampler.get("interpolation", "LINEAR")
        if how not in ("LINEAR", "STEP", "CUBICSPLINE"):
            raise gltf.error(f"the interpolation {str(how)[:40]!r} is not known")
        times, order = self._at(sampler)
        stored = gltf.array(sampler.get("output"), path, _WIDTHS[path])
        key = sampler["input"], sampler["output"], path, how, n_values
        if key not in self._curves:
            each = n_values * (3 if how == "CUBICSPLINE" else 1)
            if len(stored) < each * len(times):
                raise gltf.error(f"{len(stored)} values of {path} for {len(times)} times")
            values = stored[: each * len(times)]
            gltf.spend(f"keys of {path}", decoded=8 * values.size, work=values.size)
            shape = (len(times), 3, -1) if how == "CUBICSPLINE" else (len(times), -1)
            values = values.astype(float, copy=False).reshape(shape)
            if path == "rotation" and how != "CUBICSPLINE":
                values = normalize_quaternions(values)
            self._curves[key] = Curve(times, values if order is None else values[order], how)
        return self._curves[key]


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
        rest = np.array([np.concatenate(self._local(node)) for node in nodes]).reshape(-1, 10)
        self.rest = {"translation": rest[:, :3], "rotation": rest[:, 3:7], "scale": rest[:, 7:]}

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
        place = gltf.numbers(node, "translation", [0.0, 0.0, 0.0])
        turn = normalize_quaternions(gltf.numbers(node, "rotation", [0.0, 0.0, 0.0, 1.0]))
        return place, turn, gltf.numbers(node, "scale", [1.0, 1.0, 1.0])

    def with_ancestors(self, nodes: list[int]) -> list[int]:
        """Return nodes and all above them, parents first."""
        needed = set(nodes)
        for node in nodes:
            while (node := self.parents[node]) >= 0 and node not in needed:
                needed.add(node)
        return [node for node in self.order if node in needed]

    def matrices(self) -> np.ndarray:
        """Return the transforms (N, 4, 4) from each node to the world at rest."""
        places, _, linear = self._block(self.order, {}, AT_REST)
        world = np.tile(np.eye(4), (len(self.order), 1, 1))
        world[self.order, :3, :3], world[self.order, :3, 3] = linear[0], places[0]
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
