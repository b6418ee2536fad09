"""Visualisation of motion: an HTML player with sound, and pictures."""

from __future__ import annotations

from importlib import import_module
from typing import Any

# Public name -> module. Imported on first use: matplotlib is slow to load.
_EXPORTS = {
    "contact_sheet": "pictures",
    "player_data": "html",
    "player_shell": "html",
    "speech_and_motion": "pictures",
    "write_html": "html",
    "write_picture": "pictures",
}
__all__ = sorted(_EXPORTS)


def __getattr__(name: str) -> Any:
    if name not in _EXPORTS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_EXPORTS[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_EXPORTS})
