"""CSV tables of root paths and events."""
