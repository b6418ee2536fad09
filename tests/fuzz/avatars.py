"""A tiny VRM avatar for tests: a box for each bone, with a texture and a lock of hair."""

import io
import json
import struct
from typing import Any

import numpy as np
from PIL import Image

BONES = {  # bone: the one above, and its place on an adult in T-pose that looks along +Z (m)
    "hips": ("", (0, 0.95, 0)),
    "spine": ("hips", (0, 1.05, 0)),
    "chest": ("spine", (0, 1.2, 0)),
    "neck": ("chest", (0, 1.45, 0)),
    "head": ("neck", (0, 1.52, 0)),
    **{
        f"{side}{bone}": (
            above if above in ("hips", "chest") else f"{side}{above}",
            (sign * x, y, z),
        )
        for side, sign in (("left", 1), ("right", -1))
        for bone, above, x, y, z in (
            ("UpperLeg", "hips", 0.1, 0.9, 0),
            ("LowerLeg", "UpperLeg", 0.1, 0.5, 0),
            ("Foot", "LowerLeg", 0.1, 0.08, 0),
            ("Toes", "Foot", 0.1, 0.02, 0.12),
            ("Shoulder", "chest", 0.05, 1.4, 0),
            ("UpperArm", "Shoulder", 0.17, 1.4, 0),
            ("LowerArm", "UpperArm", 0.43, 1.4, 0),
            ("Hand", "LowerArm", 0.67, 1.4, 0),
            ("IndexProximal", "Hand", 0.76, 1.4, 0.03),
        )
    },
}
HAIR = (0, 1.75, -0.1)
"""Place of a bone of the hair, which no humanoid has."""
_CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.03
_FACES = np.array([
    [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
    [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
])  # fmt: skip


def picture() -> bytes:
    """A PNG that is red on its left and transparent green on its right half."""
    pixels = np.zeros((8, 8, 4), np.uint8)
    pixels[:, :4] = (200, 30, 30, 255)
    pixels[:, 4:] = (30, 200, 30, 0)
    out = io.BytesIO()
    Image.fromarray(pixels).save(out, "PNG")
    return out.getvalue()


def avatar_json(version: int) -> tuple[dict[str, Any], bytes]:
    """Return the JSON and the arrays of an avatar of VRM 0.x or 1.0."""
    turn = np.array([1, 1, 1]) if version else np.array([-1, 1, -1])
    names = [*BONES, "hair"]
    places = np.array([*(place for _, place in BONES.values()), HAIR]) * turn
    above = [*(up for up, _ in BONES.values()), "head"]
    parents = [names.index(up) if up else -1 for up in above]
    nodes: list[dict[str, Any]] = []
    for k, name in enumerate(names):
        start = places[parents[k]] if parents[k] >= 0 else 0
        children = [c for c, parent in enumerate(parents) if parent == k]
        nodes.append({"name": name, "translation": (places[k] - start).tolist()})
        nodes[k] |= {"children": children} if children else {}
    # The root of the skeleton is scaled, as if modelled in centimetres.
    nodes[0]["translation"] = (100 * places[0]).tolist()
    for node in nodes[1:]:
        node["translation"] = [100 * x for x in node["translation"]]
    nodes.append({"name": "root", "children": [0], "scale": [0.01] * 3})
    nodes.append({"name": "mesh", "mesh": 0, "skin": 0})
    count = len(names)
    inverse = np.tile(np.eye(4), (count, 1, 1)) * [100, 100, 100, 1]
    inverse[:, :3, 3] = -100 * places
    inverse[:, 3, :3] = 0
    vertices = (places[:, None] + _CUBE).reshape(-1, 3)
    faces = (_FACES[None] + 8 * np.arange(count)[:, None, None]).reshape(-1, 3)
    joints = np.zeros((8 * count, 4), np.uint8)
    joints[:, 0] = np.repeat(np.arange(count), 8)
    weights = np.tile(np.array([1, 0, 0, 0], "<f4"), (8 * count, 1))
    uv = np.tile(np.array([[0.2, 0.5]], "<f4"), (8 * count, 1))
    uv[-8:, 0] = 0.8
    arrays = [
        (vertices.astype("<f4"), 5126, "VEC3"),
        (joints, 5121, "VEC4"),
        (weights, 5126, "VEC4"),
        (uv, 5126, "VEC2"),
        (faces.reshape(-1, 1).astype("<u2"), 5123, "SCALAR"),
        (inverse.swapaxes(1, 2).reshape(count, 16).astype("<f4"), 5126, "MAT4"),
    ]
    parts = [array.tobytes() for array, _, _ in arrays] + [picture()]
    parts = [part + bytes(-len(part) % 4) for part in parts]
    starts = np.cumsum([0, *map(len, parts)])
    humans: dict[str, Any] = {"humanBones": {n: {"node": k} for k, n in enumerate(BONES)}}
    if not version:
        listed = [{"bone": n, "node": k} for k, n in enumerate(BONES)]
        humans = {"humanBones": listed}
    attributes = {"POSITION": 0, "JOINTS_0": 1, "WEIGHTS_0": 2, "TEXCOORD_0": 3}
    surface = {"baseColorTexture": {"index": 0}, "baseColorFactor": [1, 1, 1, 1]}
    found = {
        "asset": {"version": "2.0"},
        "extensions": {"VRMC_vrm" if version else "VRM": {"humanoid": humans}},
        "nodes": nodes,
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 4, "material": 0}]}],
        "skins": [{"joints": list(range(count)), "inverseBindMatrices": 5}],
        "materials": [{"pbrMetallicRoughness": surface}],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 6, "mimeType": "image/png"}],
        "buffers": [{"byteLength": int(starts[-1])}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": int(start), "byteLength": len(part)}
            for start, part in zip(starts, parts)
        ],
        "accessors": [
            {"bufferView": k, "componentType": component, "type": kind, "count": len(array)}
            for k, (array, component, kind) in enumerate(arrays)
        ],
    }
    ends = {"min": vertices.min(axis=0), "max": vertices.max(axis=0)}
    found["accessors"][0] |= {k: v.astype("f4").astype(float).tolist() for k, v in ends.items()}
    return found, b"".join(parts)


def glb(text: bytes, data: bytes) -> bytes:
    """Return a binary glTF file of a JSON text and arrays."""
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4s2I", b"glTF", 2, 28 + len(text) + len(data))
    json_part = struct.pack("<2I", len(text), 0x4E4F534A) + text
    return head + json_part + struct.pack("<2I", len(data), 0x004E4942) + data


def packed(found: dict[str, Any], data: bytes) -> bytes:
    """Return the binary file of an avatar."""
    return glb(json.dumps(found).encode(), data)


def avatar(version: int) -> bytes:
    """Return the file of an avatar of VRM 0.x or 1.0."""
    return packed(*avatar_json(version))
