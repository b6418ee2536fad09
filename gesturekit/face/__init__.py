"""Rule-based face motion from speech: mouth, blinks and small eye movements."""

from gesturekit.face.speech import METHODS, EnergyFace, face_from_speech

__all__ = ["METHODS", "EnergyFace", "face_from_speech"]
