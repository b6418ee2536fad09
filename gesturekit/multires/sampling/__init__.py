"""Generate motion with a trained pyramid."""
