"""Reader of glTF 2.0 files: objects and arrays of .glb, .vrm and .gltf.

The libraries on PyPI hand out a file's numbers as they are; everything that is used here is checked
first, since such files are downloaded from anywhere. A .gltf may name files of its own folder.
"""

from __future__ import annotations

import base64
import os
import struct
import warnings
from pathlib import Path
from shlex import quote
from typing import Any
from urllib.parse import unquote

import numpy as np

from audio_features.archive import parse_json, read_bytes
from gesturekit.errors import FormatError

MAX_BYTES = 256 << 20
"""Largest file, and largest sum of its arrays; avatars have 5 to 60 MB."""
_MAX_VALUES = 4_000_000
"""Largest number of values in the JSON part."""
_MAX_ITEMS = 20_000
"""Largest number of nodes, accessors or other objects of a kind."""
FARTHEST = 1e6
"""Largest coordinate or factor, in the file's unit."""
_DECODED, _DECODED_PER_BYTE = 32 << 20, 10
"""Bytes of decoded arrays and images that any file may have, and more for each of its bytes."""
_WORK, _WORK_PER_BYTE = 20_000_000, 5
"""Steps of about 100 ns that reading any file may take, and more for each of its bytes."""
JSON, BIN = 0x4E4F534A, 0x004E4942
_TYPES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_DRACO = "KHR_draco_mesh_compression"
_COMPRESSED = ("EXT_meshopt_compression", "KHR_meshopt_compression")
_READ = {"KHR_mesh_quantization", _DRACO}
_HARMLESS = ("VRM", "KHR_materials_", "KHR_lights_", "KHR_texture_", "EXT_texture_")
"""Extensions that are read, or change meshes and colours alone, and how the names of more begin."""


