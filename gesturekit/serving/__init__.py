"""HTTP service: sound in, motion out."""

from gesturekit.lazy import attach

__getattr__ = attach(__name__, {}, {"Limits": "app", "create_app": "app"})[1]
