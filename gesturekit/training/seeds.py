"""Random numbers that depend on their purpose, not on earlier draws.

A trainer that asks for `rng_for(seed, "pair", 2, "iteration", 417)` needs no random state in its
checkpoints: a resumed run draws the same numbers again.
"""

from __future__ import annotations

import hashlib
import operator
from collections.abc import Callable
from typing import TypeVar

import torch

from gesturekit.errors import ModelError

Made = TypeVar("Made")


def checked_draw(seed: int, item: str = "") -> tuple[int, str]:
    """Return a seed as a plain whole number, and the name of an utterance as a plain str.

    Raises:
        ModelError: the seed is not a whole number from 0, or the name is not text.
    """
    number = operator.index(seed) if hasattr(seed, "__index__") else -1
    if number < 0:
        raise ModelError(f"seed={seed!r}: give a whole number from 0")
    if not isinstance(item, str):
        raise ModelError(f"item={item!r}: give the name of the utterance as text")
    return number, str(item)


def rng_for(*keys: int | str) -> torch.Generator:
    """Return a CPU generator seeded by the keys alone."""
    text = "\x1f".join(f"{type(key).__name__}:{key}" for key in keys)
    # A file name, and so the name of an item, may hold bytes that are no text.
    digest = hashlib.sha256(text.encode("utf-8", "surrogatepass")).digest()
    # 63 bits: manual_seed takes a signed 64-bit number.
    return torch.Generator().manual_seed(int.from_bytes(digest[:8], "little") >> 1)


def seeded(keys: tuple[int | str, ...], make: Callable[[], Made]) -> Made:
    """Build something whose initial weights depend on the keys alone."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(rng_for(*keys).initial_seed())
        return make()
