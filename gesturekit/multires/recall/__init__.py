"""Recall by speech: recorded motion, chosen piece by piece, replaces the output of a coarse
level."""
