"""State of movement: what speech does not tell of a motion, measured in recordings, drawn for new
motions, and given to the networks as a condition."""

from gesturekit.state.channels import StateChannels
from gesturekit.state.prediction import WantedMovement
from gesturekit.state.process import RecordedState, StateProcess

__all__ = ["RecordedState", "StateChannels", "StateProcess", "WantedMovement"]
