"""Corpus: the manifest, its preparation, and the loading of its items."""

from __future__ import annotations

import importlib
from typing import Any

# No submodule may have the name of a public function: importing it would shadow the function.
_MODULES = {
    "Item": "item",
    "Manifest": "manifest",
    "Problem": "problem",
    "Report": "report",
    "prepare": "preparation",
}

__all__ = sorted(_MODULES)


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return __all__
