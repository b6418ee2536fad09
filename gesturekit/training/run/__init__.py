"""Training run: folder, checkpoints, processes and devices."""
