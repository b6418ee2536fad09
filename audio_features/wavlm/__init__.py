"""WavLM speech features from local weights; nothing is downloaded."""
