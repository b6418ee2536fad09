"""Motion on a subset of its joints."""
