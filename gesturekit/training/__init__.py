"""Training of both systems: data, runs and model folders."""
