"""gesturekit: speech to body motion.

import gesturekit as gk

model = gk.load("demo")
motion = model.generate("speech.wav", seed=0)
motion.save("speech.bvh")
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gesturekit.corpus import prepare
    from gesturekit.errors import GestureKitError
    from gesturekit.evaluation import evaluate
    from gesturekit.model import Model
    from gesturekit.motion.motion import Motion
    from gesturekit.motion.skeleton import Skeleton
    from gesturekit.rendering.batch import render
    from gesturekit.systems import load, train

__version__ = "0.1.0"
__all__ = [
    "GestureKitError",
    "Model",
    "Motion",
    "Skeleton",
    "evaluate",
    "load",
    "prepare",
    "render",
    "train",
]

_MODULES = {
    "GestureKitError": "gesturekit.errors",
    "Model": "gesturekit.model",
    "Motion": "gesturekit.motion.motion",
    "Skeleton": "gesturekit.motion.skeleton",
    "evaluate": "gesturekit.evaluation",
    "load": "gesturekit.systems",
    "prepare": "gesturekit.corpus",
    "render": "gesturekit.rendering.batch",
    "train": "gesturekit.systems",
}


def __getattr__(name: str) -> Any:
    # Names are imported when they are first used: `gesturekit --help` needs none of them.
    if name not in _MODULES:
        raise AttributeError(f"module 'gesturekit' has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
