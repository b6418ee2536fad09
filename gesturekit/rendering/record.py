"""Model of the results in a folder, and the fingerprint by which it is known."""

from __future__ import annotations

import hashlib
import tempfile
from pathlib import Path
from typing import Any

from gesturekit.jobs.journal import last_run
from gesturekit.jobs.state import STATE
from gesturekit.model import Model


def model_of_results(out: Path) -> Path | None:
    """Return the folder of the model that made the latest results in a folder, if it is known.

    Raises:
        FormatError: a journal cannot be opened, or was written by a newer version.
    """
    folder = (last_run(out / STATE, "model_folder") or {}).get("model_folder")
    return Path(folder) if isinstance(folder, str) else None


def model_fingerprint(model: Model) -> str:
    """Return the SHA-256 of the files that saving a model writes."""
    digest = hashlib.sha256()
    with tempfile.TemporaryDirectory(prefix="gesturekit-") as folder:
        model.save(folder)
        for path in sorted(Path(folder).iterdir()):
            if path.name != "README.md":
                digest.update(path.read_bytes())
    return digest.hexdigest()


def without_models(value: Any) -> Any:
    """Return a setting with a fingerprint in place of each model in it."""
    if isinstance(value, Model):
        return f"model sha256:{model_fingerprint(value)}"
    if isinstance(value, list | tuple):
        return [without_models(item) for item in value]
    return value
