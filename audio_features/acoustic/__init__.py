"""Acoustic features computed from the waveform, without a network."""
