"""Safe readers of files that may be broken or hostile: no pickles, limited memory."""

from __future__ import annotations

import io
import json
import math
import os
import struct
import sys
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

ALLOWANCE = 32 << 20
"""Bytes that the arrays read from a file may always take."""
MAX_RATIO = 20
"""Beyond the allowance, how many times larger than the file they may be. Real recordings deflate
to a half or a third; zeros, to a thousandth."""
_TAIL = 1 << 17  # the end of an archive: 22 bytes, and a comment of up to 64 KiB
_MAX_DIRECTORY = 1 << 20  # bytes of the list of members: ten thousand of them
_END = struct.Struct("<12xI6x")  # end record of a zip: the size of the list of members
_END_64 = struct.Struct("<40xQ8x8xQ4x")  # that size, and the place of this record


def read_bytes(path: Path, most: int, error: type[Exception]) -> bytes:
    """Return the content of a regular file of at most `most` bytes.

    Raises:
        Exception: of class `error`; the file is missing, special, too large, or cannot be read.
    """
    try:
        size = path.stat().st_size
        problem = f"larger than {most >> 20} MiB, the most read of such files"
        if not path.is_file():  # reading a pipe may never end
            problem = "not a regular file"
        elif size <= most:
            with path.open("rb") as file:
                return file.read(size)  # no more, if it grows
    except FileNotFoundError:
        problem = "no such file"
    except OSError as reason:
        problem = f"cannot be read: {reason.strerror}"
    raise error(f"{path}: {problem}")


def parse_json(content: bytes, where: str, error: type[Exception]) -> Any:
    """Return the JSON value of a file's content; `where` names it in the error of class `error`."""
    try:
        return json.loads(content)
    except (ValueError, RecursionError) as reason:
        raise error(f"{where}: not readable JSON: {str(reason)[:200]}") from None


def read_number_table(path: Path, error: type[Exception]) -> np.ndarray:
    """Return the numbers (T, 1 + D) of a CSV file below its header: seconds, then D columns.

    Raises:
        Exception: of class `error`; the file cannot be read, or a line is no row of numbers.
    """
    content = read_bytes(path, ALLOWANCE, error)
    try:
        if b"\n" in content.strip():
            rows = io.BytesIO(content)
            return np.loadtxt(rows, delimiter=",", skiprows=1, comments=None, ndmin=2)
        reason = "no rows"
    except ValueError as problem:
        reason = str(problem)
    raise error(f"{path}: expected a header, and rows of seconds and numbers: {reason}")


