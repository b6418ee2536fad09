"""HTTP service: sound in, motion out."""
