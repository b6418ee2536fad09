"""Keys of stored measurements: digests of everything that a measurement depends on."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import audio_features
from audio_features.cache import DiskCache, default_folder, size_limit
from audio_features.kinds import digest_of_sources, installed_versions
from gesturekit.corpus.manifest import file_fingerprint
from gesturekit.evaluation.pairs import ItemInterval

_KIND = "measurements-1"
_NUMERICAL = ("numpy", "scipy", "librosa", "soxr", "torch", "scikit-learn", "soundfile")
_CODE = ("evaluation", "motion", "formats", "corpus")
"""Packages of gesturekit of which an edit may change a measurement."""
_DESCRIPTIVE = frozenset({"id", "speaker", "style", "split", "text", "audio", "motion", "digests"})
_LARGEST = 200_000_000  # bytes of an entry

log = logging.getLogger(__name__)


class Store:
    """Measurements on disk, in the folder of the feature cache.

    The key of a measurement is a digest of the content of its files, its settings, the source code
    of the metrics, and the versions of the numerical libraries; no entry ever has to be removed by
    hand. The names and places of files are not part of it.
    """

    def __init__(self) -> None:
        self._disk = DiskCache(default_folder(), max_bytes=size_limit())

    def read(self, key: str | None) -> dict[str, Any] | None:
        """Return a measurement, or None if it is not stored or damaged."""
        if key is None:
            return None
        path = self._disk.path(_KIND, key, ".json")
        try:
            if path.stat().st_size > _LARGEST:
                return None
            entry = json.loads(path.read_text(encoding="utf-8"))
            if entry["checksum"] != _checksum(entry["values"]):
                raise ValueError("its checksum is wrong")
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            log.warning("%s: damaged (%s); measuring again", path, error)
            return None
        self._disk.mark_used(path)
        return entry["values"]

    def write(self, key: str | None, values: Mapping[str, Any]) -> None:
        """Store a measurement of plain values, if it has a key."""
        if key is not None:
            entry = {"checksum": _checksum(values), "values": values}
            path = self._disk.path(_KIND, key, ".json")
            self._disk.write(path, json.dumps(entry).encode())


def content_of(source: Path | ItemInterval) -> str | None:
    """Return a digest of the files of a clip or recording, and of how they are read.

    None for motion that is made in memory, and for files that cannot be read.
    """
    try:
        if isinstance(source, Path):
            return file_fingerprint(source)
        item: Any = source.item  # a dataclass
        fields = {f.name: getattr(item, f.name) for f in dataclasses.fields(item)}
        if any(callable(value) for value in fields.values()):
            return None
        how = {name: value for name, value in fields.items() if name not in _DESCRIPTIVE}
        files = [path and file_fingerprint(path) for path in (item.motion, item.audio)]
        return digest_of({"files": files, "how": how})
    except OSError:
        return None


def metric_version() -> dict[str, Any]:
    """Return the part of every key that changes with code and libraries."""
    root = Path(__file__).parents[2]
    code = [digest_of_sources(root / name) for name in _CODE]
    code.append(digest_of_sources(Path(audio_features.__file__).parent))
    return {"code": code, "versions": installed_versions(_NUMERICAL)}


def digest_of(values: Any) -> str:
    """Return a digest of plain values; paths and mappings are taken as text."""
    text = json.dumps(values, sort_keys=True, default=_plain)
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()


def _plain(value: Any) -> Any:
    return dict(value) if isinstance(value, Mapping) else str(value)


def _checksum(values: Any) -> str:
    return hashlib.sha256(json.dumps(values).encode()).hexdigest()
