"""Data that a run trains on."""
