"""Subsets of joints."""
