"""Tables of paths and events."""
