"""Train a denoiser."""
