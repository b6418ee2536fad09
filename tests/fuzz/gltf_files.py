"""Small glTF files for tests, made without the writer under test."""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

HALF = float(np.sqrt(0.5))
QUARTER_TURN = (0.0, 0.0, HALF, HALF)
"""A quarter turn about Z."""


class GltfFile:
    """A file with nodes, and curves of one animation at a time."""

    def __init__(self, nodes: list[dict[str, Any]], skins: list[list[int]] = ()) -> None:
        self.json: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "nodes": nodes,
            "accessors": [],
            "bufferViews": [],
            "animations": [],
        }
        below = {child for node in nodes for child in node.get("children", [])}
        self.json["scenes"] = [{"nodes": [k for k in range(len(nodes)) if k not in below]}]
        if skins:
            self.json["skins"] = [{"joints": joints} for joints in skins]
        self.data = b""

    def view(self, data: bytes) -> int:
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data)}
        self.json["bufferViews"].append(view)
        self.data += data + bytes(-len(data) % 4)
        return len(self.json["bufferViews"]) - 1

    def array(self, values: Any, dtype: str = "<f4", **more: Any) -> int:
        values = np.asarray(values, dtype)
        values = values.reshape(len(values), -1)
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[values.shape[1]]
        component = {"<f4": 5126, "i1": 5120, "<i2": 5122, "<u2": 5123}[dtype]
        accessor = {"type": kind, "componentType": component, "count": len(values), **more}
        self.json["accessors"].append({"bufferView": self.view(values.tobytes()), **accessor})
        return len(self.json["accessors"]) - 1

    def animate(
        self, curves: list[tuple[int, str, list[float], Any]], how: str = "LINEAR", name: str = ""
    ) -> GltfFile:
        """Add an animation of (node, property, times, values)."""
        samplers, channels = [], []
        for node, path, times, values in curves:
            output = values if isinstance(values, int) else self.array(values)
            samplers.append({"input": self.array(times), "output": output, "interpolation": how})
            target = {"node": node, "path": path}
            channels.append({"sampler": len(samplers) - 1, "target": target})
        animation = {"samplers": samplers, "channels": channels} | ({"name": name} if name else {})
        self.json["animations"].append(animation)
        return self

    def glb(self) -> bytes:
        text = json.dumps(self.json | {"buffers": [{"byteLength": len(self.data)}]}).encode()
        text += b" " * (-len(text) % 4)
        size = 28 + len(text) + len(self.data)
        head = struct.pack("<4s4I", b"glTF", 2, size, len(text), 0x4E4F534A)
        return head + text + struct.pack("<2I", len(self.data), 0x004E4942) + self.data

    def gltf(self, uri: str | None = None) -> bytes:
        """The file as text: with its arrays in it, or at a place."""
        uri = uri or "data:application/octet-stream;base64," + base64.b64encode(self.data).decode()
        buffers = [{"byteLength": len(self.data), "uri": uri}]
        return json.dumps(self.json | {"buffers": buffers}).encode()

    def save(self, path: Path) -> Path:
        path.write_bytes(self.glb())
        return path


def arm(how: str = "LINEAR", times: tuple[float, ...] = (0, 1, 2)) -> GltfFile:
    """A joint at (1, 0, 0) of one that turns by a quarter and back, at a metre's height."""
    nodes = [
        {"name": "shoulder", "translation": [0, 1, 0], "children": [1]},
        {"name": "hand", "translation": [1, 0, 0]},
    ]
    turns = [(0, 0, 0, 1), QUARTER_TURN, (0, 0, 0, 1)]
    if how == "CUBICSPLINE":
        still = (0, 0, 0, 0)
        turns = [value for turn in turns for value in (still, turn, still)]
    return GltfFile(nodes, [[0, 1]]).animate([(0, "rotation", list(times), turns)], how)
