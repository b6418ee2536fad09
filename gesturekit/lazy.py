"""Packages whose public names are imported on first use."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from types import MappingProxyType
from typing import Any

formats: Callable[[], Any]
"""Imports `formats.registry` for `Motion`, which is below; `gesturekit/__init__.py` sets it."""


def attach(
    package: str, homes: Mapping[str, str], others: Mapping[str, str] = MappingProxyType({})
) -> tuple[list[str], Callable[[str], Any], Callable[[], list[str]]]:
    """Return `__all__`, `__getattr__` and `__dir__` of a package.

    No module may be called like a public function: importing it would hide the function.

    Args:
        package: its `__name__`.
        homes: {public name: module inside the package}.
        others: the same for names that are imported within the project, but are no part of the
            documented interface.
    """
    places = {**homes, **others}

    def get(name: str) -> Any:
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(f"{package}.{places[name]}"), name)

    return sorted(homes), get, lambda: sorted(homes)
