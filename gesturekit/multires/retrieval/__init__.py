"""Recorded motion in a model: joints that its network does not model, or the whole body."""
