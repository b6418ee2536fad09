"""Generate motion with a trained denoiser."""
