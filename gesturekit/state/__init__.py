"""State of movement: what speech does not tell of a motion, measured in recordings, drawn for new
motions, and given to the networks as a condition."""
