"""Writer of binary glTF 2.0 files: skeleton, animation and skinned meshes.

The format's axes and unit are ours: metres, Y up, +Z forward. Every joint is a node with the axes
of the world at rest, and so is every end site, which is marked in its `extras`.
"""

from __future__ import annotations

import copy
import json
import struct
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from gesturekit.formats.gltf.faces import VMC_NAMES, expressions_of, target_names
from gesturekit.formats.gltf.file import BIN, JSON, MAX_BYTES, Gltf
from gesturekit.formats.gltf.reading import END_SITE
from gesturekit.formats.gltf.scene import Nodes
from gesturekit.formats.gltf.vrm import Avatar, our_names
from gesturekit.motion.body_model import INFLUENCES, Skin
from gesturekit.motion.face import MAX_CHANNELS, FaceTrack
from gesturekit.motion.motion import Motion
from gesturekit.motion.rotations import (
    IDENTITY,
    invert_quaternions,
    multiply_quaternions,
    steady_signs,
)
from gesturekit.motion.skeleton import Skeleton, unique_names

_FLOAT, _BYTE, _SHORT, _INT = 5126, 5121, 5123, 5125
_DTYPES = {_FLOAT: "<f4", _BYTE: "u1", _SHORT: "<u2", _INT: "<u4"}
_KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
_VERTICES, _INDICES = {"target": 34962}, {"target": 34963}
"""Uses of a buffer view."""
_ROUGH = 0.8
_BONE = (150, 160, 175)
"""RGB of bones."""
_THICK = 0.09
"""Width of a bone by its length; it is widest at this share of it from its joint."""
_SHORTEST = 1e-6
"""Length of bones that are seen, metres."""
_TURNED = np.array([0.0, 1.0, 0.0, 0.0])
"""Half a turn about Y."""
_PLACEHOLDER = 1e-3
"""Size of the mesh for face channels that move no mesh, metres."""
_VRM = ("VRM", "VRMC_vrm", "VRMC_springBone", "VRMC_node_constraint")
"""Extensions for programs that move the nodes themselves."""


