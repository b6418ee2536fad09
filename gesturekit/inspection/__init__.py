"""Telling what a motion, a sound, features, a model, a corpus or a run is, in one screen."""

from gesturekit.inspection.recognition import inspect
from gesturekit.inspection.sheet import Sheet

__all__ = ["Sheet", "inspect"]
