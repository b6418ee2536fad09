"""Layouts of public corpora: where their files lie, and their splits, speakers and styles."""
