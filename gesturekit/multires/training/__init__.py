"""Train a pyramid, two levels at a time."""
