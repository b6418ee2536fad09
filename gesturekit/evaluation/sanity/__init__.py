"""Known-bad motion made from recordings, and what each metric notices of it."""
