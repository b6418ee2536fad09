"""Reader of binary glTF 2.0 files (.glb, .vrm), limited to what the file itself holds.

The libraries on PyPI hand out a file's numbers as they are; everything that is used here is checked
first, since avatars are downloaded from anywhere. Colours of vertices come from the base colours of
materials and from textures.
"""

from __future__ import annotations

import io
import json
import math
import os
import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from gesturekit.errors import FormatError

MAX_BYTES = 256 << 20
"""Largest file; avatars have 5 to 60 MB."""
_MAX_JSON = 32 << 20
_MAX_ITEMS = 20_000
"""Largest number of nodes, accessors or other objects of a kind."""
_FARTHEST = 1e4
"""Largest coordinate or factor of a node, metres."""
_JSON, _BIN = 0x4E4F534A, 0x004E4942
_TYPES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_READ = {"VRM", "VRMC_vrm", "KHR_materials_unlit", "KHR_texture_transform"}
"""Extensions that may be required: they change colours at most, or are read."""


class Glb:
    """Objects and arrays of a file.

    Attributes:
        path: of the file.
        json: its JSON object.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        """Read a file.

        Raises:
            FormatError: missing, too large, cut short, or not binary glTF 2.0.
        """
        self.path = Path(path)
        self.json, self._data = self._chunks(self._content())
        self._arrays: dict[int, np.ndarray] = {}
        # Arrays of a sound file overlap little.
        self._left = 4 * len(self._data)
        needed = set(map(str, self._list(self.json, "extensionsRequired"))) - _READ
        needed -= {name for name in needed if name.startswith("VRMC_")}
        if needed:
            raise self.error(
                f"needs the extension {min(needed)[:60]!r}, which is not read; "
                "export it without compression"
            )

    def error(self, problem: str) -> FormatError:
        """Return an error that names the file."""
        return FormatError(f"{self.path}: {problem}")

    def _content(self) -> bytes:
        try:
            if self.path.exists() and not self.path.is_file():
                raise self.error("not a regular file")
            if (size := self.path.stat().st_size) > MAX_BYTES:
                raise self.error(f"{size >> 20} MiB; avatars of up to {MAX_BYTES >> 20} are read")
            return self.path.read_bytes()
        except FileNotFoundError:
            raise self.error("no such file") from None
        except OSError as error:
            raise self.error(f"cannot be read: {error.strerror}") from None

    def _chunks(self, content: bytes) -> tuple[dict[str, Any], bytes]:
        if len(content) < 20 or content[:4] != b"glTF":
            raise self.error("no binary glTF file (.glb, .vrm)")
        version, length, n_json, kind = struct.unpack_from("<4I", content, 4)
        if version != 2:
            raise self.error(f"glTF version {version}; expected 2")
        if length > len(content):
            raise self.error(f"cut short: {len(content)} of {length} bytes")
        if kind != _JSON or n_json > min(_MAX_JSON, len(content) - 20):
            raise self.error("no readable JSON part at its start")
        try:
            found = json.loads(content[20 : 20 + n_json])
        except (ValueError, RecursionError) as error:
            raise self.error(f"its JSON part cannot be read: {str(error)[:200]}") from None
        if not isinstance(found, dict):
            raise self.error("its JSON part is not an object")
        start, data = 20 + n_json, b""
        if len(content) >= start + 8:
            n_data, kind = struct.unpack_from("<2I", content, start)
            if kind == _BIN:
                data = content[start + 8 : start + 8 + n_data]
                if len(data) < n_data:
                    raise self.error(f"cut short: {len(data)} of {n_data} bytes of arrays")
        return found, data

    def _list(self, parent: dict[str, Any], key: str) -> list[Any]:
        found = parent.get(key, [])
        if not isinstance(found, list) or len(found) > _MAX_ITEMS:
            raise self.error(f"{key} is not a list of at most {_MAX_ITEMS}")
        return found

    def items(self, key: str, parent: dict[str, Any] | None = None) -> list[dict[str, Any]]:
        """Return a list of objects of the file, or of one of its objects."""
        found = self._list(self.json if parent is None else parent, key)
        if not all(isinstance(item, dict) for item in found):
            raise self.error(f"{key} holds something that is not an object")
        return found

    def item(self, key: str, index: object) -> dict[str, Any]:
        """Return the object at an index of a list of the file."""
        items = self.items(key)
        return items[self.whole(index, len(items), f"index into {key}")]

    def object(self, parent: dict[str, Any], key: str) -> dict[str, Any]:
        """Return the object at a key of another; an empty one if there is none."""
        found = parent.get(key, {})
        if not isinstance(found, dict):
            raise self.error(f"{key} is not an object")
        return found

    def whole(self, value: object, below: int, what: str) -> int:
        """Return a number that must be whole, at least 0, and below another."""
        if type(value) is not int or not 0 <= value < below:
            raise self.error(f"{what} is {str(value)[:40]}; expected 0 to {below - 1}")
        return value

    def wholes(self, parent: dict[str, Any], key: str, below: int) -> list[int]:
        """Return a list of such numbers."""
        return [self.whole(value, below, key) for value in self._list(parent, key)]

    def numbers(self, parent: dict[str, Any], key: str, default: list[float]) -> np.ndarray:
        """Return numbers (N,), as many as the default has."""
        found = parent.get(key, default)
        right = isinstance(found, list) and len(found) == len(default)
        if not right or not all(type(x) in (int, float) and abs(x) <= _FARTHEST for x in found):
            raise self.error(
                f"{key} is {str(found)[:60]}; expected {len(default)} numbers up to {_FARTHEST:g}"
            )
        return np.array(found, float)

    def view(self, index: object) -> bytes:
        """Return the bytes of a buffer view."""
        start, size = self._span(self.item("bufferViews", index))
        return self._data[start : start + size]

    def _span(self, view: dict[str, Any]) -> tuple[int, int]:
        self.whole(view.get("buffer"), 1, "buffer")
        if "uri" in next(iter(self.items("buffers")), {}):
            raise self.error("its arrays are in another file; export one .glb or .vrm file")
        size = self.whole(view.get("byteLength"), len(self._data) + 1, "byteLength")
        start = self.whole(view.get("byteOffset", 0), len(self._data) - size + 1, "byteOffset")
        return start, size

    def array(self, index: object, what: str, width: int) -> np.ndarray:
        """Return the numbers (N, width) of an accessor; normalised ones as floats.

        Raises:
            FormatError: it does not lie within the file, or is of another kind.
        """
        accessors = self.items("accessors")
        at = self.whole(index, len(accessors), f"accessor of {what}")
        if at not in self._arrays:
            self._arrays[at] = self._read(accessors[at], what)
        found = self._arrays[at]
        if found.shape[1] != width:
            raise self.error(f"{what} has {found.shape[1]} numbers an element; expected {width}")
        if found.dtype.kind == "f" and not (np.abs(found) <= _FARTHEST).all():
            raise self.error(f"{what} holds numbers that are not finite, or over {_FARTHEST:g}")
        return found

    def _read(self, accessor: dict[str, Any], what: str) -> np.ndarray:
        if "sparse" in accessor:
            raise self.error(f"{what} is a sparse accessor, which is not read")
        kind, component = accessor.get("type"), accessor.get("componentType")
        if not isinstance(kind, str) or kind not in _TYPES:
            raise self.error(f"{what} is of type {str(kind)[:40]!r}")
        if type(component) is not int or component not in _COMPONENTS:
            raise self.error(f"{what} has components of type {str(component)[:40]!r}")
        dtype, width = np.dtype(_COMPONENTS[component]), _TYPES[kind]
        view = self.item("bufferViews", accessor.get("bufferView"))
        start, size = self._span(view)
        each = dtype.itemsize * width
        stride = view.get("byteStride", each)
        if type(stride) is not int or not each <= stride <= 252:
            raise self.error(f"{what} has a byteStride of {str(stride)[:40]}")
        offset = self.whole(accessor.get("byteOffset", 0), size + 1, f"byteOffset of {what}")
        most = (size - offset - each) // stride + 1 if size - offset >= each else 0
        count = self.whole(accessor.get("count"), most + 1, f"count of {what}")
        self._left -= count * each
        if self._left < 0:
            raise self.error("its arrays together are several times larger than the file")
        found = np.ndarray(
            (count, width), dtype, self._data, start + offset, (stride, dtype.itemsize)
        ).copy()
        if accessor.get("normalized") is True and dtype.kind in "iu":
            return np.maximum(found / np.iinfo(dtype).max, -1.0)
        return found

    def transforms(self) -> tuple[list[int], list[int], np.ndarray]:
        """Return the nodes' tree: order (parents first), parents (-1 for roots), and (N, 4, 4)
        transforms from each node to the world."""
        nodes = self.items("nodes")
        parents = [-1] * len(nodes)
        for above, node in enumerate(nodes):
            for below in self.wholes(node, "children", len(nodes)):
                if parents[below] != -1 or below == above:
                    raise self.error(f"node {below} has two parents")
                parents[below] = above
        order = [node for node, parent in enumerate(parents) if parent == -1]
        for node in order:  # grows
            order += nodes[node].get("children", [])
        if len(order) < len(nodes):
            raise self.error("its nodes form no tree")
        world = np.zeros((len(nodes), 4, 4))
        for node in order:
            own, parent = self._local(nodes[node]), parents[node]
            world[node] = own if parent == -1 else world[parent] @ own
        if not (np.abs(world) <= _FARTHEST).all():
            raise self.error(f"places of its nodes are beyond {_FARTHEST:g} metres")
        return order, parents, world

    def _local(self, node: dict[str, Any]) -> np.ndarray:
        if "matrix" in node:
            return self.numbers(node, "matrix", [0.0] * 16).reshape(4, 4).T
        x, y, z, w = self.numbers(node, "rotation", [0.0, 0.0, 0.0, 1.0])
        norm = math.sqrt(x * x + y * y + z * z + w * w)
        x, y, z, w = (v / norm for v in (x, y, z, w)) if norm > 1e-6 else (0.0, 0.0, 0.0, 1.0)
        turn = np.array([
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ])  # fmt: skip
        matrix = np.eye(4)
        matrix[:3, :3] = turn * self.numbers(node, "scale", [1.0, 1.0, 1.0])
        matrix[:3, 3] = self.numbers(node, "translation", [0.0, 0.0, 0.0])
        return matrix


_MOST_PIXELS = 1 << 26
_SIDE = 512
"""Textures are reduced to this many pixels: vertices are far apart."""
_PALETTE = 128
"""Colours of an avatar."""
_CUT = 0.5
"""Faces of materials with holes that are less opaque are left out."""


class Colours:
    """Colours of the materials of a file."""

    def __init__(self, glb: Glb) -> None:
        self._glb = glb
        self._images: dict[int, np.ndarray | None] = {}

    def at(self, material: object, uv: np.ndarray | None, n_points: int) -> np.ndarray:
        """Return RGBA (N, 4) of a material at texture coordinates (N, 2), 0 to 1, sRGB.

        Opaque materials have an alpha of 1.

        Warns:
            UserWarning: a texture that cannot be read; its base colour is used.
        """
        if material is None:
            return np.broadcast_to([0.8, 0.8, 0.8, 1.0], (n_points, 4))
        glb = self._glb
        found = glb.item("materials", material)
        surface = glb.object(found, "pbrMetallicRoughness")
        factor = np.clip(glb.numbers(surface, "baseColorFactor", [1.0] * 4), 0, 1)
        factor[:3] = np.where(
            factor[:3] <= 0.0031308, 12.92 * factor[:3], 1.055 * factor[:3] ** (1 / 2.4) - 0.055
        )
        rgba = np.broadcast_to(factor, (n_points, 4)).copy()
        texture = self._texture(glb.object(surface, "baseColorTexture"))
        if texture is not None and uv is not None:
            height, width = texture.shape[:2]
            column, row = ((uv % 1.0) * [width, height]).astype(int).T
            rgba *= texture[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)] / 255
        if found.get("alphaMode", "OPAQUE") == "OPAQUE":
            rgba[:, 3] = 1.0
        return rgba

    def _texture(self, reference: dict[str, Any]) -> np.ndarray | None:
        """Return the RGBA image (H, W, 4) uint8 of a texture."""
        if "index" not in reference:
            return None
        source = self._glb.item("textures", reference["index"]).get("source")
        if source is None:  # an extension's format
            return None
        at = self._glb.whole(source, len(self._glb.items("images")), "index into images")
        if at not in self._images:
            self._images[at] = self._image(self._glb.item("images", at))
        return self._images[at]

    def _image(self, image: dict[str, Any]) -> np.ndarray | None:
        if "bufferView" not in image:
            warnings.warn(f"{self._glb.path}: a texture of another file is left out", stacklevel=2)
            return None
        data = self._glb.view(image["bufferView"])
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", Image.DecompressionBombWarning)
                with Image.open(io.BytesIO(data), formats=("PNG", "JPEG")) as opened:
                    if opened.width * opened.height > _MOST_PIXELS:
                        raise ValueError(f"{opened.width} by {opened.height} pixels")
                    opened.draft("RGB", (_SIDE, _SIDE))
                    opened.thumbnail((_SIDE, _SIDE))
                    return np.asarray(opened.convert("RGBA"))
        except Exception as error:  # Pillow's decoders raise anything
            warnings.warn(
                f"{self._glb.path}: a texture cannot be read ({str(error)[:120]}): the base colour "
                "of its material is used",
                stacklevel=2,
            )
            return None


def is_seen(alpha: np.ndarray) -> np.ndarray:
    """Return whether faces (F,) are drawn, from the alpha (F, 3) of their corners."""
    return alpha.mean(axis=1) >= _CUT


def reduce_colours(colours: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return few colours, (R, 3) uint8, and the indices (V,) of those of vertices (V, 3)."""
    pixels = np.rint(np.clip(colours, 0, 1) * 255).astype(np.uint8)
    palette, regions = np.unique(pixels, axis=0, return_inverse=True)
    if len(palette) > _PALETTE:
        image = Image.fromarray(pixels[None]).quantize(_PALETTE, dither=Image.Dither.NONE)
        regions = np.asarray(image)[0]
        palette = np.array(image.getpalette()[: 3 * _PALETTE], np.uint8).reshape(-1, 3)
    return palette, regions.reshape(-1).astype(np.uint8)
