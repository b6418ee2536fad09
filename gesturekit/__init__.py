"""gesturekit: speech to body motion.

import gesturekit as gk

model = gk.load("demo")
motion = model.generate("speech.wav", seed=0)
motion.save("speech.bvh")
"""

from __future__ import annotations

from types import ModuleType
from typing import TYPE_CHECKING

from gesturekit import lazy

if TYPE_CHECKING:
    from gesturekit.corpus import prepare
    from gesturekit.errors import GestureKitError
    from gesturekit.evaluation import evaluate
    from gesturekit.model import Model
    from gesturekit.motion.concatenation import concatenate
    from gesturekit.motion.face import FaceTrack
    from gesturekit.motion.motion import Motion
    from gesturekit.motion.skeleton import Skeleton
    from gesturekit.rendering.renderer import render
    from gesturekit.systems import load, train

__version__ = "0.1.0"
__all__ = [
    "FaceTrack",
    "GestureKitError",
    "Model",
    "Motion",
    "Skeleton",
    "concatenate",
    "evaluate",
    "load",
    "prepare",
    "render",
    "train",
]

# `gesturekit --help` needs none of them.
__getattr__ = lazy.attach(
    __name__,
    {
        "FaceTrack": "motion.face",
        "GestureKitError": "errors",
        "Model": "model",
        "Motion": "motion.motion",
        "Skeleton": "motion.skeleton",
        "concatenate": "motion.concatenation",
        "evaluate": "evaluation",
        "load": "systems",
        "prepare": "corpus",
        "render": "rendering.renderer",
        "train": "systems",
    },
)[1]


def _formats() -> ModuleType:
    from gesturekit.formats import registry

    return registry


lazy.formats = _formats


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
