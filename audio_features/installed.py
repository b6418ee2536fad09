"""Installed packages: the extractors that they add, their versions and their code."""

from __future__ import annotations

import contextlib
import hashlib
import inspect
import json
import logging
import sys
from functools import lru_cache
from importlib import metadata
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

from audio_features.errors import AudioFeaturesError, FeatureError
from audio_features.kinds import KINDS
from audio_features.track import FeatureTrack
from audio_features.wave import Wave

GROUP = "gesturekit.extractors"
"""Entry points by which a package adds extractors: kind = "module:class"."""

log = logging.getLogger(__name__)


def installed_kinds() -> dict[str, EntryPoint]:
    """Return the extractors of installed packages by their kinds, which no kind of `KINDS` is."""
    found = metadata.entry_points(group=GROUP)
    return {entry.name: entry for entry in found if entry.name not in KINDS}


class Installed:
    """Extractor of an installed package, made by its entry point; its results are checked.

    The spec names the package, its version and a digest of its code, so that a cache knows other
    code, and a machine without the package knows what is missing.

    Args:
        entry: entry point whose name is the kind.
        settings: keywords of the extractor, and `package` if the spec has one.
        device: given to an extractor that has this keyword.

    Raises FeatureError if the package cannot be used.
    """

    def __init__(self, entry: EntryPoint, settings: dict[str, Any], device: str) -> None:
        dist = entry.dist
        version = f"{dist.name} {dist.version}" if dist else entry.module
        self._who = f"extractor {entry.name!r} of {version}"
        made_with = settings.pop("package", None)
        try:
            make = entry.load()
            if "device" in inspect.signature(make).parameters:
                settings["device"] = device
            self._own = make(**settings)
            wanted = ("spec", "names", "centred", "extract")
            if missing := [name for name in wanted if not hasattr(self._own, name)]:
                raise FeatureError(f"has no {', '.join(missing)}; see audio_features.Extractor")
            self.names = tuple(f"{entry.name}.{name}" for name in self._own.names)
            self.centred = tuple(map(bool, self._own.centred))
            if len(self.names) != len(self.centred):
                raise FeatureError(f"{len(self.names)} names and {len(self.centred)} of centred")
            spec = json.loads(json.dumps(self._own.spec, allow_nan=False))
            package = f"{version} ({_code_of(entry)})"
            self.spec = spec | {"kind": entry.name, "package": package}
        except Exception as error:
            raise FeatureError(f"{self._who}: {error or repr(error)}") from error
        self.dim, self.worth_caching = len(self.names), getattr(self._own, "worth_caching", True)
        if made_with not in (None, package):
            text = "%s: %s is installed, the features were made with %s"
            log.warning(text, entry.name, package, made_with)

    def extract(self, wave: Wave) -> FeatureTrack:
        """Extract the features of a sound: values (T, D). Raises FeatureError if that fails."""
        try:
            track = self._own.extract(wave)
            return FeatureTrack(track.values, track.times, self.spec, self.names)
        except AudioFeaturesError as error:
            raise FeatureError(f"{wave.source or 'the sound'}: {self._who}: {error}") from error
        except Exception as error:  # foreign code may raise anything; other sounds go on
            raise FeatureError(f"{wave.source or 'the sound'}: {self._who}: {error!r}") from error

    def __repr__(self) -> str:
        return f"Installed({self.spec})"


def _code_of(entry: EntryPoint) -> str:
    """Return 8 digits that change with the source code of an entry point's package."""
    package, module = sys.modules[entry.module.partition(".")[0]], sys.modules[entry.module]
    file = Path(getattr(package, "__file__", None) or str(module.__file__))
    return digest_of_sources(file.parent if file.stem == "__init__" else file)[:8]


@lru_cache
def digest_of_sources(root: Path) -> str:
    """Return a digest of a source file, or of all below a folder and its tables: a part of keys."""
    digest = hashlib.sha256()
    files = [root] if root.is_file() else [*root.rglob("*.py"), *root.rglob("*.toml")]
    for path in sorted(files):
        digest.update(path.relative_to(root).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


@lru_cache
def installed_versions(packages: tuple[str, ...]) -> dict[str, str]:
    """Return {package: version} of those that are installed."""
    found = {}
    for package in packages:
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[package] = metadata.version(package)
    return found
