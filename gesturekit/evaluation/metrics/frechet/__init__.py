"""Fréchet distances between sets of clips."""
