"""Corpora: the manifest, its preparation, and the loading of its items."""

from __future__ import annotations

import importlib
from typing import Any

# No module may be called like a public function: importing it would hide the function.
_HOMES = {
    "Item": "item",
    "Manifest": "manifest",
    "Problem": "problem",
    "Report": "report",
    "prepare": "preparation",
}

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return __all__
