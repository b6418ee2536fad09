"""A run: its folder, checkpoints, processes and devices."""
