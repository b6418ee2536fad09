"""HTTP service: sound in, motion out."""

from gesturekit.lazy import attach

__all__, __getattr__, __dir__ = attach(
    __name__,
    {
        "Limits": "requests",
        "Rate": "requests",
        "create_app": "app",
    },
)
