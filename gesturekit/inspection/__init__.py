"""Summaries of motion, sound, features, models, corpora and runs, on one screen."""

from gesturekit.inspection.recognition import inspect
from gesturekit.inspection.summary import Summary

__all__ = ["Summary", "inspect"]
