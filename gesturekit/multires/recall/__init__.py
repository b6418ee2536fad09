"""Recall by speech: recorded motion, chosen piece by piece, in the place of a coarse level."""
