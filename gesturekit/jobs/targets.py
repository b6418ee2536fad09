"""Output files that may not be written."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NoReturn

from gesturekit.errors import ConfigError

EXISTING = ("refuse", "skip", "replace")
"""Treatments of existing files that were made with other settings or another input."""
_SHOWN = 3


def refuse_leaving(targets: Iterable[Path], out: Path) -> None:
    """Refuse targets that leave a folder through a link inside it.

    Raises:
        ConfigError: a target whose folder is a link to outside `out`.
    """
    inside = Path(os.path.realpath(out))
    for target in targets:
        if not Path(os.path.realpath(target.parent)).is_relative_to(inside):
            raise ConfigError(f"{target} lies outside {out}: {target.parent} is a link")


def refuse_existing(there: Sequence[Path], reason: str = "") -> NoReturn:
    """Refuse to overwrite existing files.

    Args:
        there: the files, at least one.
        reason: additional text, such as ", made with another seed".

    Raises:
        ConfigError: always; it names the options that allow it.
    """
    more = f" and {len(there) - _SHOWN} more" if len(there) > _SHOWN else ""
    verb, object_ = ("exists", "it") if len(there) == 1 else ("exist", "them")
    raise ConfigError(
        f"{', '.join(map(str, there[:_SHOWN]))}{more} {verb} already{reason}; --existing replace "
        f"overwrites {object_}, --existing skip leaves {object_}"
    )
