"""WavLM speech features from local weights; nothing is downloaded."""

from audio_features.wavlm.extractor import WavLM

__all__ = ["WavLM"]
