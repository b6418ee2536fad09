"""Diffusion models: every control, on tiny networks of random weights."""

from __future__ import annotations
