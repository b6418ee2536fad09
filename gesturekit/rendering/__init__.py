"""Rendering speech to motion files."""
