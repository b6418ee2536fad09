"""gesturekit: speech to body motion.

import gesturekit as gk

model = gk.load("demo")
motion = model.generate("speech.wav", seed=0)
motion.save("speech.bvh")
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from gesturekit import lazy

if TYPE_CHECKING:
    from gesturekit.corpus import prepare
    from gesturekit.errors import GestureKitError
    from gesturekit.evaluation import evaluate
    from gesturekit.model import Model
    from gesturekit.motion.concatenation import concatenate
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
        "GestureKitError": "errors",
        "Model": "model",
        "Motion": "motion.motion",
        "Skeleton": "motion.skeleton",
        "concatenate": "motion.concatenation",
        "evaluate": "evaluation",
        "load": "systems",
        "prepare": "corpus",
        "render": "rendering.batch",
        "train": "systems",
    },
    {"display": "viewer", "reader_of": "formats.registry", "writer_of": "formats.registry"},
)[1]
lazy.on_demand = __getattr__  # for `Motion`, which is below readers, writers and viewer


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
