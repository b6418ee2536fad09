"""Hugging Face speech and text encoders in local folders; nothing is downloaded."""
