"""Statistics over recordings: intervals, paired tests, likeness, and agreement with people."""
