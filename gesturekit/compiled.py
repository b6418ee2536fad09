"""Functions compiled by numba, kept in a folder beside the code where there is one."""

from __future__ import annotations

from collections.abc import Callable, Set
from typing import Any

from numba import njit


def compiled(*, fastmath: Set[str] = frozenset()) -> Callable[[Callable[..., Any]], Any]:
    """Decorator. Other Python threads run beside what it compiles.

    Args:
        fastmath: what the compiler may do to floating-point arithmetic, by LLVM's names.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        options = {"nogil": True, "fastmath": set(fastmath)}
        try:
            return njit(cache=True, **options)(function)
        except RuntimeError:  # no folder that a compiled function could be kept in
            return njit(**options)(function)

    return decorate
