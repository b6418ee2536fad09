"""Fast CPU engine for the networks of the pyramid."""
