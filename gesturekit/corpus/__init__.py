"""Corpus: the manifest, its preparation, and the loading of its items."""

from gesturekit.lazy import attach

__all__, __getattr__, __dir__ = attach(
    __name__,
    {
        "Item": "manifest",
        "Manifest": "manifest",
        "Problem": "checks",
        "Report": "report",
        "prepare": "preparation",
    },
)