class Archive:
    """Arrays of an npz file, read on access; see `open_archive`.

    The header of an array is checked before memory is allocated. Pickled objects are never loaded;
    accessing one raises an error.
    """

    def __init__(self, path: Path, members: zipfile.ZipFile, error: type[Exception]) -> None:
        self.path = path
        self._error = error
        self._members = members
        self._left = max(ALLOWANCE, MAX_RATIO * path.stat().st_size)

    def __contains__(self, key: str) -> bool:
        return f"{key}.npy" in self._members.NameToInfo

    def __iter__(self) -> Iterator[str]:
        """Yield the names of all arrays."""
        return (name[:-4] for name in self._members.NameToInfo if name.endswith(".npy"))

    def __getitem__(self, key: str) -> np.ndarray:
        """Return the array called `key`.

        Raises:
            Exception: there is none, it is pickled, damaged, or larger than the file allows.
        """
        if key not in self:
            raise self._error(f"{self.path}: no key {key!r} in the archive")
        info, problem = self._members.NameToInfo[f"{key}.npy"], ""
        try:
            if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ValueError("it is packed in a way that numpy never does")
            with self._members.open(info) as member:
                version = np.lib.format.read_magic(member)
                shape, _, dtype = _READERS[version](member)
                held = info.file_size - member.tell()
            n_bytes = dtype.itemsize * math.prod(shape)
            if dtype.hasobject:
                problem = "a pickled Python object could run code: save a plain array"
            elif n_bytes != held or (not dtype.itemsize and math.prod(shape) > 1):
                problem = f"{shape} of {dtype} takes {n_bytes} bytes, but it holds {held}"
            elif n_bytes > self._left:
                problem = f"unpacks to {n_bytes / 2**20:.0f} MiB, far more than its file"
            else:
                self._left -= n_bytes
                with self._members.open(info) as member:
                    return np.lib.format.read_array(member, allow_pickle=False)
        except Exception as error:  # zipfile, zlib and numpy's parser of headers raise anything
            problem = str(error)
        raise self._error(f"{self.path}: key {key!r} cannot be read: {problem}")

    def numbers(self, key: str, dtype: type = np.float64) -> np.ndarray:
        """Return the array called `key` as floating-point numbers.

        Raises:
            Exception: it cannot be read, or does not hold real numbers.
        """
        values = self[key]
        if values.dtype.kind not in "fiu":
            text = self.texts(key) if values.size == 1 else []
            held = repr(text[0][:60]) if text else str(values.dtype)
            raise self._error(f"{self.path}: key {key!r} holds {held}, not numbers")
        return values.astype(dtype, copy=False)

    def texts(self, key: str, at_most: int = 1) -> list[str]:
        """Return the texts in the array called `key`; none if it holds anything else.

        Raises:
            Exception: it cannot be read, has more than `at_most` texts, or invalid characters.
        """
        values, problem = self[key], ""
        if values.size > at_most:
            problem = f"{values.size} texts, too many"
        elif values.dtype.kind == "S":
            return [text.decode("ascii", "replace") for text in values.ravel().tolist()]
        elif values.dtype.kind != "U" or not values.dtype.itemsize:
            return []
        else:
            values = np.ascontiguousarray(values).ravel()
            # Python itself checks them only in parts, and fails with an internal error.
            if values.view(values.dtype.str[0] + "u4").max(initial=0) <= sys.maxunicode:
                return values.tolist()
            problem = "characters that do not exist"
        raise self._error(f"{self.path}: key {key!r} holds {problem}")


@contextmanager
def open_archive(path: str | os.PathLike[str], error: type[Exception]) -> Iterator[Archive]:
    """Open an npz file for reading.

    Args:
        path: the file.
        error: class of all errors, for example `FeatureError`.

    Raises:
        Exception: of that class; the file is missing, is no npz, or its list of members is not a
            list of arrays.
    """
    path = Path(path)
    try:
        check_directory(path)
        members = zipfile.ZipFile(path)
    except FileNotFoundError:
        raise error(f"{path}: no such file") from None
    except Exception as reason:  # as above
        raise error(f"{path}: not a readable npz file: {reason}") from None
    with members:
        yield Archive(path, members, error)


_READERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}
"""Readers of an array's header by the version of the format; no plain array needs another one."""


def check_directory(path: Path, *, zip64: bool = False) -> None:
    """Raise ValueError for a list of members that zipfile would need gigabytes to read.

    Args:
        path: of a zip archive.
        zip64: whether it may be one of the format for more than 4 GiB, as torch writes.
    """
    if path.exists() and not path.is_file():  # reading a pipe may never end
        raise ValueError("not a regular file")
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - _TAIL))
        tail = file.read()
    at = tail.rfind(b"PK\5\6")
    if at < 0 or len(tail) - at < _END.size:
        raise ValueError("it is not a zip archive, or is truncated")
    (directory,) = _END.unpack_from(tail, at)
    if tail[max(0, at - 20) : at].startswith(b"PK\6\7"):
        start = at - _END_64.size
        directory, place = _END_64.unpack_from(tail, start) if start >= 0 else (0, 0)
        if not zip64 or place != size - len(tail) + start:
            large = "an archive of more than 4 GiB; cut the recording into pieces"
            raise ValueError("it is not a whole zip archive" if zip64 else large)
    if directory > _MAX_DIRECTORY:
        raise ValueError(f"its list of members takes {directory} bytes, of a few arrays")
