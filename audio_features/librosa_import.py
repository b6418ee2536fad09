"""Import of librosa, one process at a time.

librosa compiles functions when it is imported, and numba keeps them in files. Two processes that
fill an empty cache at once leave one with which every later process crashes (a segmentation fault).
"""

from __future__ import annotations

import functools
import getpass
import importlib
import tempfile
from contextlib import ExitStack, suppress
from pathlib import Path
from types import ModuleType

from filelock import FileLock

_COMPILED = ("beat", "core.pitch", "feature.rhythm", "onset", "sequence", "util.utils")
_SECONDS = 300.0  # to wait for another process, which compiles for some 20 s


@functools.cache
def import_librosa() -> ModuleType:
    """Return librosa with all modules whose functions are compiled."""
    with ExitStack() as held:
        # Without a lock where a file cannot be locked, or the user has no name.
        with suppress(OSError, KeyError, ImportError):
            file = Path(tempfile.gettempdir()) / f"librosa-{getpass.getuser()}.lock"
            held.enter_context(FileLock(file, timeout=_SECONDS))
        for module in _COMPILED:
            importlib.import_module(f"librosa.{module}")
        return importlib.import_module("librosa")
