"""Conversion of motion files between formats, rigs and frame rates, as a batch."""
