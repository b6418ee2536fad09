"""Hugging Face speech encoders in local folders; nothing is downloaded."""
