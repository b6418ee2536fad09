"""Rule-based face motion from speech: mouth, blinks and small eye movements."""
