"""WavLM speech features from weights on disk; nothing here ever reaches for the network."""

from audio_features.wavlm.extractor import WavLM

__all__ = ["WavLM"]
