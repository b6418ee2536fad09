"""State of movement: what speech does not tell of a motion, measured in recordings, drawn for new
motions, and given to the networks as a condition."""

from gesturekit.lazy import attach

__getattr__ = attach(
    __name__,
    {},
    {
        "RecordedState": "process",
        "Regression": "prediction",
        "StateChannels": "channels",
        "StateProcess": "process",
        "WantedMovement": "prediction",
        "averaged": "channels",
        "fast_inputs": "prediction",
        "folds_of": "prediction",
        "given_state": "given",
        "load_state": "format",
        "slow_inputs": "prediction",
        "state_tensors": "format",
        "state_values": "format",
        "usual_voice": "prediction",
        "voice_activity": "process",
    },
)[1]
