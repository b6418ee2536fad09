"""Measuring of clips and of sets of clips: on all cores, and stored by content."""
