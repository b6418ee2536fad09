"""Atomic file writing: a partial file never has the final name."""

from __future__ import annotations

import glob
import hashlib
import os
import re
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

_LONGEST_NAME = 255  # bytes, in the usual file systems


@contextmanager
def atomic_write(
    path: str | os.PathLike[str], *, suffix: str | None = None, flush: bool = True
) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on leaving without error it becomes `path`.

    The temporary file is in the same folder, because a rename across file systems is not atomic.
    It keeps the suffix, which some libraries inspect, unless `suffix` is given; a caller uses
    that to find the files of killed runs. It is flushed to disk before the rename, unless `flush`
    is False, and removed if the block raises. A missing folder is created. Raises OSError if it
    cannot be written to.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    suffix = path.suffix if suffix is None else suffix
    try:
        prefix = _prefix(path, suffix)
        handle, name = tempfile.mkstemp(prefix=prefix, suffix=suffix, dir=path.parent)
    except OSError as error:  # which names the temporary file, and a user knows only the path
        raise OSError(error.errno, f"cannot be written: {error.strerror}", str(path)) from None
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        # mkstemp creates files that only their owner may read; restore the usual permissions.
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        if flush:
            with temporary.open("rb+") as written:
                os.fsync(written.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a file of text; see `atomic_write`."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _prefix(path: Path, suffix: str) -> str:
    """Return the first part of a temporary name, shortened if the file system takes no longer."""
    stem, room = path.stem, _LONGEST_NAME - len(os.fsencode(suffix)) - len(".-????????")
    if len(os.fsencode(stem)) > room:
        end = f"~{hashlib.sha256(os.fsencode(stem)).hexdigest()[:16]}"
        while len(os.fsencode(stem + end)) > room:
            stem = stem[:-1]
        stem += end
    return f".{stem}-"


def remove_unfinished(path: Path) -> None:
    """Remove the temporary files that killed processes left of `atomic_write(path)`.

    No other process may be writing `path`.
    """
    prefix = glob.escape(_prefix(path, path.suffix))
    for left in path.parent.glob(f"{prefix}????????{glob.escape(path.suffix)}"):
        left.unlink(missing_ok=True)


def write_tensors(
    path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str] | None = None
) -> None:
    """Write a safetensors file, with texts in its header.

    Raises:
        OSError: it cannot be written, such as on a full disk.
    """
    from safetensors import SafetensorError
    from safetensors.torch import save_file

    with atomic_write(path) as temporary:
        try:
            plain = {name: tensor.contiguous() for name, tensor in tensors.items()}
            save_file(plain, temporary, None if metadata is None else dict(metadata))
        except SafetensorError as error:
            # It names the operating system's error only in its text.
            number = re.search(r"os error (\d+)", str(error))
            if number is None:
                raise
            raise OSError(int(number[1]), os.strerror(int(number[1])), str(path)) from error