class _Builder:
    """JSON object and arrays of a file that is being made."""

    def __init__(self, json_object: dict[str, Any]) -> None:
        self.json = json_object
        self._data = bytearray()

    def append(self, key: str, item: dict[str, Any]) -> int:
        """Append an object to a list of the file; return its index."""
        self.json.setdefault(key, []).append(item)
        return len(self.json[key]) - 1

    def place(self, data: bytes) -> int:
        """Append bytes at a multiple of four; return where they are."""
        self._data += bytes(-len(self._data) % 4)
        start = len(self._data)
        self._data += data
        return start

    def view(self, data: bytes, more: Mapping[str, Any]) -> int:
        """Add a buffer view of bytes; return its index."""
        view = {"buffer": 0, "byteOffset": self.place(data), "byteLength": len(data)}
        return self.append("bufferViews", view | dict(more))

    def array(
        self,
        values: np.ndarray,
        component: int = _FLOAT,
        use: Mapping[str, int] | None = None,
        **more: Any,
    ) -> int:
        """Add an accessor of values (N, W); return its index."""
        data = np.ascontiguousarray(values, _DTYPES[component]).tobytes()
        accessor = {
            "bufferView": self.view(data, use or {}),
            "componentType": component,
            "type": _KINDS[values.shape[1]],
            "count": len(values),
        }
        return self.append("accessors", accessor | more)

    def bounded(self, values: np.ndarray, use: Mapping[str, int] | None = None) -> int:
        """Add an accessor of floats with its least and greatest values."""
        values = values.astype("<f4")
        return self.array(values, use=use, **_bounds(values))

    def displacements(self, values: np.ndarray) -> int:
        """Add an accessor of floats (N, 3), sparse where most rows are zero."""
        values = values.astype("<f4")
        rows = np.flatnonzero(values.any(axis=1))
        if 2 * len(rows) >= len(values):
            return self.bounded(values, _VERTICES)
        accessor: dict[str, Any] = {"componentType": _FLOAT, "type": "VEC3", "count": len(values)}
        accessor |= _bounds(values)
        if len(rows):
            places, moved = rows.astype(_DTYPES[_INT]).tobytes(), values[rows].tobytes()
            accessor["sparse"] = {
                "count": len(rows),
                "indices": {"bufferView": self.view(places, {}), "componentType": _INT},
                "values": {"bufferView": self.view(moved, {})},
            }
        return self.append("accessors", accessor)

    def file(self) -> bytes:
        """Return the file."""
        self.place(b"")
        self.json["buffers"] = [{"byteLength": len(self._data)}]
        text = json.dumps(self.json, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        size = 28 + len(text) + len(self._data)
        head = struct.pack("<4s4I", b"glTF", 2, size, len(text), JSON)
        return head + text + struct.pack("<2I", len(self._data), BIN) + bytes(self._data)


def _bounds(values: np.ndarray) -> dict[str, Any]:
    """Return the least and greatest values of an accessor (N, W)."""
    return {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}


def animated_skeleton(
    motion: Motion,
    name: str,
    skin: Skin | None,
    colours: Mapping[str, Sequence[int]] = MappingProxyType({}),
    scale: float = 1.0,
) -> bytes:
    """Return a file with the rig of a motion, its animation, and a mesh.

    A face is the animated weights of morph targets: those of a skin that has any of its channels,
    else of a triangle of a millimetre that they do not move.

    Args:
        motion: T frames, J joints.
        name: of the animation and the mesh.
        skin: the mesh; None for bones of the rig.
        colours: name and colour (RGB, 0 to 255, sRGB) of the material of each region of the skin.
        scale: factor on the skin's vertices.
    """
    builder, parents, rest = _builder_of(motion.skeleton)
    is_bones = skin is None
    if skin is None:
        skin, colours = bones(parents, rest), {"bones": _BONE}
    channels = () if motion.face is None else motion.face.names
    channels = channels if skin.morphs.keys() & set(channels) else ()
    weights = {}
    if len(skin.faces):
        inverse = np.tile(np.eye(4), (len(rest), 1, 1))
        inverse[:, 3, :3] = -rest  # columns first
        matrices = builder.array(inverse.reshape(-1, 16))
        joints = list(range(len(rest)))
        builder.append("skins", {"joints": joints, "inverseBindMatrices": matrices})
        primitives = _primitives(builder, skin, colours, scale, is_bones, channels)
        mesh = builder.append("meshes", _mesh(name, primitives, channels))
        body = builder.append("nodes", {"name": f"{name}_mesh", "mesh": mesh, "skin": 0})
        builder.json["scenes"][0]["nodes"].append(body)
        weights = {body: motion.face.values} if motion.face is not None and channels else {}
    weights, placeholder = _weights_or_placeholder(builder, name, motion.face, weights)
    builder.json["scenes"][0]["nodes"] += placeholder
    _animate(builder, motion, name, *_curves(motion), weights)
    return builder.file()


def vrm_animation(motion: Motion, name: str) -> bytes:
    """Return a VRM animation 1.0 of a motion on bones with our names, and of its face.

    Args:
        motion: T frames; the rig rests in a T-pose.
        name: of the animation.
    """
    builder, _, _ = _builder_of(motion.skeleton)
    nodes = {joint: {"node": k} for k, joint in enumerate(motion.skeleton.names)}
    bones = {bone: nodes[ours] for bone, ours in our_names(True).items() if ours in nodes}
    extension: dict[str, Any] = {"specVersion": "1.0", "humanoid": {"humanBones": bones}}
    extensions = {"VRMC_vrm_animation": extension}
    builder.json |= {"extensions": extensions, "extensionsUsed": [*extensions]}
    rotations, translations = _curves(motion)
    expressions = {} if motion.face is None else expressions_of(motion.face)
    for expression, values in expressions.items():
        node = builder.append("nodes", {"name": expression})
        builder.json["scenes"][0]["nodes"].append(node)
        kind = "preset" if expression in VMC_NAMES else "custom"
        group = extension.setdefault("expressions", {}).setdefault(kind, {})
        group[expression] = {"node": node}
        translations[node] = values[:, None] * [1.0, 0.0, 0.0]
    _animate(builder, motion, name, rotations, translations)
    return builder.file()


def _curves(motion: Motion) -> tuple[dict[int, np.ndarray], dict[int, np.ndarray]]:
    """Return rotations (T, 4) and translations (T, 3) by joint."""
    skeleton = motion.skeleton
    places = {skeleton.index(joint): moved for joint, moved in motion.joint_translations.items()}
    return dict(enumerate(np.moveaxis(motion.rotations, 1, 0))), {0: motion.translation, **places}


def _mesh(name: str, primitives: list[dict[str, Any]], channels: Sequence[str]) -> dict[str, Any]:
    """Return a mesh; `channels` are the names of its morph targets."""
    mesh: dict[str, Any] = {"name": name, "primitives": primitives}
    if channels:
        # A convention that Blender, three.js and others share.
        mesh |= {"weights": [0.0] * len(channels), "extras": {"targetNames": list(channels)}}
    return mesh


def _weights_or_placeholder(
    builder: _Builder, name: str, face: FaceTrack | None, weights: dict[int, np.ndarray]
) -> tuple[dict[int, np.ndarray], list[int]]:
    """Return the weights (T, E) of a face by node, and nodes that were added.

    Where no node has any, one is added: a triangle that its morph targets do not move.
    """
    if weights or face is None or not face.names:
        return weights, []
    corners = builder.bounded(_PLACEHOLDER * np.eye(3), _VERTICES)
    still = {"POSITION": builder.displacements(np.zeros((3, 3)))}
    primitives = [{"attributes": {"POSITION": corners}, "targets": [still] * len(face.names)}]
    mesh = builder.append("meshes", _mesh(name, primitives, face.names))
    node = builder.append("nodes", {"name": f"{name}_face", "mesh": mesh})
    return {node: face.values}, [node]


def _builder_of(skeleton: Skeleton) -> tuple[_Builder, list[int], np.ndarray]:
    """Return a builder with N joints and end sites, their parents, and positions (N, 3) at rest."""
    ends = [name for name, sites in skeleton.end_sites.items() for _ in sites]
    sites = [site for sites in skeleton.end_sites.values() for site in sites]
    names = unique_names([*skeleton.names, *(f"{name}_end" for name in ends)])
    parents = [*skeleton.parents, *map(skeleton.index, ends)]
    rest = np.array([*skeleton.offsets, *sites])
    nodes: list[dict[str, Any]] = []
    for k, (name, parent) in enumerate(zip(names, parents)):
        nodes.append({"name": name, "translation": rest[k].tolist()})
        if parent >= 0:
            rest[k] += rest[parent]
            nodes[parent].setdefault("children", []).append(k)
        if k >= skeleton.n_joints:
            nodes[k]["extras"] = {END_SITE: True}
    about = {"asset": {"version": "2.0", "generator": "gesturekit"}, "scene": 0}
    return _Builder(about | {"scenes": [{"nodes": [0]}], "nodes": nodes}), parents, rest


def bones(parents: Sequence[int], rest: np.ndarray) -> Skin:
    """Return an octahedron from each parent to its N joints and end sites at rest, (N, 3)."""
    above = np.array(parents, int)
    ends = np.flatnonzero(np.linalg.norm(rest - rest[above], axis=1) > _SHORTEST)
    ends = ends[above[ends] >= 0]
    owners, start, end = above[ends], rest[above[ends]], rest[ends]
    along = end - start
    side = np.cross(along, np.eye(3)[np.abs(along).argmin(axis=1)])
    length = np.linalg.norm(along, axis=1, keepdims=True)
    side *= _THICK * length / np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(along / length, side)
    ring = [start + _THICK * along + each for each in (side, other, -side, -other)]
    corners = []
    for a, b in zip(ring, [*ring[1:], ring[0]]):
        corners += [start, b, a, end, a, b]
    vertices = np.stack(corners, axis=1).reshape(-1, 3)
    joints = np.zeros((len(vertices), INFLUENCES), np.uint32)
    joints[:, 0] = np.repeat(owners, len(corners))
    weights = np.tile(np.array([255, 0, 0, 0], np.uint8), (len(vertices), 1))
    faces = np.arange(len(vertices), dtype=np.uint32).reshape(-1, 3)
    return Skin(vertices, faces, joints, weights, rest)


def _primitives(
    builder: _Builder,
    skin: Skin,
    colours: Mapping[str, Sequence[int]],
    scale: float,
    is_flat: bool,
    channels: Sequence[str],
) -> list[dict[str, Any]]:
    """Add the arrays and the material of each region of a skin; return their primitives.

    Programs draw flat faces where there are no normals. Each primitive has a morph target for each
    of the face's `channels`.
    """
    regions = np.zeros(len(skin.vertices), int) if skin.regions is None else skin.regions
    normals = skin.normals()
    lost = np.linalg.norm(normals, axis=1) < 0.5  # faces that cancel one another
    normals[lost] = [0.0, 1.0, 0.0]
    joints = np.where(skin.weights > 0, skin.joints, 0)
    primitives = []
    for region, (name, colour) in enumerate(colours.items()):
        faces = skin.faces[regions[skin.faces[:, 0]] == region]
        if not len(faces):
            continue
        used, corners = np.unique(faces, return_inverse=True)
        wide = _SHORT if joints.max() > 255 else _BYTE
        attributes = {
            "POSITION": builder.bounded(scale * skin.vertices[used], _VERTICES),
            "JOINTS_0": builder.array(joints[used], wide, _VERTICES),
            "WEIGHTS_0": builder.array(skin.weights[used], _BYTE, _VERTICES, normalized=True),
        }
        if not is_flat:
            attributes["NORMAL"] = builder.array(normals[used], use=_VERTICES)
        indices = builder.array(corners.reshape(-1, 1), _INT, _INDICES)
        srgb = np.asarray(colour) / 255  # colours of the file are linear
        linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
        surface = {
            "baseColorFactor": [*np.round(linear, 4).tolist(), 1.0],
            "metallicFactor": 0.0,
            "roughnessFactor": _ROUGH,
        }
        material = builder.append("materials", {"name": name, "pbrMetallicRoughness": surface})
        primitive = {"attributes": attributes, "indices": indices, "material": material}
        if channels:
            primitive["targets"] = _targets(builder, skin, channels, used, scale)
        primitives.append(primitive)
    return primitives


def _targets(
    builder: _Builder, skin: Skin, channels: Sequence[str], used: np.ndarray, scale: float
) -> list[dict[str, int]]:
    """Add the morph targets of a primitive with these vertices (N,) of a skin; return them."""
    still = builder.displacements(np.zeros((len(used), 3)))
    targets = []
    for channel in channels:
        moves = np.zeros(skin.vertices.shape)
        if morph := skin.morphs.get(channel):
            moves[morph.vertices] = scale * morph.offsets
        moves = moves[used]
        targets.append({"POSITION": builder.displacements(moves) if moves.any() else still})
    return targets


def _animate(
    builder: _Builder,
    motion: Motion,
    name: str,
    rotations: Mapping[int, np.ndarray],
    translations: Mapping[int, np.ndarray],
    weights: Mapping[int, np.ndarray] = MappingProxyType({}),
) -> None:
    """Add an animation of nodes; what stands still has one key, but the first translation all.

    Args:
        builder: the file.
        motion: T frames, for their rate and the origin of its face.
        name: of the animation.
        rotations: (T, 4) by node.
        translations: (T, 3) by node.
        weights: (T, E) of morph targets by node.
    """
    times = {motion.n_frames: builder.bounded(motion.times[:, None])}
    channels, samplers = list[dict[str, Any]](), list[dict[str, Any]]()
    curves = {"translation": translations, "rotation": rotations, "weights": weights}
    for path, of_nodes in curves.items():
        for node, values in of_nodes.items():
            keys = (steady_signs(values) if path == "rotation" else values).astype("<f4")
            if channels and not np.ptp(keys, axis=0).any():
                keys = keys[:1]
            if len(keys) not in times:
                times[1] = builder.bounded(np.zeros((1, 1)))
            channels.append({"sampler": len(samplers), "target": {"node": node, "path": path}})
            output = builder.array(keys.reshape(-1, 1) if path == "weights" else keys)
            samplers.append({"input": times[len(keys)], "output": output})
    extras: dict[str, Any] = {"fps": motion.fps, "frames": motion.n_frames}
    if motion.face is not None and motion.face.origin == "rules":
        extras["face"] = "rules"
    animation = {"name": name, "channels": channels, "samplers": samplers, "extras": extras}
    builder.append("animations", animation)


def animated_avatar(avatar: Avatar, motion: Motion, name: str, scale: float) -> bytes:
    """Return the file of an avatar, with its meshes, textures and materials, and an animation.

    Args:
        avatar: J joints.
        motion: on the avatar's rig, scaled by `scale`.
        name: of the animation.
        scale: factor on all lengths of the avatar.
    """
    tree = Nodes(avatar.gltf)
    builder = _embedded(avatar.gltf)
    upright = _TURNED if avatar.is_backwards else IDENTITY
    _, rest = (each[0] for each in tree.world(list(range(len(tree.parents))), {}, np.zeros(1)))
    turns = multiply_quaternions(invert_quaternions(upright), motion.global_rotations())
    turns = multiply_quaternions(turns, multiply_quaternions(upright, rest[list(avatar.nodes)]))
    rotations = {}
    for joint, node in enumerate(avatar.nodes):
        above, parent = motion.skeleton.parents[joint], tree.parents[node]
        world = rest[parent] if parent >= 0 else IDENTITY
        if above >= 0:
            back = invert_quaternions(rest[avatar.nodes[above]])
            world = multiply_quaternions(turns[:, above], multiply_quaternions(back, world))
        rotations[node] = multiply_quaternions(invert_quaternions(world), turns[:, joint])
    hips = avatar.nodes[0]
    above = tree.parents[hips]
    frame = tree.matrices()[above] if above >= 0 else np.eye(4)
    places = motion.translation / scale * ([-1, 1, -1] if avatar.is_backwards else [1, 1, 1])
    places = np.linalg.solve(frame[:3, :3], (places - frame[:3, 3]).T).T
    weights = {} if motion.face is None else _weights(avatar.gltf, motion.face)
    weights, placeholder = _weights_or_placeholder(builder, name, motion.face, weights)
    _animate(builder, motion, name, rotations, {hips: places}, weights)
    roots = [node for node, parent in enumerate(tree.parents) if parent < 0]
    whole = {"name": "avatar", "children": roots, "scale": [scale] * 3}
    root = builder.append("nodes", whole | {"rotation": upright.tolist()})
    builder.json |= {"scene": 0, "scenes": [{"nodes": [root, *placeholder]}]}
    try:
        return builder.file()
    except ValueError:
        raise avatar.gltf.error("its JSON part holds numbers that are not finite") from None


def _weights(gltf: Gltf, face: FaceTrack) -> dict[int, np.ndarray]:
    """Return, by node, weights (T, N) of the meshes that have morph targets named as channels.

    Raises:
        FormatError: over `MAX_CHANNELS` targets in them.
    """
    values, found, total = dict(zip(face.names, face.values.T)), dict[int, np.ndarray](), 0
    for node, entry in enumerate(gltf.items("nodes")):
        names, n_targets = target_names(gltf, entry)
        if n_targets == len(names) and values.keys() & set(names):
            total += len(names)
            if total > MAX_CHANNELS:
                raise gltf.error(f"over {MAX_CHANNELS} morph targets with names of the face's")
            holder = entry if "weights" in entry else gltf.item("meshes", entry["mesh"])
            rest = gltf.numbers(holder, "weights", [0.0] * len(names))
            columns = [values.get(name, np.full(len(face), w)) for name, w in zip(names, rest)]
            found[node] = np.stack(columns, axis=1)
    return found


def _embedded(gltf: Gltf) -> _Builder:
    """Return a builder with all of a file in one buffer, but for animations and VRM's own data."""
    builder = _Builder(copy.deepcopy(gltf.json))
    content = builder.json
    content.pop("animations", None)
    buffers = [gltf.buffer(k) for k in range(len(gltf.items("buffers")))]
    starts = {data: builder.place(data) for data in dict.fromkeys(buffers)}
    images: dict[bytes, int] = {}
    for view in gltf.items("bufferViews", content):
        buffer = gltf.whole(view.get("buffer"), len(buffers), "buffer")
        offset = gltf.whole(view.get("byteOffset", 0), MAX_BYTES, "byteOffset")
        view |= {"buffer": 0, "byteOffset": offset + starts[buffers[buffer]]}
    for image in gltf.items("images", content):
        if "uri" in image:
            data = gltf.resource(image.pop("uri"))
            kind = "png" if data.startswith(b"\x89PNG") else "jpeg"
            kind = "webp" if data[8:12] == b"WEBP" else kind
            if data not in images:
                images[data] = builder.view(data, {})
            image |= {"bufferView": images[data], "mimeType": f"image/{kind}"}
    for holder in (content, *content["nodes"]):
        extensions = gltf.object(holder, "extensions")
        for name in _VRM:
            extensions.pop(name, None)
        if not extensions:
            holder.pop("extensions", None)
    for key in ("extensionsUsed", "extensionsRequired"):
        names = [name for name in map(str, gltf.values(content, key)) if name not in _VRM]
        if names:
            content[key] = names
        else:
            content.pop(key, None)
    return builder
