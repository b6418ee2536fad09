"""Recordings as contestants, and differences of models that are larger than chance."""
