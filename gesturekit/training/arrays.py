"""Arrays of a corpus, in memory or on disk, from which training reads windows.

An array holds the motion vectors or the raw speech features of one item, frame after frame. On
disk it is named by a digest of the item's files and interval and of all settings that it depends
on, so that an array of a changed file or setting is never read. Runs on the same corpus share their
arrays; a run that is killed while arrays are made goes on with those that are missing.

    CORPUS.arrays/3f/3f2a...c1.npy     (T, C) float32
    CORPUS.arrays/3f/3f2a...c1.json    facts about it, written last
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.lib.format as npy
from torch import Tensor

from audio_features.atomic import atomic_write, write_text
from gesturekit.corpus.manifest import Item
from gesturekit.corpus.speech import one_blas_thread
from gesturekit.errors import (
    ConfigError,
    CorpusError,
    GestureKitError,
    OutputError,
    gesturekit_errors,
    is_full,
)
from gesturekit.progress import Progress
from gesturekit.wording import counted
from gesturekit.workers import Failure, in_processes

log = logging.getLogger(__name__)

_FORMAT = 1
"""Part of every name: a change of the way in which arrays are made makes them anew."""

_LONGEST_HEADER = 256
"""Bytes before the numbers of a .npy file."""


@dataclass(frozen=True)
class StoredArray:
    """Array (T, C) float32 on disk.

    Attributes:
        path: its .npy file.
        shape: T and C.
        facts: about it, as its `Maker` gave them.
    """

    path: Path
    shape: tuple[int, int]
    facts: Mapping[str, Any]

    @property
    def key(self) -> str:
        """Name of the array."""
        return self.path.stem

    def rows(self, start: int, stop: int) -> np.ndarray:
        """Read frames `start` to `stop`, (stop - start, C).

        Without `np.load`, whose reading of the header takes longer than that of a window.

        Raises:
            ConfigError: the file is missing or damaged.
        """
        (n_frames, columns), width = self.shape, 4 * self.shape[1]
        try:
            header = self.path.stat().st_size - n_frames * width
            if not 0 < header <= _LONGEST_HEADER:
                raise ValueError(f"not {n_frames} frames of {columns} numbers")
            count = max(0, min(stop, n_frames) - start) * columns
            numbers = np.fromfile(self.path, np.float32, count, offset=header + start * width)
            return numbers.reshape(-1, columns)
        except (OSError, ValueError) as error:
            raise ConfigError(
                f"{self.path}: this array cannot be read ({error}); remove it, and start again"
            ) from error


@dataclass(frozen=True, eq=False)
class ArrayInMemory:
    """Array (T, C) in memory; attributes as those of `StoredArray`."""

    values: np.ndarray
    facts: Mapping[str, Any]

    @property
    def shape(self) -> tuple[int, int]:
        """T and C."""
        return self.values.shape

    def rows(self, start: int, stop: int) -> np.ndarray:
        """Return frames `start` to `stop`, (stop - start, C) float32."""
        return self.values[start:stop].astype(np.float32, copy=False)


Array = ArrayInMemory | StoredArray


def names_of(arrays: Sequence[Array]) -> list[str]:
    """Return the names of the arrays that are on disk."""
    return [array.key for array in arrays if isinstance(array, StoredArray)]


@dataclass(frozen=True, eq=False)
class StoredFrames:
    """Channels (C, T) of an array, of which `[:, start:stop]` reads and converts a window.

    Attributes:
        array: (T, ...) with these channels.
        shape: C and T.
        convert: returns the channels (C, n) of n rows of the array.
    """

    array: Array
    shape: tuple[int, int]
    convert: Callable[[np.ndarray], Tensor]

    def __getitem__(self, index: tuple[slice, slice]) -> Tensor:
        """Read all channels of a range of frames, (C, n)."""
        channels, frames = index
        start, stop, _ = frames.indices(self.shape[1])
        return self.convert(self.array.rows(start, stop))[channels]

    @property
    def key(self) -> str:
        """Name of the array on disk."""
        assert isinstance(self.array, StoredArray)
        return self.array.key


Frames = Tensor | StoredFrames
"""Channels (C, T) of a recording, as a tensor or of an array; `[:, start:stop]` is a tensor."""


class Maker(Protocol):
    """Makes the arrays of one kind; it is handed to worker processes."""

    def origin(self, item: Item) -> dict[str, Any]:
        """Return all that the array of an item depends on, as plain values."""

    def make(self, item: Item) -> tuple[np.ndarray, dict[str, Any]]:
        """Return the array (T, C) of an item, and facts about it as plain values."""


@dataclass(frozen=True)
class ArrayFolder:
    """Folder of arrays."""

    folder: Path

    def find(self, key: str) -> StoredArray | None:
        """Return the array of this name; None if it is missing or not whole."""
        path = self.folder / key[:2] / f"{key}.npy"
        try:
            facts = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
            n_frames, columns = map(int, facts.pop("shape"))
            whole = path.stat().st_size > 4 * n_frames * columns
        except (OSError, ValueError, TypeError, KeyError, AttributeError):
            return None
        return StoredArray(path, (n_frames, columns), facts) if whole else None

    def find_all(self, keys: Sequence[str]) -> list[StoredArray]:
        """Return the arrays that a run has made before.

        Raises:
            ConfigError: one of them is missing or not whole.
        """
        arrays = [array for array in map(self.find, keys) if array is not None]
        if len(arrays) < len(keys):
            raise ConfigError(
                f"{self.folder}: arrays of this run are missing; arrays=FOLDER names the folder "
                "they were moved to, otherwise start a new run"
            )
        return arrays

    def write(self, key: str, rows: np.ndarray, facts: Mapping[str, Any]) -> None:
        """Write an array (T, C) and the facts about it."""
        path = self.folder / key[:2] / f"{key}.npy"
        values = np.ascontiguousarray(rows, np.float32)
        with atomic_write(path) as temporary, temporary.open("wb") as file:
            # Not by `np.save`, whose error does not say that the disk is full.
            npy.write_array_header_1_0(file, npy.header_data_from_array_1_0(values))
            file.write(values.data)
        write_text(path.with_suffix(".json"), json.dumps({"shape": rows.shape, **facts}))


def array_key(maker: Maker, item: Item) -> str:
    """Return the name of the array of an item."""
    origin = {"format": _FORMAT, "kind": type(maker).__name__, **maker.origin(item)}
    return hashlib.sha256(json.dumps(origin, sort_keys=True, default=str).encode()).hexdigest()[:32]


def stored_arrays(
    folder: Path, wanted: Sequence[tuple[Maker, Sequence[Item]]], workers: int
) -> list[list[StoredArray]]:
    """Return the arrays of the items of each maker; those that are missing are made.

    Args:
        folder: of the arrays.
        wanted: makers with their items.
        workers: number of processes; 1 works in this one.

    Raises:
        CorpusError: an item without the array; those of the others are kept.
        OutputError: the folder cannot be written to; arrays made so far are kept.
    """
    arrays = ArrayFolder(folder)
    keys = [[array_key(maker, item) for item in items] for maker, items in wanted]
    tasks = [
        (which, item, key)
        for which, (_, items) in enumerate(wanted)
        for item, key in zip(items, keys[which], strict=True)
        if arrays.find(key) is None
    ]
    if tasks:
        log.info("%s of the corpus are made in %s.", counted(len(tasks), "array"), folder)
        make = partial(_make, arrays, tuple(maker for maker, _ in wanted))
        here = ((task, make(task)) for task in tasks)
        results = here if workers < 2 else in_processes(make, tasks, workers)
        progress = Progress(results, total=len(tasks), desc="Making arrays", unit="array")
        for (_, item, _), problem in progress:
            if isinstance(problem, Failure):
                raise CorpusError(f"item {item.id}: {problem}; arrays made so far are kept")
            if problem is not None:
                raise type(problem)(f"{problem}; arrays made so far are kept")
    return [arrays.find_all(keys_of_maker) for keys_of_maker in keys]


_Task = tuple[int, Item, str]
"""Number of the maker, item, and name of the array."""


def _make(
    arrays: ArrayFolder, makers: Sequence[Maker], task: _Task
) -> CorpusError | OutputError | None:
    """Make one array and write it; return the error that prevents it."""
    which, item, key = task
    try:
        # The last bits of matrix products depend on the number of threads.
        with gesturekit_errors(), one_blas_thread():
            made = makers[which].make(item)
    except GestureKitError as error:
        return CorpusError(f"item {item.id}: {error}")
    try:
        arrays.write(key, *made)
    except OSError as error:
        todo = "make room" if is_full(error) else "arrays=FOLDER names another folder"
        return OutputError(f"{arrays.folder}: {error.strerror}; {todo}")
    return None
