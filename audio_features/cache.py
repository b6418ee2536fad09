"""Cache on disk: entries of several kinds, and features that are slow to extract."""

from __future__ import annotations

import contextlib
import glob
import hashlib
import json
import logging
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from audio_features.atomic import atomic_write
from audio_features.errors import AudioFeaturesError
from audio_features.kinds import digest_of_sources, installed_versions
from audio_features.track import FeatureTrack

if TYPE_CHECKING:
    from audio_features.extractor import Extractor
    from audio_features.wave import Wave

KINDS = ("features-1", "measurements-1")
"""Subfolders of entries, each with the number of its format; nothing else is ever removed."""
MAX_BYTES = 20 * 10**9
"""Default size limit: 36 hours of WavLM Base."""

_PART = ".part"  # suffix of an entry that is being written
_STALE_SECONDS = 3600  # a temporary file older than this was left by a process that was killed

_T = TypeVar("_T")
log = logging.getLogger(__name__)


def default_folder() -> Path:
    """Return $GESTUREKIT_CACHE, or the platform's cache folder of the user.

    The latter is $XDG_CACHE_HOME/gesturekit (~/.cache/gesturekit), ~/Library/Caches/gesturekit on
    macOS, %LOCALAPPDATA%/gesturekit on Windows.
    """
    if named := os.environ.get("GESTUREKIT_CACHE"):
        return Path(named)
    usual = {"win32": ("LOCALAPPDATA", "~/AppData/Local"), "darwin": ("", "~/Library/Caches")}
    variable, base = usual.get(sys.platform, ("XDG_CACHE_HOME", "~/.cache"))
    return Path(os.environ.get(variable) or base).expanduser() / "gesturekit"


@dataclass(frozen=True)
class Contents:
    """Summary of a cache: number of entries, bytes, and last use of the oldest and newest."""

    entries: int
    size: int
    oldest: float | None
    newest: float | None


class DiskCache:
    """Entries on disk, each a file named by a digest; see `FeatureCache`.

    Several processes may share a folder. An entry gets its final name only when it is complete, and
    begins with its checksum. If the folder cannot be written to, nothing is stored, with one
    warning. Beyond the size limit the least recently used entries of all kinds are removed.

    Args:
        folder: folder of the cache; None means `default_folder()`.
        max_bytes: size limit of all kinds together.
    """

    def __init__(
        self, folder: str | os.PathLike[str] | None = None, *, max_bytes: int = MAX_BYTES
    ) -> None:
        self.folder = default_folder() if folder is None else Path(folder)
        self.max_bytes = max_bytes
        # Bytes written since the folder was last measured; the first write measures.
        self._unmeasured = max_bytes
        self._warned = False

    def path(self, kind: str, key: str) -> Path:
        """Return the file of an entry: `kind` of `KINDS`, `key` a hexadecimal digest."""
        return self.folder / kind / key[:2] / key

    def read(self, kind: str, key: str, decode: Callable[[bytes], _T]) -> _T | None:
        """Return an entry and mark it as used; None, and a warning if it is damaged."""
        path = self.path(kind, key)
        try:
            if path.stat().st_size > self.max_bytes:
                raise ValueError("it is larger than the whole cache")
            with path.open("rb") as file:
                checksum, data = file.read(hashlib.sha256().digest_size), file.read()
            if checksum != hashlib.sha256(data).digest():
                raise ValueError("its checksum is wrong")
            value = decode(data)
        except FileNotFoundError:
            return None
        except Exception as error:  # whatever a decoder raises
            log.warning("%s: damaged (%s); it is computed again", path, error)
            return None
        with contextlib.suppress(OSError):  # another user's entry, or a read-only disk
            os.utime(path)
        return value

    def write(self, kind: str, key: str, data: bytes) -> None:
        """Store an entry, unless it is larger than the limit."""
        if len(data) + hashlib.sha256().digest_size > self.max_bytes:
            return
        try:
            written = atomic_write(self.path(kind, key), suffix=_PART)
            with written as temporary, temporary.open("wb") as file:
                file.writelines((hashlib.sha256(data).digest(), data))
            self._unmeasured += len(data)
            # Measuring the folder after every write would be slow. Other processes write too, so
            # it is measured from time to time.
            if self._unmeasured > self.max_bytes // 16:
                self._make_room()
        except OSError as error:
            if not self._warned:
                log.warning("%s: results are not cached (%s)", self.folder, error.strerror)
            self._warned = True

    def contents(self) -> Contents:
        """Summarise the entries of the cache."""
        entries = self._files()[0].values()
        used, size = [e.st_mtime for e in entries], sum(e.st_size for e in entries)
        return Contents(len(entries), size, min(used, default=None), max(used, default=None))

    def clear(self) -> Contents:
        """Remove all entries, and nothing else in the folder; return a summary of them."""
        removed, files = self.contents(), self._files()
        for path in (*files[0], *files[1]):
            path.unlink(missing_ok=True)
        for kind in KINDS:
            for folder in (*(self.folder / kind).glob("*"), self.folder / kind):
                with contextlib.suppress(OSError):  # the folder holds other files
                    folder.rmdir()
        return removed

    def _make_room(self) -> None:
        """Remove least recently used entries above the limit, and files of killed runs."""
        entries, unfinished = self._files()
        size = sum(entry.st_size for entry in entries.values())
        for path in sorted(entries, key=lambda path: entries[path].st_mtime):
            if size <= self.max_bytes:
                break
            path.unlink(missing_ok=True)
            size -= entries[path].st_size
        for path, entry in unfinished.items():
            if time.time() - entry.st_mtime >= _STALE_SECONDS:
                path.unlink(missing_ok=True)
        self._unmeasured = 0

    def _files(self) -> tuple[dict[Path, os.stat_result], dict[Path, os.stat_result]]:
        """Return the files of entries, and those of entries that are being written."""
        files: tuple[dict[Path, os.stat_result], dict[Path, os.stat_result]] = {}, {}
        for kind in KINDS:
            pattern = f"{glob.escape(str(self.folder / kind))}/*/*"
            # Unlike `Path.glob`, it takes it that another process removes a folder.
            for path in map(Path, glob.iglob(pattern, include_hidden=True)):  # noqa: PTH207
                with contextlib.suppress(FileNotFoundError):  # removed by another process
                    files[path.suffix == _PART][path] = path.stat()
        return files