class Gltf:
    """Objects and arrays of a file.

    Attributes:
        path: of the file.
        json: its JSON object.
        size: bytes of the files that were read.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        """Read a file.

        Raises:
            FormatError: missing, too large, cut short, not glTF 2.0, or compressed.

        Warns:
            UserWarning: an extension that the file needs is not read.
        """
        self.path = Path(path)
        self._decoded, self._work, self.size = _DECODED, _WORK, 0
        self._resources: dict[str | Path | None, bytes] = {}
        self._arrays: dict[int, np.ndarray] = {}
        self._checked: set[str] = set()
        self.json = self._parsed(self._content(self.path))
        for name in map(str, self.values(self.json, "extensionsRequired")):
            if "compression" in name and name != _DRACO:
                raise self._unread(name)
            if name not in _READ and not name.startswith(_HARMLESS):
                text = f"needs the extension {name[:60]!r}, which is left out"
                warnings.warn(f"{self.path}: {text}", stacklevel=3)

    def refuse_compressed_meshes(self) -> None:
        """Raise FormatError for meshes that only a decoder of Draco can read."""
        if _DRACO in self.values(self.json, "extensionsRequired"):
            raise self._unread(_DRACO)

    def _unread(self, extension: str) -> FormatError:
        way = f"decompress it: npx @gltf-transform/cli copy {quote(self.path.name)} out.glb"
        if any(name.startswith("VRM") for name in self.object(self.json, "extensions")):
            way = "export it again without compression (gltf-transform would drop the data of VRM)"
        return self.error(f"needs the extension {extension[:60]!r}, which is not read; {way}")

    def error(self, problem: str) -> FormatError:
        """Return an error that names the file."""
        return FormatError(f"{self.path}: {problem}")

    def spend(self, what: str, *, decoded: int = 0, work: int = 0) -> None:
        """Take what is about to be decoded from the budget of the file, which grows with its size.

        Args:
            what: is decoded, for the message.
            decoded: bytes that are kept.
            work: steps of about 100 ns.

        Raises:
            FormatError: less is left.
        """
        if decoded > self._decoded or work > self._work:
            raise self.error(f"{what} would take more memory or time than so small a file may")
        self._decoded -= decoded
        self._work -= work

    def _content(self, path: Path) -> bytes:
        try:
            content = read_bytes(path, MAX_BYTES - self.size, FormatError)
        except FormatError as error:
            raise error if path == self.path else self.error(str(error)) from None
        self.size += len(content)
        self._decoded += _DECODED_PER_BYTE * len(content)
        self._work += _WORK_PER_BYTE * len(content)
        return content

    def _parsed(self, content: bytes) -> dict[str, Any]:
        """Return the JSON object of a file; keep the arrays of a binary one."""
        text = content
        if self.path.suffix.lower() != ".gltf" or content[:4] == b"glTF":
            text = self._json_chunk(content)
        if sum(map(text.count, (b",", b"[", b"{"))) > _MAX_VALUES:
            raise self.error(f"its JSON part has over {_MAX_VALUES} values")
        parsed = parse_json(text, f"{self.path}: its JSON part", FormatError)
        if not isinstance(parsed, dict):
            raise self.error("its JSON part is not an object")
        version = self.object(parsed, "asset").get("version", "2.0")
        if not str(version).startswith("2."):
            raise self.error(f"glTF version {str(version)[:20]}; expected 2.0")
        return parsed

    def _json_chunk(self, content: bytes) -> bytes:
        if len(content) < 20 or content[:4] != b"glTF":
            raise self.error("no binary glTF file (.glb, .vrm)")
        version, length, n_json, kind = struct.unpack_from("<4I", content, 4)
        if version != 2:
            raise self.error(f"glTF version {version}; expected 2")
        if length > len(content):
            raise self.error(f"cut short: {len(content)} of {length} bytes")
        start = 20 + n_json
        if kind != JSON or start > len(content):
            raise self.error("no readable JSON part at its start")
        if len(content) >= start + 8:
            n_data, kind = struct.unpack_from("<2I", content, start)
            if kind == BIN:
                self._resources[None] = data = content[start + 8 : start + 8 + n_data]
                if len(data) < n_data:
                    raise self.error(f"cut short: {len(data)} of {n_data} bytes of arrays")
        return content[20:start]

    def resource(self, uri: Any) -> bytes:
        """Return the bytes of a data URI, or of a file in the folder of this one.

        Raises:
            FormatError: neither; files of other folders are not opened.
        """
        if not isinstance(uri, str):
            raise self.error(f"the uri {str(uri)[:60]!r} is not text")
        if uri in self._resources:
            return self._resources[uri]
        if uri.startswith("data:"):
            head, _, text = uri.partition(",")
            try:
                if not head.endswith(";base64"):
                    raise ValueError
                return self._resources.setdefault(uri, base64.b64decode(text))
            except ValueError:
                raise self.error(f"the data URI {uri[:40]!r} is not base64") from None
        try:
            folder = self.path.parent.resolve()
            file = (folder / unquote(uri)).resolve()
            is_inside = file.is_relative_to(folder) and "://" not in uri
        except (OSError, ValueError, RuntimeError):
            is_inside = False
        if not is_inside:
            raise self.error(f"{uri[:100]!r} is not a file in its folder, and is not opened")
        if file not in self._resources:
            self._resources[file] = self._content(file)
        return self._resources.setdefault(uri, self._resources[file])

    def values(self, parent: dict[str, Any], key: str) -> list[Any]:
        """Return the list at a key of an object; an empty one if there is none."""
        entries = parent.get(key, [])
        if not isinstance(entries, list) or len(entries) > _MAX_ITEMS:
            raise self.error(f"{key} is not a list of at most {_MAX_ITEMS}")
        return entries

    def items(self, key: str, parent: dict[str, Any] | None = None) -> list[dict[str, Any]]:
        """Return a list of objects of the file, or of one of its objects."""
        entries = self.values(self.json if parent is None else parent, key)
        if parent is None and key in self._checked:
            return entries
        if not all(isinstance(item, dict) for item in entries):
            raise self.error(f"{key} holds something that is not an object")
        if parent is None:
            self._checked.add(key)
        return entries

    def item(self, key: str, index: Any) -> dict[str, Any]:
        """Return the object at an index of a list of the file."""
        items = self.items(key)
        return items[self.whole(index, len(items), f"index into {key}")]

    def object(self, parent: dict[str, Any], key: str) -> dict[str, Any]:
        """Return the object at a key of another; an empty one if there is none."""
        child = parent.get(key, {})
        if not isinstance(child, dict):
            raise self.error(f"{key} is not an object")
        return child

    def whole(self, value: Any, below: int, what: str) -> int:
        """Return a number that must be whole, at least 0, and below another."""
        if type(value) is not int or not 0 <= value < below:
            raise self.error(f"{what} is {str(value)[:40]}; expected 0 to {below - 1}")
        return value

    def wholes(self, parent: dict[str, Any], key: str, below: int) -> list[int]:
        """Return a list of such numbers."""
        return [self.whole(value, below, key) for value in self.values(parent, key)]

    def numbers(self, parent: dict[str, Any], key: str, default: list[float]) -> np.ndarray:
        """Return numbers (N,), as many as the default has."""
        values = parent.get(key, default)
        right = isinstance(values, list) and len(values) == len(default)
        if not right or not all(type(x) in (int, float) and abs(x) <= FARTHEST for x in values):
            need = f"{len(default)} numbers up to {FARTHEST:g}"
            raise self.error(f"{key} is {str(values)[:60]}; expected {need}")
        return np.array(values, float)

    def buffer(self, index: Any) -> bytes:
        """Return the bytes of a buffer; without a uri it is the array part of a binary file."""
        buffer = self.item("buffers", index)
        if "uri" in buffer:
            return self.resource(buffer["uri"])
        return self._resources.get(None, b"") if index == 0 else b""

    def view(self, index: Any) -> bytes:
        """Return the bytes of a buffer view."""
        data, start, size = self._span(self.item("bufferViews", index))
        return data[start : start + size]

    def _span(self, view: dict[str, Any]) -> tuple[bytes, int, int]:
        """Return a buffer, and the start and the size of a view in it."""
        extensions = self.object(view, "extensions")
        if named := [name for name in _COMPRESSED if name in extensions]:
            raise self._unread(named[0])
        data = self.buffer(view.get("buffer"))
        size = self.whole(view.get("byteLength"), len(data) + 1, "byteLength")
        start = self.whole(view.get("byteOffset", 0), len(data) - size + 1, "byteOffset")
        return data, start, size

    def array(self, index: Any, what: str, width: int) -> np.ndarray:
        """Return the numbers (N, width) of an accessor; normalised ones as floats.

        Raises:
            FormatError: it does not lie within the file, or is of another kind.
        """
        accessors = self.items("accessors")
        at = self.whole(index, len(accessors), f"accessor of {what}")
        if at not in self._arrays:
            numbers = self._read(accessors[at], what)
            if numbers.dtype.kind == "f" and not (np.abs(numbers) <= FARTHEST).all():
                raise self.error(f"{what} holds numbers that are not finite, or over {FARTHEST:g}")
            self._arrays[at] = numbers
        numbers = self._arrays[at]
        if numbers.shape[1] != width:
            raise self.error(f"{what} has {numbers.shape[1]} numbers an element; expected {width}")
        return numbers

    def _read(self, accessor: dict[str, Any], what: str) -> np.ndarray:
        kind, component = accessor.get("type"), accessor.get("componentType")
        if not isinstance(kind, str) or kind not in _TYPES:
            raise self.error(f"{what} is of type {str(kind)[:40]!r}")
        dtype, width = self._dtype(component, what), _TYPES[kind]
        if "bufferView" in accessor:
            count = accessor.get("count")
            array = self._elements(accessor, dtype, width, count, what)
        else:
            count = self.whole(accessor.get("count"), MAX_BYTES, f"count of {what}")
            self._spend(count * width, dtype, what)
            array = np.zeros((count, width), dtype)
        if "sparse" in accessor:
            sparse = self.object(accessor, "sparse")
            places, values = self.object(sparse, "indices"), self.object(sparse, "values")
            n = sparse.get("count")
            kind = self._dtype(places.get("componentType"), what)
            at = self._elements(places, kind, 1, n, f"indices of {what}")[:, 0]
            if kind.kind != "u" or (len(at) and at.max() >= len(array)):
                raise self.error(f"indices of {what} are beyond its {len(array)} elements")
            array[at] = self._elements(values, dtype, width, n, f"values of {what}")
        if accessor.get("normalized") is True and dtype.kind in "iu":
            self._spend(array.size, np.dtype(float), what)
            array = array / np.iinfo(dtype).max
            return np.maximum(array, -1.0, out=array)
        return array

    def _spend(self, size: int, dtype: np.dtype, what: str) -> None:
        self.spend(what, decoded=size * dtype.itemsize, work=size // 4)

    def _dtype(self, component: Any, what: str) -> np.dtype:
        if type(component) is not int or component not in _COMPONENTS:
            raise self.error(f"{what} has components of type {str(component)[:40]!r}")
        return np.dtype(_COMPONENTS[component])

    def _elements(
        self, place: dict[str, Any], dtype: np.dtype, width: int, count: Any, what: str
    ) -> np.ndarray:
        """Return a copy of `count` elements (N, width) that begin at a place in a buffer view."""
        view = self.item("bufferViews", place.get("bufferView"))
        data, start, size = self._span(view)
        each = dtype.itemsize * width
        stride = view.get("byteStride", each)
        if type(stride) is not int or not each <= stride <= 252:
            raise self.error(f"{what} has a byteStride of {str(stride)[:40]}")
        offset = self.whole(place.get("byteOffset", 0), size + 1, f"byteOffset of {what}")
        most = (size - offset - each) // stride + 1  # 0 if not one fits
        n = self.whole(count, most + 1, f"count of {what}")
        self._spend(n * width, dtype, what)
        return np.ndarray((n, width), dtype, data, start + offset, (stride, dtype.itemsize)).copy()
