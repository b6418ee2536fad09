"""Writing a file that has its name only when it is whole and on disk."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

PART = ".part"
"""Ends the name of a file that is being written; what is left of one belonged to a killed run."""


@contextmanager
def atomic_write(path: Path) -> Iterator[BinaryIO]:
    """A binary file beside `path` that takes its name when the block ends well.

    Folders are made as needed. Where the block raises, nothing is left. Raises OSError where the
    folder cannot be written to.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(prefix=".", suffix=PART, dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        # mkstemp makes files readable by their owner alone; give the usual rights back.
        umask = os.umask(0)
        os.umask(umask)
        Path(temporary).chmod(0o666 & ~umask)
        os.replace(temporary, path)
    finally:
        Path(temporary).unlink(missing_ok=True)
