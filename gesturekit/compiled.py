"""Functions compiled by numba, cached beside the code if the folder is writable."""

from __future__ import annotations

from collections.abc import Callable, Set
from typing import Any

from numba import njit


def compiled(*, fastmath: Set[str] = frozenset()) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a function which releases the GIL.

    Args:
        fastmath: LLVM's names of allowed floating-point transformations.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        options: dict[str, Any] = {"nogil": True, "fastmath": set(fastmath)}
        try:
            return njit(cache=True, **options)(function)
        except RuntimeError:  # no folder that a compiled function could be kept in
            return njit(**options)(function)

    return decorate
