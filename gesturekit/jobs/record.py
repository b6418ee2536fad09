"""Comparison of existing results with those that would be made now, by the journals."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from gesturekit.jobs.journal import Entry, History


class Record:
    """Settings and input of each result in a folder.

    Args:
        out: the folder; it need not exist.
        history: what the journals of the folder say.
    """

    def __init__(self, out: Path, history: History) -> None:
        self._out, self._history = out, history

    def state(
        self, name: str, file: Path, made_with: Mapping[str, Any]
    ) -> Literal["same", "begun", "other"]:
        """Compare an existing file of an item with the one that would be made now.

        Returns:
            "same" for a complete file with the same `made_with`; "begun" for one that an
            interrupted run was writing with the same settings; "other" for anything else.
        """
        entry = self._entry(name, file)
        if entry is not None and self._made_with(entry.run, entry.input, file) == made_with:
            if self._is_unchanged(file, entry.files[self._key(file)]):
                return "same"
            return "other"
        for run in self._history.unfinished(name):
            was = self._made_with(run, {}, file)
            if was.items() <= made_with.items():
                return "begun"
        return "other"

    def differences(self, name: str, file: Path, made_with: Mapping[str, Any]) -> list[str]:
        """Return the settings that differed when a file was made; empty without a record of it."""
        entry = self._entry(name, file)
        if entry is None:
            return []
        was = self._made_with(entry.run, entry.input, file)
        return [name for name in {**was, **made_with} if was.get(name) != made_with.get(name)]

    def input_digest(self, name: str, audio: Path) -> str | None:
        """Return the SHA-256 of an input as a journal has it, if its size and time are the same."""
        about = file_facts(audio)
        for entry in reversed(self._history.entries(name)):
            if about is not None and entry.source == about:
                return entry.input.get("input")
        return None

    def _entry(self, name: str, file: Path) -> Entry | None:
        key = self._key(file)
        entries = reversed(self._history.entries(name))
        return next((entry for entry in entries if key in entry.files), None)

    def _made_with(self, run: str, item: Mapping[str, Any], file: Path) -> dict[str, Any]:
        about = self._history.runs.get(run, {"settings": {"run": run}})
        written = about.get("written", {}).get(file.suffix[1:], {})
        return {**about["settings"], **item, **written}

    def _is_unchanged(self, file: Path, about: Mapping[str, Any]) -> bool:
        facts = file_facts(file)
        if facts is not None and all(facts[name] == about.get(name) for name in facts):
            return True
        return about.get("sha256") == path_digest(file)

    def _key(self, file: Path) -> str:
        return file.relative_to(self._out).as_posix()


def file_facts(file: Path) -> dict[str, int] | None:
    """Return size and time of change of a file; None if there is none, and for a folder.

    A file with the same is taken to be unchanged, as `make` and `rsync` do.
    """
    try:
        status = file.stat()
    except OSError:
        return None
    if stat.S_ISDIR(status.st_mode):  # changes of the files in it do not show
        return None
    return {"size": status.st_size, "mtime_ns": status.st_mtime_ns}


def described(value: Any) -> Any:
    """Return a setting as JSON: plain values unchanged, files and arrays by their SHA-256.

    Equal descriptions mean equal results. The converse need not hold: a file and its copy, given as
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
