"""Record beside rendered files: the model, settings and input of each.

An append-only file of JSON lines. Each result has a line when its writing begins, and one with its
SHA-256 when it is complete; the last line counts. Damaged lines, which a killed run may leave, are
ignored.
"""

from __future__ import annotations

import dataclasses
import glob
import hashlib
import json
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from gesturekit.errors import ConfigError
from gesturekit.model import Model

RECORD = ".gesturekit-render.jsonl"
_FORMAT = 1


class Record:
    """Record of the model, settings and input of each file of a folder.

    Args:
        out: the folder; it need not exist.
        model: folder of the model, for `gesturekit evaluate`; None if it was never saved.

    Raises:
        ConfigError: the record is a symbolic link.
    """

    def __init__(self, out: Path, model: Path | None = None) -> None:
        self._about = {"format": _FORMAT} | ({"model_folder": str(model)} if model else {})
        self._out, self._path = out, out / RECORD
        if self._path.is_symlink():
            raise ConfigError(f"{self._path} is a link, and would lead out of {out}: remove it")
        self._lines: dict[str, dict[str, Any]] = {}
        text = self._path.read_text("utf-8", "replace") if self._path.is_file() else ""
        # Begin a new line after one that a killed run left unfinished.
        self._begin = "" if text.endswith("\n") or not text else "\n"
        for line in text.splitlines():
            try:
                values = json.loads(line)
                if values["format"] == _FORMAT and isinstance(values["made_with"], dict):
                    self._lines[values["file"]] = values
            except (ValueError, TypeError, KeyError, RecursionError):
                continue

    def state(self, file: Path, made_with: Mapping[str, Any]) -> Literal["same", "begun", "other"]:
        """Compare an existing file with the one that would be made now.

        Returns:
            "same" for a complete file with the same `made_with`; "begun" for one that an
            interrupted run was writing with the same; "other" for anything else.
        """
        line = self._lines.get(self._key(file))
        if line is None or line["made_with"] != made_with:
            return "other"
        if "sha256" not in line:
            return "begun"
        return "same" if line["sha256"] == _file_digest(file) else "other"

    def differences(self, file: Path, made_with: Mapping[str, Any]) -> list[str]:
        """Return the settings that differed when a file was made; empty without a record of it."""
        line = self._lines.get(self._key(file))
        if line is None:
            return []
        was = line["made_with"]
        return [name for name in {**was, **made_with} if was.get(name) != made_with.get(name)]

    def begin(self, file: Path, made_with: Mapping[str, Any]) -> None:
        """Record that a file is being written, and remove temporary files of a killed run."""
        if "sha256" not in self._lines.get(self._key(file), {"sha256": ""}):
            for left in file.parent.glob(f".{glob.escape(file.stem)}-????????{file.suffix}"):
                left.unlink(missing_ok=True)
        self._append({"file": self._key(file), "made_with": dict(made_with)})

    def finish(self, file: Path, made_with: Mapping[str, Any]) -> None:
        """Record that a file is complete."""
        line = {"file": self._key(file), "made_with": dict(made_with)}
        self._append({**line, "sha256": _file_digest(file)})

    def _key(self, file: Path) -> str:
        return file.relative_to(self._out).as_posix()

    def _append(self, line: dict[str, Any]) -> None:
        self._out.mkdir(parents=True, exist_ok=True)
        text = self._begin + json.dumps({**self._about, **line}) + "\n"
        with self._path.open("a", encoding="utf-8") as file:
            file.write(text)
        self._begin = ""


def model_fingerprint(model: Model) -> str:
    """Return the SHA-256 of the files that saving a model writes."""
    digest = hashlib.sha256()
    with tempfile.TemporaryDirectory(prefix="gesturekit-") as folder:
        model.save(folder)
        for path in sorted(Path(folder).iterdir()):
            if path.name != "README.md":
                digest.update(path.read_bytes())
    return digest.hexdigest()


def described(value: Any) -> Any:
    """Return a setting as JSON: plain values unchanged, files and arrays by their SHA-256.

    Equal descriptions mean equal motion. The converse need not hold: a file and its copy, given as
    strings, have different descriptions.
    """
    if value is None or isinstance(value, bool | int | float):
        return value
    if isinstance(value, str):
        is_file = os.path.isfile(value)  # noqa: PTH113 (no error for a long text)
        return f"{value} sha256:{path_digest(value)}" if is_file else value
    if isinstance(value, os.PathLike):
        return f"sha256:{path_digest(value)}"
    if isinstance(value, np.ndarray):
        about = f"{value.dtype} {value.shape} ".encode()
        return f"sha256:{hashlib.sha256(about + value.tobytes()).hexdigest()}"
    if isinstance(value, Mapping):
        return {str(key): described(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [described(item) for item in value]
    if isinstance(value, Model):
        return f"model sha256:{model_fingerprint(value)}"
    if dataclasses.is_dataclass(value):
        fields = {f.name: described(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return f"sha256:{hashlib.sha256(json.dumps(fields).encode()).hexdigest()}"
    return str(value)


def path_digest(path: str | os.PathLike[str]) -> str:
    """Return the SHA-256 of a file, or of all files in a folder; "" if it cannot be read."""
    path = Path(path)
    try:
        if path.is_dir():
            parts = [f"{part.name} {path_digest(part)}" for part in sorted(path.iterdir())]
            return hashlib.sha256("\n".join(parts).encode("utf-8", "surrogateescape")).hexdigest()
        return _file_digest(path) if path.is_file() else ""
    except OSError:
        return ""


def _file_digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
