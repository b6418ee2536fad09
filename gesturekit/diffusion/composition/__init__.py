"""Products of experts: several models or conditions in one motion."""
