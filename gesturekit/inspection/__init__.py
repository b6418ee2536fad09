"""Telling what a motion, a sound, features, a model, a corpus or a run is, in one screen."""

from gesturekit.inspection.recognition import inspect
from gesturekit.inspection.summary import Summary

__all__ = ["Summary", "inspect"]
