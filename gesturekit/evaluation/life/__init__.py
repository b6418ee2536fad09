"""Measures of life of sets of clips, and the verdict in words."""
