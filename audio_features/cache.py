"""FeatureCache: features that are slow to extract, stored on disk."""

from __future__ import annotations

import hashlib
import json
import logging
import os
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from audio_features.disk_cache import (
    MAX_BYTES,
    DiskCache,
    default_folder,
    digest_of_sources,
    installed_versions,
    size_limit,
)
from audio_features.errors import FeatureError
from audio_features.track import FeatureTrack

if TYPE_CHECKING:
    from audio_features.extractor import Extractor
    from audio_features.wave import Wave

# Packages of which another version may change the last bits of a feature.
_NUMERICAL = ("numpy", "scipy", "librosa", "soxr", "torch", "torchaudio")
_KIND = "features-1"

log = logging.getLogger(__name__)


class FeatureCache(DiskCache):
    """Cache of features on disk, keyed by the sound and everything that affects the features.

    The key is a digest of the samples and their rate, the words beside the sound if the extractor
    has a method `digest_beside(wave)`, the extractor's spec (settings and
    fingerprint of the weights), the source code of this package, and the versions of the
    numerical libraries. A change of any of these gives another entry, so the cache never has to
    be cleared by hand. A value read from the cache is bit-identical to the extracted one. With
    `precision` "fp16" the first call rounds too, so that all calls agree. The device is not part
    of a spec, so a CPU may read features computed on a GPU.

    Light features (log-mel, MFCC, prosody by YIN, onsets, music by librosa) are not cached: they
    take less than a hundredth of the sound's duration, and 20 kB per second on disk. WavLM,
    pitch by pyin and beats by madmom are cached. The parts of a `Stack` are cached separately.

    Several processes may share a folder. An entry gets its final name only when it is complete;
    an entry with a wrong checksum is extracted again. If the folder cannot be written to,
    features are extracted without a cache, with one warning.

    Args:
        folder: folder of the cache; None means `default_folder()`.
        max_bytes: size limit; beyond it the least recently used entries are removed.
        precision: "fp16" halves the size, with a relative error of at most 0.05 %.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str] | None = None,
        *,
        max_bytes: int = MAX_BYTES,
        precision: Literal["fp32", "fp16"] = "fp32",
    ) -> None:
        if precision not in ("fp32", "fp16"):
            raise FeatureError(f"precision={precision!r}: fp32 or fp16")
        super().__init__(folder, max_bytes=max_bytes)
        self.precision = precision

    def extract(self, extractor: Extractor, wave: Wave) -> FeatureTrack:
        """Return `extractor.extract(wave)`, values (T, D), from the cache if possible."""
        from audio_features.extractor import Stack

        if isinstance(extractor, Stack):
            return extractor.extract(wave, self.extract)
        if not getattr(extractor, "worth_caching", True):
            return extractor.extract(wave)
        path = self._entry(extractor, wave)
        track = self._read(path, extractor)
        if track is None:
            track = self._rounded(extractor.extract(wave))
            self._store(path, track)
        return track

    def _entry(self, extractor: Extractor, wave: Wave) -> Path:
        made_of = {
            "sound": wave.digest,
            "beside": extractor.digest_beside(wave) if hasattr(extractor, "digest_beside") else "",
            "spec": extractor.spec,
            "precision": self.precision,
            "code": digest_of_sources(Path(__file__).parent),
            "versions": installed_versions(_NUMERICAL),
        }
        text = json.dumps(made_of, sort_keys=True, allow_nan=False)
        key = hashlib.sha256(text.encode()).hexdigest()
        return self.path(_KIND, key, ".safetensors")

    def _rounded(self, track: FeatureTrack) -> FeatureTrack:
        if self.precision == "fp32":
            return track
        largest = float(np.abs(track.values).max(initial=0.0))
        if largest > np.finfo(np.float16).max:
            raise FeatureError(f"a value of {largest:.3g} does not fit into fp16: cache as fp32")
        return FeatureTrack(track.values.astype(np.float16), track.times, track.spec, track.names)

    def _read(self, path: Path, extractor: Extractor) -> FeatureTrack | None:
        """Read an entry and mark it as used; None if it is missing or damaged."""
        from safetensors import SafetensorError, safe_open

        try:
            with safe_open(path, framework="numpy") as file:
                about = file.metadata() or {}
                values, times = file.get_tensor("values"), file.get_tensor("times")
            if about.get("checksum") != _checksum(values, times):
                raise FeatureError("its checksum is wrong")
            track = FeatureTrack(values, times, extractor.spec, extractor.names)
        except FileNotFoundError:
            return None
        except (OSError, SafetensorError, TypeError, ValueError) as error:
            log.warning("%s: damaged (%s); extracting again", path, error)
            return None
        self.mark_used(path)
        return track

    def _store(self, path: Path, track: FeatureTrack) -> None:
        from safetensors.numpy import save

        kind = np.float16 if self.precision == "fp16" else np.float32
        values = track.values.astype(kind, copy=False)
        if values.nbytes + track.times.nbytes > self.max_bytes:
            return
        about = {"spec": json.dumps(track.spec), "checksum": _checksum(values, track.times)}
        data = save({"values": values, "times": track.times}, about)
        self.write(path, data)


def cache_from_environment(precision: Literal["fp32", "fp16"] = "fp32") -> FeatureCache:
    """Return the cache in `default_folder()`, limited to $GESTUREKIT_CACHE_GB gigabytes (20).

    Every call returns the same object, so that the folder is not measured again for every sound.

    Raises AudioFeaturesError if the variable is not a number of at least 0; 0 stores nothing.
    """
    return _shared(default_folder(), size_limit(), precision)


@lru_cache
def _shared(folder: Path, max_bytes: int, precision: Literal["fp32", "fp16"]) -> FeatureCache:
    return FeatureCache(folder, max_bytes=max_bytes, precision=precision)


def _checksum(values: np.ndarray, times: np.ndarray) -> str:
    digest = hashlib.sha256()
    for array in (values, times):
        digest.update(f"{array.dtype} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array))
    return digest.hexdigest()
