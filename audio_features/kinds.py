"""Kinds of extractors: the one table in which a speech feature is entered, and installed ones."""

from __future__ import annotations

import contextlib
import hashlib
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

GROUP = "gesturekit.extractors"
"""Entry points by which a package adds extractors: kind = "module:class"."""


@dataclass(frozen=True)
class Kind:
    """Entry of an extractor.

    Attributes:
        module: module of audio_features that holds the class; imported on first use.
        name: name of the class, which audio_features exports.
        argument: setting that may follow the kind after a colon, as in `mfcc:20`; None for none.
        place: setting of the folder of its weights or files, which may be given beside the spec;
            "" if no setting names it, None for an extractor without.
    """

    module: str
    name: str
    argument: str | None = None
    place: str | None = None


KINDS = {
    "logmel": Kind("acoustic", "LogMel", "n_mels"),
    "mfcc": Kind("acoustic", "MFCC", "n"),
    "prosody": Kind("acoustic", "Prosody"),
    "onset": Kind("acoustic", "Onset"),
    "prosodic_range": Kind("acoustic", "ProsodicRange", "seconds"),
    "effort": Kind("acoustic", "Effort", "seconds"),
    "music": Kind("acoustic", "Music", "n_chroma"),
    "words": Kind("words", "Words", "encoder", place="encoder"),
    "wavlm": Kind("wavlm", "WavLM", place=""),
    "hf": Kind("huggingface", "HuggingFace", "path", place="path"),
    "files": Kind("files", "Files", "dim", place="folder"),
}
"""Extractors by the `kind` of their specs, in the order in which messages list them."""


def installed_kinds() -> dict[str, EntryPoint]:
    """Return the extractors of installed packages by their kinds, which no kind of `KINDS` is."""
    from importlib import metadata

    entries = metadata.entry_points(group=GROUP)
    return {entry.name: entry for entry in entries if entry.name not in KINDS}


@lru_cache
def digest_of_sources(root: Path) -> str:
    """Return a digest of a source file, or of all below a folder and its tables: a part of keys."""
    digest = hashlib.sha256()
    files = [root] if root.is_file() else [*root.rglob("*.py"), *root.rglob("*.toml")]
    if not files:  # keys that do not change with the code would be worse
        raise FileNotFoundError(f"{root}: no source code to take a digest of")
    for path in sorted(files):
        digest.update(path.relative_to(root).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


@lru_cache
def installed_versions(packages: tuple[str, ...]) -> dict[str, str]:
    """Return {package: version} of those that are installed."""
    from importlib import metadata

    versions = {}
    for package in packages:
        with contextlib.suppress(metadata.PackageNotFoundError):
            versions[package] = metadata.version(package)
    return versions