def size_limit() -> int:
    """Return the limit in $GESTUREKIT_CACHE_GB (20) in bytes.

    Raises AudioFeaturesError if the variable is not a number of at least 0; 0 stores nothing.
    """
    size = os.environ.get("GESTUREKIT_CACHE_GB")
    try:
        limit = MAX_BYTES if size is None else int(float(size) * 1e9)
    except (ValueError, OverflowError):
        limit = -1
    if limit < 0:
        raise AudioFeaturesError(f"GESTUREKIT_CACHE_GB={size!r}: give gigabytes, 0 for no cache")
    return limit


# Packages of which another version may change the last bits of a feature.
_NUMERICAL = ("numpy", "scipy", "librosa", "soxr", "torch")


class FeatureCache(DiskCache):
    """Cache of features on disk, keyed by the sound and everything that affects the features.

    The key is a digest of the samples and their rate, the words beside the sound if the extractor
    has a method `digest_beside(wave)`, the extractor's spec (settings and
    fingerprint of the weights), the source code of this package, and the versions of the
    numerical libraries. A change of any of these gives another entry, so the cache never has to
    be cleared by hand. A value read from the cache is bit-identical to the extracted one. The
    device is not part of a spec, so a CPU may read features computed on a GPU.

    Acoustic features are not cached: they take less than a hundredth of the sound's duration, and
    20 kB per second on disk. The parts of a `Stack` are cached separately.

    Several processes may share a folder. An entry gets its final name only when it is complete;
    an entry with a wrong checksum is extracted again. If the folder cannot be written to,
    features are extracted without a cache, with one warning.

    Args:
        folder: folder of the cache; None means `default_folder()`.
        max_bytes: size limit; beyond it the least recently used entries are removed.

    Examples:
        Light features are extracted each time; nothing is stored:

        >>> seconds = np.arange(16000) / 16000
        >>> tone = af.Wave.from_array(np.sin(2 * np.pi * 220 * seconds), 16000)
        >>> cache = af.FeatureCache(folder)
        >>> cache.extract(af.LogMel(), tone).values.shape
        (100, 24)
        >>> cache.contents().entries
        0
    """

    def extract(self, extractor: Extractor, wave: Wave) -> FeatureTrack:
        """Return `extractor.extract(wave)`, values (T, D), from the cache if possible."""
        from audio_features.extractor import Stack

        if isinstance(extractor, Stack):
            return extractor.extract(wave, self.extract)
        if not getattr(extractor, "worth_caching", True):
            return extractor.extract(wave)

        from safetensors.numpy import load, save

        made_of = {
            "sound": wave.digest,
            "beside": extractor.digest_beside(wave) if hasattr(extractor, "digest_beside") else "",
            "spec": extractor.spec,
            "code": digest_of_sources(Path(__file__).parent),
            "versions": installed_versions(_NUMERICAL),
        }
        text = json.dumps(made_of, sort_keys=True, allow_nan=False)
        key = hashlib.sha256(text.encode()).hexdigest()

        def decode(data: bytes) -> FeatureTrack:
            return FeatureTrack(**load(data), spec=extractor.spec, names=extractor.names)

        track = self.read(KINDS[0], key, decode)
        if track is None:
            track = extractor.extract(wave)
            self.write(KINDS[0], key, save({"values": track.values, "times": track.times}))
        return track


def cache_from_environment() -> FeatureCache:
    """Return the cache in `default_folder()`, limited to $GESTUREKIT_CACHE_GB gigabytes (20).

    Every call returns the same object, so that the folder is not measured again for every sound.

    Raises AudioFeaturesError if the variable is not a number of at least 0; 0 stores nothing.

    Examples:
        >>> af.cache_from_environment() is af.cache_from_environment()
        True
    """
    return _shared(default_folder(), size_limit())


@lru_cache
def _shared(folder: Path, max_bytes: int) -> FeatureCache:
    return FeatureCache(folder, max_bytes=max_bytes)
