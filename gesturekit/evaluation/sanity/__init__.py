"""Known-bad motion made from recordings, and which of it each metric detects."""
